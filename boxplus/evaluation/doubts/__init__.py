"""What speaks against a comparison: files that mean something else, and what some of the poses do to its figures."""
