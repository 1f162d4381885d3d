"""What speaks against an optimised pose graph, or against the way that its file was read."""
