"""What simulated sensors see: solids, the worlds made of them, and rays that meet them."""
