"""Plain files: pose graphs, reconstructions, trajectories, point clouds; read and written as their formats say."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
