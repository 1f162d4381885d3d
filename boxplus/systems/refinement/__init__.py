"""Offline re-optimisation of a finished LiDAR-inertial run: all poses, planes and IMU samples at once."""
