"""Whole estimators, one a folder."""
