"""Recordings of cameras: bags and folders as images and IMU samples in time order, with their calibration."""
