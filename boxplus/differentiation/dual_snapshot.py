"""A user's function made ready to be compiled for dual numbers."""

from __future__ import annotations

from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from boxplus._user_code import copied_module, snapshot
from boxplus.differentiation import arithmetic  # noqa: F401 - what dual numbers do is known to Numba from here on
from boxplus.differentiation.arrays import constructors


def dual_snapshot(function: FunctionType, width: int) -> FunctionType:
    """The function, and all that it calls, with arrays of dual numbers of `width` directions where it makes arrays of floats."""
    makers = constructors(width)

    def translated(value: Any, attributes: frozenset[str]) -> Any:
        if isinstance(value, ModuleType) and value is np:
            module = copied_module(np)
            for name in attributes:
                if hasattr(np, name):
                    setattr(module, name, translated(getattr(np, name), attributes))
            return module
        try:
            return makers.get(value, value)
        except TypeError:  # it has no hash, and so is no function
            return value

    return snapshot(function, checked=False, translated=translated)
