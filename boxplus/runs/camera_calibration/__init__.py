"""A camera calibration over files: corners, target, IMU; and what it writes."""
