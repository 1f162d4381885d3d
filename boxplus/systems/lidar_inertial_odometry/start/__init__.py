"""Where LiDAR-inertial odometry begins: at rest, or moving."""
