"""What planes say of gravity: how far what stands around a LiDAR is from upright, and the ground from level."""
