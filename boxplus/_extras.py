"""The door to libraries that are not always there: those of the extras in pyproject.toml."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from boxplus.errors import InputError

_LIBRARIES = {
    "cv2": ("OpenCV", "vision"),
    "dpkt": ("dpkt", "sensors"),
    "fsspec": ("fsspec", "fleet"),
    "laspy": ("laspy", "las"),
    "lazrs": ("lazrs", "las"),
    "matplotlib": ("matplotlib", "report"),
    "ouster": ("ouster-sdk", "sensors"),
    "plotly": ("plotly", "report"),
    "pye57": ("pye57", "e57"),
    "pyproj": ("pyproj", "gnss"),
    "rasterio": ("rasterio", "geo"),
    "ray": ("Ray", "fleet"),
    "rerun": ("rerun-sdk", "view"),
    "velodyne_decoder": ("velodyne-decoder", "sensors"),
}
"""Module: what the library is called, and the extra it belongs to."""


def has(*modules: str) -> bool:
    """Whether all of these libraries are installed; none is imported."""
    return all(importlib.util.find_spec(module) is not None for module in modules)


def require(module: str, purpose: str, error: type[InputError] = InputError) -> Any:
    """A module of an extra.

    Args:
        module: its name, of a submodule perhaps.
        purpose: what it does for the caller, as a clause: `which follows corners`.
        error: what is raised where it is missing.

    Raises:
        InputError: it is not installed, or cannot be imported; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        name, extra = _LIBRARIES[package]
        found = "it is not installed" if not has(package) else f"it cannot be imported: {missing}"
        raise error(f"{name}, {purpose}", found, f"pip install 'boxplus[{extra}]'") from missing
