"""Whether grey values, depths and the calibration of direct odometry agree: what the frames so far contradict."""
