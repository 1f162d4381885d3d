"""Calibration of cameras, and of cameras and an IMU, from what they saw of a target."""
