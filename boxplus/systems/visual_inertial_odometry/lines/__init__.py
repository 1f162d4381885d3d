"""Straight lines in visual-inertial odometry: found, followed and placed in space (docs/visual_inertial_odometry.md, Lines)."""
