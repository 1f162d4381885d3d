"""Sessions of one place: where they met, and one map of them."""
