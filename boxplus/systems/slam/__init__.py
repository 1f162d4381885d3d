"""Loop closure on the local maps of an odometry."""
