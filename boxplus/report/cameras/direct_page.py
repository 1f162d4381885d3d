"""`report.html` and the pictures of a run of direct odometry."""

from __future__ import annotations

from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure
from plotly.subplots import make_subplots

from boxplus.report import figures
from boxplus.report.cameras.visual_data import VisualData
from boxplus.report.cameras.visual_page import accuracy_tiles, close_trajectory_picture, run_section, timing_text, timing_tiles
from boxplus.report.page import headline, warning_lines, weak_table
from boxplus.report.palette import SERIES, shown_rows
from boxplus.report.plots import plain, status_strip, write_pictures
from boxplus.report.skeleton import figure_section, warnings_section, write_html
from boxplus.runs.direct.summary import DirectSummary

Run = VisualData[DirectSummary]


def write_direct_report(data: Run) -> Path:
    """Draw `report.html` and the pictures in `plots/`; returns the path of the report.

    Raises:
        OutputError: they cannot be written.
    """
    write_pictures(
        data.folder.plots, dict(zip(data.folder.pictures, (_trajectory_picture(data), _residual_picture(data)), strict=True))
    )
    return write_html(data.folder.report, Path(data.summary.recording.path).name, _body(data))


def _body(data: Run) -> str:
    summary, is_metric = data.summary, data.summary.scale == "metric"
    states = "ok; weak: there is a reason to doubt the pose; lost: no pose follows from the image, the last one is repeated."
    parts = [
        _head(data),
        warnings_section(warning_lines(summary.warnings)),
        figure_section(
            "Landmarks and trajectory",
            f"{len(data.map_points):,} of {summary.landmarks:,} points of keyframes whose depth is known to a tenth, to the "
            "right of the first camera (x), ahead of it (z) and up (−y). Drag to turn, scroll to zoom, click in the legend to "
            "hide.",
            figures.map_and_trajectory(_upright(data), "m" if is_metric else "unit", ("right", "ahead", "up")),
        ),
        figure_section(
            "Status and residuals",
            f"{states} Below, each frame against its keyframe: the standard deviation of the residuals, the share of the "
            "keyframe that is seen, and the gain of its grey values.",
            _course(data),
            weak_table(summary.weak_intervals, "frames"),
        ),
        figure_section(
            "Uncertainty",
            "Standard deviations of the pose, relative to the first; they grow with the way.",
            figures.sigmas(data, "cm" if is_metric else "% of the unit"),
        ),
        figure_section("Timing", timing_text(summary.timing), figures.timing(data, "frame")),
        _streams(data),
        run_section(data, [("recording", summary.recording.path), ("kind", summary.kind)]),
    ]
    return "\n".join(parts)


def _head(data: Run) -> str:
    summary = data.summary
    is_metric = summary.scale == "metric"
    numbers = [
        (f"{summary.frames}", f"frames, {summary.keyframes} of them keyframes"),
        (
            f"{summary.path_length_m:.2f} m" if is_metric else f"{summary.path_length_m:.2f}",
            f"path in {summary.duration_s:.1f} s",
        ),
        *([] if is_metric else [("unknown", "scale: lengths in units of about the first view's median depth")]),
        (f"{summary.status.get('ok', 0) / max(summary.frames, 1):.1%}", "of the frames ok"),
        *timing_tiles(summary.timing.frame_ms),
        (f"{summary.landmarks:,}", "landmarks"),
        *accuracy_tiles(data.evaluation),
    ]
    return headline(summary, summary.recording.path, summary.recording.format, numbers)


def _course(data: Run) -> go.Figure:
    """Status, residuals, overlap and gain over time."""
    figure = make_subplots(rows=4, cols=1, shared_xaxes=True, row_heights=[0.1, 0.3, 0.3, 0.3], vertical_spacing=0.03)
    rows = shown_rows(data)
    figures.add_status(figure, data, rows)
    overlap, gain = 100.0 * data.log.column("overlap"), 100.0 * np.exp(data.log.column("a"))
    for row, (name, values, unit) in enumerate(
        (("σ of residuals", data.log.column("sigma"), "grey"), ("overlap", overlap, "overlap %"), ("gain", gain, "gain %")), 2
    ):
        figures.add_line(figure, data.seconds[rows], values[rows], name, SERIES[row - 2], row=row)
        figure.update_yaxes(title_text=unit, row=row, col=1)
    return figures.over_time(figure, data, 460, bottom_row=4)


def _streams(data: Run) -> str:
    lines = []
    for stream in data.summary.cameras:
        sources = "; ".join(f"{name} {source}" for name, source in stream.sources.items())
        text = f"{stream.use}: {stream.name}, {stream.model}, {stream.width}×{stream.height}, {stream.images} images; {sources}"
        lines.append(f"<p>{escape(text)}</p>")
    return f"<section><h2>Cameras</h2>{''.join(lines)}</section>"


def _upright(data: Run) -> Run:
    """To the right of the first camera, ahead of it and up, where it has x to the right, y down and z ahead."""
    turned = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return replace(data, position=data.position @ turned, map_points=(data.map_points @ turned).astype(np.float32))


def _trajectory_picture(data: Run) -> Figure:
    """From above, for a first camera that looks ahead."""
    summary = data.summary
    figure = close_trajectory_picture(
        _upright(data), f"{summary.path_length_m:.2f} {summary.length_unit} in {summary.duration_s:.1f} s, from above"
    )
    figure.axes[0].set(xlabel="x, to the right of the first camera", ylabel="z, ahead of it")
    return figure


def _residual_picture(data: Run) -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    strip, axes = figure.subplots(2, 1, sharex=True, height_ratios=[0.12, 1.0])
    rows = shown_rows(data)
    status_strip(strip, data, rows)
    axes.plot(data.seconds[rows], data.log.column("sigma")[rows], color=SERIES[0], linewidth=1.2)
    axes.set(xlabel="time since the first estimate [s]", ylabel="σ of residuals [grey values]")
    axes.margins(x=0.0)
    plain(axes)
    return figure
