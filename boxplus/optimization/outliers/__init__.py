"""Residuals that do not belong: told from inliers without a good start."""
