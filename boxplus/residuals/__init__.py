"""Error terms for `Problem.add_residuals`: one kind a file, each a group of N residuals with analytic Jacobians."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
