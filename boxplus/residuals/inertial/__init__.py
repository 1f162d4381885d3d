"""What an IMU measures between keyframes: preintegration, its covariance, and the error between two states."""
