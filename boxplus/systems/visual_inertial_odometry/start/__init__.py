"""Where visual-inertial odometry begins: attitude, velocity, biases and, with one camera, scale."""
