"""Camera models: projection of points into pixels and its derivatives."""
