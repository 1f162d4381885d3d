"""A mounting of the LiDAR on the IMU that is not known exactly: what it makes of the state, and what shows it."""
