"""What a place looks like from above, and which other place looks like it."""
