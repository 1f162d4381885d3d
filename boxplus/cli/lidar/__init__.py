"""Commands of a LiDAR, of its runs and of their maps."""
