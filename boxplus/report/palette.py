"""Colours and rows that all pictures share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.report.timeline import Timeline
from boxplus.systems.lidar_inertial_odometry.estimate import WAITED

# Chosen by search so that they differ for every kind of colour vision and show on white as on the dark page: see the tests.
STATUS = {"ok": "#3aa3e3", "weak": "#dd9000", "lost": "#a03070"}
MARKS = {"ok": ("circle", "o"), "weak": ("diamond", "D"), "lost": ("x", "X")}
"""Of the status, for those who see no colours: in Plotly's words and in Matplotlib's."""
XYZ = ("#f44301", "#2dbcae", "#6346c7")
"""Of the axes x, y and z."""
SERIES = ("#5d6cff", "#95b118", "#2aa38a", "#6d4f95", "#cb505e", "#556070", "#247909", "#c98fc0")
DASHES = {XYZ[1]: "dash", XYZ[2]: "dot", SERIES[1]: "dash", SERIES[2]: "dot", SERIES[3]: "dashdot", SERIES[4]: "longdash"}
"""Of lines that share a picture, by their colour; the others are solid."""
HEIGHT = ("#c9d3dc", "#93abc2", "#5c7594", "#33415c")
"""Of the map, from low to high: quiet, so that the trajectory stands out."""
REJECTED = (SERIES[1], SERIES[4], SERIES[6], SERIES[5], SERIES[2], SERIES[7])
"""Of what was not used, beside SERIES[0] for what was."""
INK, FAINT, GRID = "#22303c", "#6b7a8f", "#e4e8ec"

_MOST_ROWS = 1500  # more than a page is wide


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


def worked_ms(data: Timeline) -> NDArray[np.float64]:
    """(N,) milliseconds of each estimate, without those in which it waited for the comparison of the sensors."""
    waited = data.log.pairs("timing_ms").get(WAITED, np.zeros(len(data.seconds)))
    worked: NDArray[np.float64] = data.log.column("total_ms") - waited
    return worked


def highest_ms(data: Timeline) -> float:
    """Where an axis of milliseconds per estimate ends: a few seconds of waiting would leave nothing else to be seen."""
    return 1.15 * max(float(np.percentile(worked_ms(data), 99.5)), 1e-3) if len(data.seconds) else 1.0


def gravity_tilt_deg(gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) angle between each (N, 3) gravity and the first one [deg]."""
    unit = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    angle: NDArray[np.float64] = np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(unit, unit[0]), axis=1), 0.0, 1.0)))
    return angle
