"""The report of a bundle adjustment on lines: lines, points and cameras in space before and after, errors, course and facts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from boxplus._words import either
from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.manifolds import quaternion
from boxplus.report.optimization.bundle_scene import BundleScene, Viewpoint, frustum_lines
from boxplus.report.optimization.figures import FONT
from boxplus.report.optimization.page import write_optimization_page
from boxplus.report.optimization.plots import plain, write_optimization_plots
from boxplus.report.palette import GRID, INK, SERIES, STATUS
from boxplus.report.skeleton import figure_section, html_table
from boxplus.runs.optimization_summary import OptimizationSummary
from boxplus.systems.bundle_adjustment.line_adjustment import LineAdjustmentResult

Floats = NDArray[np.float64]

_LINE, _UNSURE, _POINT = SERIES[0], STATUS["lost"], "#9aa7b4"
_WORST = 12
_FRUSTUM = 0.03  # length of a camera's pyramid, as a share of the scene


def write_line_report(folder: Path, summary: OptimizationSummary, start: VggLines, result: LineAdjustmentResult) -> Path:
    """Write `report.html` and the pictures in `plots/` into a folder; returns the path of the report.

    Raises:
        OutputError: they cannot be written.
    """
    before, after = (_scene(data) for data in (start, result.data))
    view = Viewpoint.of(before, after)
    errors = (
        np.concatenate([result.errors_start, result.point_errors_start]),
        np.concatenate([result.errors, result.point_errors]),
    )
    pair = ((start, before), (result.data, after))
    write_optimization_plots(folder / "plots", _picture(pair, view, result), errors, "px", summary.history)
    sizes = summary.sizes
    numbers = [
        (
            f"{np.nanmedian(result.errors):.3g} px",
            f"ends of segments to their lines, median; {np.nanmedian(result.errors_start):.3g} before",
        ),
        (
            f"{sizes['lines']:,}",
            f"lines, seen {sizes['segments']:,} times; {int((~result.triangulation.found).sum())} not determined",
        ),
        (f"{sizes['cameras']:,}", "cameras"),
        (
            f"{summary.history[-1].number}",
            f"{either(summary.history[-1].number, 'step', 'steps')} in {summary.timing_s['total']:.2f} s",
        ),
    ]
    if len(result.point_errors):
        median = f"{np.nanmedian(result.point_errors):.3g} px"
        numbers.insert(
            1,
            (
                median,
                f"reprojection error of {sizes['points']:,} points, median; {np.nanmedian(result.point_errors_start):.3g} before",
            ),
        )
    text = (
        "Lines, points and cameras. Red lines are those that the segments do not determine: they were seen once, or from cameras "
        "that move along them. Drag to turn, scroll to zoom."
    )
    picture = figure_section("Before and after", text, _scenes(pair, view, result))
    return write_optimization_page(folder / "report.html", summary, numbers, picture, errors, "px", _worst_lines(result))


def _scene(data: VggLines) -> BundleScene:
    """The ends of the lines, and the points, as points of a scene."""
    R = quaternion.to_matrix(np.ascontiguousarray(data.T_camera_world[:, :4]))
    ends = data.end_points_world.reshape(-1, 3)
    points = np.concatenate([ends, data.points_world])
    return BundleScene(
        centers=-np.einsum("nji,nj->ni", R, data.T_camera_world[:, 4:]),
        forward=R[:, 2],
        up=-R[:, 1],
        points=points,
        point_errors=np.full(len(points), np.nan),
    )


def _paths(data: VggLines, rows: NDArray[np.bool_]) -> Floats:
    """(3 · rows, 3): both ends of every line, and NaN between the lines."""
    ends = data.end_points_world[rows].reshape(-1, 2, 3)
    return np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1).reshape(-1, 3)


def _scenes(pair: tuple[tuple[VggLines, BundleScene], ...], view: Viewpoint, result: LineAdjustmentResult) -> go.Figure:
    kind = {"type": "scene"}
    figure = make_subplots(rows=1, cols=2, specs=[[kind, kind]], subplot_titles=("before", "after"), horizontal_spacing=0.01)
    found = result.triangulation.found
    for column, (data, scene) in enumerate(pair, 1):
        for rows, color, name in ((found, _LINE, "lines"), (~found, _UNSURE, "lines, not determined")):
            x, y, z = _paths(data, rows).T
            line = {"color": color, "width": 4}
            figure.add_scatter3d(x=x, y=y, z=z, mode="lines", line=line, name=name, showlegend=column == 2, row=1, col=column)
        inside = view.inside(scene)[len(data.end_points_world) * 2 :]
        x, y, z = data.points_world[inside].T
        marker = {"size": 1.5, "color": _POINT}
        if inside.any():
            figure.add_scatter3d(
                x=x, y=y, z=z, mode="markers", marker=marker, name="points", showlegend=column == 2, row=1, col=column
            )
        pyramids = frustum_lines(scene, _FRUSTUM * float(np.linalg.norm(view.high - view.low))).reshape(-1, 3)
        x, y, z = pyramids.T
        line = {"color": INK, "width": 2}
        figure.add_scatter3d(
            x=x, y=y, z=z, mode="lines", line=line, name="cameras", showlegend=column == 2, hoverinfo="skip", row=1, col=column
        )
    eye = 1.2 * (-0.75 * view.depth + 0.6 * view.up + 0.25 * view.right)
    axis = {"backgroundcolor": "white", "gridcolor": GRID, "zerolinecolor": GRID, "showspikes": False}
    figure.update_scenes(
        aspectmode="data",
        dragmode="orbit",
        camera={"eye": _xyz(eye), "up": _xyz(view.up)},
        **{f"{name}axis": {**axis, "range": [float(view.low[k]), float(view.high[k])]} for k, name in enumerate("xyz")},
    )
    figure.update_layout(
        height=560, modebar={"orientation": "v"}, font=FONT, margin={"l": 0, "r": 0, "t": 30, "b": 0}, paper_bgcolor="white"
    )
    return figure


def _xyz(vector: Floats) -> dict[str, float]:
    return {name: float(value) for name, value in zip("xyz", vector, strict=True)}


def _picture(pair: tuple[tuple[VggLines, BundleScene], ...], view: Viewpoint, result: LineAdjustmentResult) -> Figure:
    """The same from above."""
    figure = Figure(figsize=(12.0, 6.2), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    found = result.triangulation.found
    for axes, (data, scene), title in zip(panels, pair, ("before", "after"), strict=True):
        axes.plot(data.points_world @ view.right, data.points_world @ view.depth, ".", color=_POINT, markersize=1.5)
        for rows, color in ((found, _LINE), (~found, _UNSURE)):
            path = _paths(data, rows)
            axes.plot(path @ view.right, path @ view.depth, color=color, linewidth=1.2)
        pyramids = frustum_lines(scene, _FRUSTUM * float(np.linalg.norm(view.high - view.low))).reshape(-1, 3)
        axes.plot(pyramids @ view.right, pyramids @ view.depth, color=INK, linewidth=0.7)
        axes.set_title(title, loc="left", fontsize=11)
        axes.set(aspect="equal", xlabel="to the right")
        plain(axes)
    panels[0].set_ylabel("away from the cameras")
    _, after = pair[1]
    shown = np.concatenate([after.points[view.inside(after)], after.centers])
    x, y = shown @ view.right, shown @ view.depth
    margin = 0.04 * max(float(np.ptp(x)), float(np.ptp(y)), 1e-9)
    panels[0].set(xlim=(x.min() - margin, x.max() + margin), ylim=(y.min() - margin, y.max() + margin))
    return figure


def _worst_lines(result: LineAdjustmentResult) -> str:
    """A table of the lines with the largest errors."""
    data, count = result.data, len(result.data.end_points_world)
    seen = np.isfinite(result.errors)
    times = np.bincount(data.line_of[seen], minlength=count)
    rms = np.sqrt(np.bincount(data.line_of[seen], result.errors[seen] ** 2, count) / np.maximum(times, 1))
    rows = []
    for line in np.argsort(-rms, kind="stable")[:_WORST]:
        largest = np.nanmax(result.errors[data.line_of == line]) if times[line] else np.nan
        angle = np.degrees(result.triangulation.angle[line])
        rows.append(
            (str(line), f"{rms[line]:.4g}", f"{largest:.4g}", str(times[line]), f"{angle:.2f}", result.triangulation.states[line])
        )
    heading = ("line", "rms [px]", "largest [px]", "segments", "angle between planes [deg]", "by triangulation")
    return f"<details open><summary>Lines with the largest errors</summary>{html_table(rows, heading)}</details>"
