"""Local maps: stretches of odometry, each with what was seen on it, in a frame of its own."""
