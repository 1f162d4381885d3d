"""What speaks against a bundle adjustment: another reading of the file, another lens, units, wrong matches, an early end."""
