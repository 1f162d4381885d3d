"""What is watched while the odometry runs: whether its sensors, its map and itself can be trusted."""
