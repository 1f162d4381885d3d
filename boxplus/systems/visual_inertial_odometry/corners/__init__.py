"""Corners: found, followed, measured at their centres, and what their errors are."""
