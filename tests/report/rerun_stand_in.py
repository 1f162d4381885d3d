"""A stand-in for rerun: a hundred megabytes, and a screen, for what a test looks at."""

from __future__ import annotations

import sys
import types
from unittest.mock import MagicMock

import pytest


def stand_in(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """The module as `import rerun` finds it from here on."""
    module = MagicMock(spec=types.ModuleType("rerun"))
    shapes = ("Transform3D", "Quaternion", "Arrows3D", "LineStrips3D", "Points3D", "Scalars")
    for name in ("init", "connect_grpc", "save", "disconnect", "log", "set_time", "ViewCoordinates", *shapes):
        setattr(module, name, MagicMock())
    monkeypatch.setitem(sys.modules, "rerun", module)
    return module
