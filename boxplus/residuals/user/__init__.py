"""Residuals that a user writes, compiled and differentiated like those of the library."""
