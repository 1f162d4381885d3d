"""Pose graphs: relative poses in space or in the plane, their start, and the poses that fit them best."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
