"""Colours and rows that all pictures share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.report.timeline import Timeline

STATUS = {"ok": "#2f7d5b", "weak": "#e09f3e", "lost": "#c1443c"}
XYZ = ("#b5443c", "#3a8f4d", "#3568a8")
"""Of the axes x, y and z."""
SERIES = ("#3568a8", "#e09f3e", "#2f7d5b", "#9b5aa5", "#c1443c", "#6b7a8f", "#5fa8a0", "#a5813c")
HEIGHT = ("#c9d3dc", "#93abc2", "#5c7594", "#33415c")
"""Of the map, from low to high: quiet, so that the trajectory stands out."""
REJECTED = ("#e09f3e", "#c1443c", "#9b5aa5", "#6b7a8f", "#3568a8", "#a5813c")
INK, FAINT, GRID = "#22303c", "#6b7a8f", "#e4e8ec"

_MOST_ROWS = 4000


def shown_rows(data: Timeline) -> NDArray[np.intp]:
    """The scans to draw over time: all, or of a long run an even selection with the slowest and the troubled ones kept."""
    count = len(data.seconds)
    if count <= _MOST_ROWS:
        return np.arange(count)
    even = np.linspace(0, count - 1, _MOST_ROWS).astype(np.intp)
    troubled = np.flatnonzero(data.status != "ok")
    troubled = troubled[:: max(1, len(troubled) // 1000)]
    slowest = np.argsort(data.log.column("total_ms"))[-200:]
    return np.unique(np.concatenate([even, troubled, slowest]))


def gravity_tilt_deg(gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) angle between each (N, 3) gravity and the first one [deg]."""
    unit = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    angle: NDArray[np.float64] = np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(unit, unit[0]), axis=1), 0.0, 1.0)))
    return angle
