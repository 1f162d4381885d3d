"""The door to libraries that are not always there: those of the extras in pyproject.toml."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from boxplus.errors import InputError

_LIBRARIES: dict[str, tuple[str, str | None]] = {
    "cv2": ("OpenCV", "vision"),
    "dpkt": ("dpkt", "sensors"),
    "fsspec": ("fsspec", "fleet"),
    "laspy": ("laspy", "las"),
    "lazrs": ("lazrs", "las"),
    "matplotlib": ("matplotlib", "report"),
    "ouster": ("ouster-sdk", None),
    "plotly": ("plotly", "report"),
    "pye57": ("pye57", "e57"),
    "pyproj": ("pyproj", "gnss"),
    "rasterio": ("rasterio", "geo"),
    "ray": ("Ray", "fleet"),
    "rerun": ("rerun-sdk", "view"),
    "velodyne_decoder": ("velodyne-decoder", "sensors"),
}
"""Module: what the library is called, and the extra it belongs to, if it can be installed with boxplus."""
_OUSTER = "ouster-sdk>=1.0"
"""Pins libraries that boxplus has newer, an older rosbags among them; works with these, and needs no others here."""


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
        InputError: it is not installed, or cannot be imported; the message has the line that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        package = module.partition(".")[0]
        name, extra = _LIBRARIES[package]
        found = "it is not installed" if not has(package) else f"it cannot be imported: {missing}"
        line = _pip("--no-deps", _OUSTER) if extra is None else installation(extra)
        raise error(f"{name}, {purpose}", found, line) from missing


def installation(extra: str) -> str:
    """The line for a shell that installs the libraries of an extra beside boxplus, however that came here.

    boxplus is on no index of packages: what would install `boxplus[view]` from there does not work, and its libraries do.
    """
    return _pip(*_wanted(extra) or [f"{Path(__file__).resolve().parents[1]}[{extra}]"])


def _pip(*wanted: str) -> str:
    """The line for a shell that installs these."""
    pip = [sys.executable, "-m", "pip", "install"] if has("pip") else ["uv", "pip", "install", "--python", sys.executable]
    words = [*pip, *wanted]
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)


def _wanted(extra: str) -> list[str]:
    """Requirements of an extra as boxplus was installed with; none where its folder is on the path and it was not."""
    try:
        listed = importlib.metadata.requires("boxplus") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    own = [line.partition(";") for line in listed if re.search(rf"""extra\s*==\s*['"]{extra}['"]""", line)]
    return [requirement.strip() for requirement, _, _ in own]
