"""Marginalisation for sliding windows: what leaves a problem, and what it leaves behind."""
