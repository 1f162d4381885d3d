"""How the LiDAR moved, from its scans alone, and what of that is to be believed."""
