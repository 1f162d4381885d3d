"""Derivatives of compiled functions by dual numbers (docs/differentiation.md)."""
