"""Odometry of a LiDAR alone: a motion that is continuous in time, measured by the points at their own times."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
