"""Reports of odometry with cameras and of their calibration."""
