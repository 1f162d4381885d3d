"""Bundle adjustment: the cameras, and points or lines, that fit all observations best."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
