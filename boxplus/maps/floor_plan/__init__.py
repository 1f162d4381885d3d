"""Maps seen from above: heights of the ground, and which cells of a floor plan are free or occupied."""
