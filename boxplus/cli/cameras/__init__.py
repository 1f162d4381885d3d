"""Commands of cameras."""
