"""Nested dissection: separators that halve a graph again and again, each eliminated after what it separates."""
