"""Point clouds: PLY, PCD, LAS and E57, read whole and written block by block."""
