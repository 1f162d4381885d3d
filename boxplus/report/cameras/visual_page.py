"""`report.html` and the pictures of a run with cameras."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure
from plotly.subplots import make_subplots

from boxplus.report import figures
from boxplus.report.cameras.visual_data import SummaryT, VisualData
from boxplus.report.page import evidence_table, headline, matrix_text, warning_lines, weak_table
from boxplus.report.palette import REJECTED, SERIES, shown_rows
from boxplus.report.plots import biases_picture, plain, status_strip, trajectory_picture, write_pictures
from boxplus.report.skeleton import figure_section, html_table, warnings_section, write_html
from boxplus.report.timeline import Timeline
from boxplus.runs.cameras.facts import FrameTiming
from boxplus.runs.run_facts import Distribution
from boxplus.runs.visual_inertial.summary import VioSummary


def write_visual_report(data: VisualData[VioSummary]) -> Path:
    """Draw `report.html` and the pictures in `plots/`; returns the path of the report.

    Raises:
        OutputError: they cannot be written.
    """
    way = f"{data.summary.path_length_m:.1f} m in {data.summary.duration_s:.1f} s, from above"
    pictures = (close_trajectory_picture(data, way), _tracked_picture(data), biases_picture(data))
    write_pictures(data.folder.plots, dict(zip(data.folder.pictures, pictures, strict=True)))
    return write_html(data.folder.report, Path(data.summary.recording.path).name, _body(data))


def _body(data: VisualData[VioSummary]) -> str:
    summary = data.summary
    landmarks = f"{len(data.map_points):,} of {summary.landmarks:,} landmarks, by height; the trajectory by status."
    states = (
        "ok; weak: the cameras saw too little, or something contradicts; lost: the IMU alone does not hold the pose any more."
    )
    parts = [
        _head(data),
        warnings_section(warning_lines(summary.warnings)),
        figure_section(
            "Landmarks and trajectory",
            f"{landmarks} Drag to turn, scroll to zoom, click in the legend to hide.",
            _map(data),
        ),
        figure_section(
            "Status and corners",
            f"{states} Below, the landmarks that each frame saw and that agree with it, and what was not used, by reason.",
            _tracked(data),
            weak_table(data.summary.weak_intervals, "frames"),
        ),
        figure_section("Biases", "With one standard deviation.", figures.biases(data)),
        figure_section("Velocity", "Of the IMU, along the world's axes.", figures.velocity(data)),
        figure_section(
            "Uncertainty", "Standard deviations of the pose, relative to position and yaw of the first.", figures.sigmas(data)
        ),
        figure_section("Timing", timing_text(data.summary.timing), figures.timing(data, "frame")),
        _start(data),
        _cameras(data),
        _facts(data),
    ]
    return "\n".join(parts)


def _head(data: VisualData[VioSummary]) -> str:
    summary = data.summary
    frame = summary.timing.frame_ms
    numbers = [
        (f"{summary.frames}", f"frames, {summary.keyframes} of them keyframes"),
        (f"{summary.path_length_m:.2f} m", f"path in {summary.duration_s:.1f} s"),
        (f"{summary.status.get('ok', 0) / max(summary.frames, 1):.1%}", "of the frames ok"),
        *timing_tiles(frame),
        (f"{summary.landmarks:,}", f"landmarks, and {summary.lines:,} lines" if summary.lines else "landmarks"),
        *_length_tile(summary),
        *accuracy_tiles(data.evaluation),
    ]
    return headline(summary, summary.recording.path, summary.recording.format, numbers)


def _length_tile(summary: VioSummary) -> list[tuple[str, str]]:
    if summary.lengths is None:
        return []
    longer, sigma = summary.lengths.longer, summary.lengths.sigma
    if longer is None or sigma is None:
        return [("lengths?", "the IMU does not tell them: too little acceleration")]
    return [(f"{longer:+.1%} ± {sigma:.1%}", "lengths by the cameras, against the IMU's")]


def _map(data: VisualData[VioSummary]) -> go.Figure:
    """Landmarks, lines and trajectory."""
    figure = figures.map_and_trajectory(data)
    if len(data.map_lines):
        gaps = np.full((len(data.map_lines), 3), np.nan)
        x, y, z = np.stack([data.map_lines[:, :3], data.map_lines[:, 3:], gaps], axis=1).reshape(-1, 3).T
        line = {"color": SERIES[0], "width": 2.5}
        figure.add_scatter3d(x=x, y=y, z=z, mode="lines", name="lines", hoverinfo="skip", line=line)
    return figure


def timing_tiles(frame: Distribution | None) -> list[tuple[str, str]]:
    """Milliseconds per frame."""
    if frame is None:
        return []
    return [(f"{frame.median:.1f} ms", f"median per frame, mean {frame.mean:.1f} ms, 99th percentile {frame.p99:.1f} ms")]


def accuracy_tiles(evaluation: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """The error, where there is a ground truth."""
    if evaluation is None:
        return []
    aligned = {"yaw": "position and yaw", "se3": "position and rotation", "sim3": "position, rotation and scale"}
    rmse = 100.0 * float(evaluation["ate_translation_m"]["rmse"])
    return [(f"{rmse:.2f} cm", f"ATE (rmse), {aligned[evaluation['alignment']['kind']]} aligned")]


def _tracked(data: VisualData[VioSummary]) -> go.Figure:
    """The status, and the corners of every frame: used, and rejected by reason."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, row_heights=[0.1, 0.9], vertical_spacing=0.03)
    rows = shown_rows(data)
    figures.add_status(figure, data, rows)
    figures.add_area(figure, data, rows, data.log.column("tracked"), "agree", SERIES[0], "%{y:.0f} landmarks", row=2)
    lines = data.log.column("lines_tracked")
    if lines.any():
        figures.add_line(figure, data.seconds[rows], lines[rows], "lines that agree", SERIES[3], row=2)
    for color, (reason, count) in zip(cycle(REJECTED), data.log.pairs("rejected").items(), strict=False):
        figures.add_area(figure, data, rows, count, f"rejected: {reason}", color, "%{y:.0f} corners", row=2)
    figure.update_yaxes(title_text="corners", rangemode="tozero", row=2, col=1)
    return figures.over_time(figure, data, 380, bottom_row=2)


def close_trajectory_picture(data: Timeline, title: str) -> Figure:
    """From above, as far around the path as it is long: landmarks may lie much farther."""
    figure = trajectory_picture(data, title)
    low, high = data.position[:, :2].min(axis=0), data.position[:, :2].max(axis=0)
    middle, half = 0.5 * (low + high), max(1.2 * float((high - low).max()), 0.5)
    figure.axes[0].set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    return figure


def _tracked_picture(data: VisualData[VioSummary]) -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    strip, axes = figure.subplots(2, 1, sharex=True, height_ratios=[0.12, 1.0])
    rows = shown_rows(data)
    status_strip(strip, data, rows)
    layers = {"agree": data.log.column("tracked"), **data.log.pairs("rejected")}
    colors = [SERIES[0], *(REJECTED[index % len(REJECTED)] for index in range(len(layers) - 1))]
    axes.stackplot(
        data.seconds[rows],
        [np.asarray(values)[rows] for values in layers.values()],
        labels=list(layers),
        colors=colors,
        linewidth=0,
    )
    axes.legend(ncols=2, loc="lower right", fontsize=8, framealpha=0.9)
    axes.set(xlabel="time since the first estimate [s]", ylabel="corners")
    axes.margins(x=0.0)
    plain(axes)
    return figure


def timing_text(timing: FrameTiming) -> str:
    """Where the time went, in words."""
    text = (
        f"The odometry's time per frame by stage. In all {timing.total_s:.1f} s: {timing.odometry_s:.1f} s odometry, "
        f"{timing.reading_s:.1f} s waiting for the reader, {timing.writing_s:.1f} s writing."
    )
    if timing.compiled_kernels:
        text += f" {timing.compiled_kernels} kernels were compiled during the run (first use only), which the times include."
    return text


def _start(data: VisualData[VioSummary]) -> str:
    summary = data.summary
    if summary.start is None:
        return ""
    rows = [(name, f"{value:.3g}") for name, value in summary.start_facts.items()]
    text = (
        f"{summary.start.kind}, after {summary.frames_before_start} frames without a state. The numbers of the tests that it "
        "has passed:"
    )
    return f"<section><h2>Start</h2><p>{escape(text)}</p>{html_table(rows)}</section>"


def _cameras(data: VisualData[VioSummary]) -> str:
    parts = []
    for camera in data.summary.cameras:
        matrices = f"<td><pre>{matrix_text(camera.T_imu_camera_start)}</pre></td>"
        head = "<th>T_imu_camera as given</th>"
        if camera.T_imu_camera_end is not None and camera.T_imu_camera_end != camera.T_imu_camera_start:
            matrices += f"<td><pre>{matrix_text(camera.T_imu_camera_end)}</pre></td>"
            head += "<th>refined, at the end</th>"
        sources = "; ".join(f"{name} {source}" for name, source in camera.sources.items())
        text = f"{camera.name}: {camera.model}, {camera.width}×{camera.height}, {camera.images} images; {sources}"
        parts.append(f"<p>{escape(text)}</p><table><tr>{head}</tr><tr>{matrices}</tr></table>")
    return f"<section><h2>Cameras</h2>{''.join(parts)}</section>"


def _facts(data: VisualData[VioSummary]) -> str:
    summary = data.summary
    recording = summary.recording
    rows: list[tuple[str, ...]] = [
        ("recording", recording.path),
        ("IMU", f"{recording.imu}, {summary.imu_samples_read} samples"),
    ]
    return run_section(data, rows)


def run_section(data: VisualData[SummaryT], rows: list[tuple[str, ...]]) -> str:
    """What was not used, the facts of the run, and how the recording was read."""
    summary = data.summary
    rejected = [(place, reason, f"{count:,}") for place, counts in summary.rejected.items() for reason, count in counts.items()]
    table = html_table(rejected, ("where", "rejected because", "count")) or "<p>Nothing was rejected.</p>"
    memory = f"{summary.peak_memory_mb:.0f} MB at most" if summary.peak_memory_mb is not None else "–"
    versions = ", ".join(f"{name} {version}" for name, version in summary.versions.items())
    facts = html_table([*rows, ("memory", memory), ("versions", versions)])
    return (
        f"<section><h2>Rejections</h2>{table}</section><section><h2>Run</h2>{facts}</section>"
        f"{evidence_table(summary.recording.evidence, data.folder.config)}"
    )
