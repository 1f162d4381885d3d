"""The report of a run of direct odometry: the path, the status of the frames, residuals and brightness."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from boxplus.errors import printable
from boxplus.formats.trajectory import read_trajectory
from boxplus.report.palette import SERIES
from boxplus.report.skeleton import figure_section, html_table, tiles, warnings_section, write_html
from boxplus.runs.direct_run import DirectRunSummary

_COLOUR = {"ok": SERIES[0], "weak": "#d69e2e", "lost": "#c53030"}


def write_direct_report(folder: Path, summary: DirectRunSummary) -> Path:
    """Write `report.html` into the folder of a run; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    from html import escape

    path = read_trajectory(folder / "trajectory.csv")
    with (folder / "frames.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    t = (np.array([int(row["time_ns"]) for row in rows]) - int(rows[0]["time_ns"])) * 1e-9
    status = np.array([row["status"] for row in rows])
    p = path.p
    way = go.Figure()
    way.add_trace(go.Scatter3d(x=p[:, 0], y=p[:, 1], z=p[:, 2], mode="lines", line={"color": SERIES[0], "width": 4}, name="path"))
    for name in ("weak", "lost"):
        some = status == name
        if some.any():
            dots = {"color": _COLOUR[name], "size": 4}
            way.add_trace(go.Scatter3d(x=p[some, 0], y=p[some, 1], z=p[some, 2], mode="markers", marker=dots, name=name))
    way.update_layout(height=520, scene={"aspectmode": "data"}, margin={"l": 0, "r": 0, "t": 0, "b": 0})
    course = go.Figure()
    for name, column in (
        ("residual σ [grey values]", "sigma"),
        ("overlap [%]", "overlap"),
        ("gain against the keyframe [%]", "a"),
    ):
        values = np.array([float(row[column]) for row in rows])
        shown = {"sigma": values, "overlap": 100.0 * values, "a": 100.0 * np.exp(values)}[column]
        course.add_trace(go.Scatter(x=t, y=shown, mode="lines", name=name))
    for name in ("weak", "lost"):
        some = status == name
        if some.any():
            dots = {"color": _COLOUR[name], "size": 7}
            course.add_trace(go.Scatter(x=t[some], y=np.zeros(int(some.sum())), mode="markers", marker=dots, name=name))
    course.update_layout(height=340, xaxis_title="time [s]", margin={"l": 40, "r": 10, "t": 10, "b": 40})
    numbers = [
        (f"{summary.path_length_m:.2f} m", f"path in {summary.duration_s:.1f} s"),
        (f"{summary.frames}", "frames"),
        (f"{summary.status.get('ok', 0)}", "of them ok"),
        (f"{summary.keyframes}", "keyframes"),
    ]
    if summary.frame_ms is not None:
        numbers.append((f"{summary.frame_ms['median']:.1f} ms", "a frame, median"))
    doubts = [summary.contradiction] if summary.contradiction else []
    facts = [
        ("recording", printable(summary.recording)),
        ("format", summary.format),
        ("cameras", ", ".join(summary.cameras)),
        *((what, str(count)) for what, count in summary.rejected.items()),
    ]
    body = (
        f"<h1>Direct odometry</h1><p>{escape(printable(summary.describe_state()))}</p>"
        + tiles(numbers)
        + warnings_section(escape(printable(text)) for text in [*doubts, *summary.warnings])
        + figure_section("Path of the camera", "Metres, in the frame of the first camera. Drag to turn.", way)
        + figure_section("Tracking", "Against the keyframe of each frame.", course)
        + f"<section><h2>Facts</h2>{html_table(facts)}</section>"
    )
    return write_html(folder / "report.html", "direct odometry", body)
