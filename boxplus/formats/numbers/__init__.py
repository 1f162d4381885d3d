"""Numbers in text, read and printed at the speed of the disk."""
