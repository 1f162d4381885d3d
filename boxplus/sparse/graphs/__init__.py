"""Graphs: which nodes hang together, over which edges alone, and trees that span them."""
