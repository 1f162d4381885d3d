"""Direct alignment: the motion between two images, one with depth, from their grey values."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
