"""boxplus: state estimation on manifolds for SLAM."""

__version__ = "0.1.0"
