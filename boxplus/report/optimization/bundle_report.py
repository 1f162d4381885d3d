"""The report of a bundle adjustment: the scene before and after, reprojection errors, course and facts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from plotly.subplots import make_subplots

from boxplus._words import either
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.report.optimization.bundle_scene import BundleScene, Viewpoint, frustum_lines, scene_of
from boxplus.report.optimization.figures import FONT
from boxplus.report.optimization.page import write_optimization_page
from boxplus.report.optimization.plots import plain, write_optimization_plots
from boxplus.report.palette import GRID, INK
from boxplus.report.skeleton import figure_section, html_table
from boxplus.runs.optimization_summary import OptimizationSummary
from boxplus.systems.bundle_adjustment.bundle_adjustment import BundleAdjustmentResult

ERROR_COLORS = ("#c3cdd7", "#7fa3c7", "#3a6fb0", "#dd9000", "#a03070")  # from small and quiet to large
"""Of points, from small errors to large ones."""
_WORST = 12
_FRUSTUM = 0.015  # length of a camera's pyramid, as a share of the scene


def write_bundle_report(
    folder: Path, summary: OptimizationSummary, start: Reconstruction, result: BundleAdjustmentResult
) -> Path:
    """Write `report.html` and the pictures in `plots/` into a folder; returns the path of the report.

    Raises:
        OutputError: they cannot be written.
    """
    before = scene_of(start, result.errors_start, result.point_of)
    after = scene_of(result.reconstruction, result.errors, result.point_of)
    view = Viewpoint.of(before, after)
    errors = (result.errors_start, result.errors)
    write_optimization_plots(folder / "plots", _picture(before, after, view), errors, "px", summary.history)
    sizes = summary.sizes
    numbers = [
        (f"{summary.errors.rms:.3g} px", f"reprojection error (rms), {summary.errors_initial.rms:.3g} px before"),
        (f"{summary.errors.median:.3g} px", f"median, {summary.errors_initial.median:.3g} px before"),
        (f"{summary.cost:.7g}", f"cost, {summary.cost_initial:.4g} before"),
        (
            f"{summary.history[-1].number}",
            f"{either(summary.history[-1].number, 'step', 'steps')} in {summary.timing_s['total']:.2f} s",
        ),
        (f"{sizes['cameras']:,}", "cameras"),
        (f"{sizes['points']:,}", f"points, seen {sizes['observations']:,} times"),
    ]
    inside = [f"{view.inside(scene).mean():.0%}" for scene in (before, after)]
    text = (
        f"Cameras, and the points within the box that holds nearly all of them at the end ({inside[0]} of the points before, "
        f"{inside[1]} after), coloured by the mean error of their observations. Drag to turn, scroll to zoom."
    )
    picture = figure_section("Before and after", text, _scenes(before, after, view))
    page = folder / "report.html"
    return write_optimization_page(page, summary, numbers, picture, errors, "px", _worst_cameras(result))


def _scenes(before: BundleScene, after: BundleScene, view: Viewpoint) -> go.Figure:
    """Two scenes side by side, seen from behind and above the cameras."""
    kind = {"type": "scene"}
    figure = make_subplots(rows=1, cols=2, specs=[[kind, kind]], subplot_titles=("before", "after"), horizontal_spacing=0.01)
    low, high = (float(np.log10(bound)) for bound in view.error_range)
    ticks = np.arange(np.ceil(low), np.floor(high) + 1)
    for column, scene in enumerate((before, after), 1):
        rows = view.shown(scene)
        points, shown = scene.points[rows], scene.point_errors[rows]
        marker = {
            "size": 1.6,
            "color": np.log10(np.maximum(shown, 1e-9)),
            "colorscale": list(ERROR_COLORS),
            "cmin": low,
            "cmax": high,
            "showscale": column == 2,
            "colorbar": {
                "title": {"text": "error [px]", "side": "right"},
                "thickness": 12,
                "len": 0.5,
                "y": 0.35,
                "tickvals": list(ticks),
                "ticktext": [f"{10.0**tick:g}" for tick in ticks],
            },
        }
        figure.add_scatter3d(
            x=points[:, 0],
            y=points[:, 1],
            z=points[:, 2],
            mode="markers",
            marker=marker,
            customdata=shown,
            hovertemplate="%{customdata:.3g} px<extra></extra>",
            showlegend=False,
            row=1,
            col=column,
        )
        pyramids = frustum_lines(scene, _FRUSTUM * float(np.linalg.norm(view.high - view.low))).reshape(-1, 3)
        figure.add_scatter3d(
            x=pyramids[:, 0],
            y=pyramids[:, 1],
            z=pyramids[:, 2],
            mode="lines",
            line={"color": INK, "width": 2},
            hoverinfo="skip",
            showlegend=False,
            row=1,
            col=column,
        )
    eye = 1.2 * (-0.75 * view.depth + 0.6 * view.up + 0.25 * view.right)
    axis = {"backgroundcolor": "white", "gridcolor": GRID, "zerolinecolor": GRID, "showspikes": False}
    layout = {
        "aspectmode": "manual",
        "aspectratio": _xyz((view.high - view.low) / (view.high - view.low).max()),
        "dragmode": "orbit",
        "camera": {"eye": _xyz(eye), "up": _xyz(view.up)},
        **{
            f"{name}axis": {**axis, "title": {"text": name}, "range": [float(view.low[k]), float(view.high[k])]}
            for k, name in enumerate("xyz")
        },
    }
    figure.update_scenes(layout)
    figure.update_layout(
        height=560, modebar={"orientation": "v"}, font=FONT, margin={"l": 0, "r": 0, "t": 30, "b": 0}, paper_bgcolor="white"
    )
    return figure


def _xyz(vector: np.ndarray) -> dict[str, float]:  # type: ignore[type-arg]
    return {name: float(value) for name, value in zip("xyz", vector, strict=True)}


def _picture(before: BundleScene, after: BundleScene, view: Viewpoint) -> Figure:
    """The same from above."""
    figure = Figure(figsize=(12.0, 6.2), layout="constrained")
    colors = LinearSegmentedColormap.from_list("errors", ERROR_COLORS)
    norm = LogNorm(*view.error_range)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    shown = None
    for axes, scene, title in zip(panels, (before, after), ("before", "after"), strict=True):
        rows = view.shown(scene)
        rows = rows[np.argsort(-(scene.points[rows] @ view.up))[::-1]]
        x, y = _flat(scene.points[rows], view)
        color = {"c": np.maximum(scene.point_errors[rows], 1e-9), "cmap": colors, "norm": norm}
        shown = axes.scatter(x, y, s=float(np.clip(4e4 / max(len(rows), 1), 0.8, 8.0)), linewidths=0, **color)
        _draw_cameras(axes, scene, view)
        axes.set_title(title, loc="left", fontsize=11)
        axes.set(aspect="equal", xlabel="to the right")
        plain(axes)
    panels[0].set_ylabel("away from the cameras")
    corners = np.array([[view.low[0], view.low[1], view.low[2]], [view.high[0], view.high[1], view.high[2]]])
    box = np.array(np.meshgrid(*corners.T)).reshape(3, -1).T
    inside = np.concatenate([after.points[view.shown(after)], after.centers]) if len(after.points) else box
    x, y = _flat(inside, view)
    margin = 0.03 * max(float(np.ptp(x)), float(np.ptp(y)), 1e-9)
    panels[0].set(xlim=(x.min() - margin, x.max() + margin), ylim=(y.min() - margin, y.max() + margin))
    if shown is not None:
        figure.colorbar(shown, ax=panels, label="mean reprojection error of a point [px]", shrink=0.7, aspect=30)
    return figure


def _draw_cameras(axes: Axes, scene: BundleScene, view: Viewpoint) -> None:
    size = _FRUSTUM * float(np.linalg.norm(view.high - view.low))
    lines = frustum_lines(scene, size).reshape(-1, 3)
    axes.plot(*_flat(lines, view), color=INK, linewidth=0.7)


def _flat(points: np.ndarray, view: Viewpoint) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    return points @ view.right, points @ view.depth


def _worst_cameras(result: BundleAdjustmentResult) -> str:
    """A table of the cameras with the largest errors."""
    count = int(result.camera_of.max(initial=-1)) + 1
    seen = np.isfinite(result.errors)
    times = np.bincount(result.camera_of, minlength=count)
    valid = np.bincount(result.camera_of[seen], minlength=count)
    squared = np.bincount(result.camera_of[seen], result.errors[seen] ** 2, count)
    rms = np.sqrt(squared / np.maximum(valid, 1))
    names = getattr(result.reconstruction, "image_names", None)
    rows = []
    for camera in np.argsort(-rms, kind="stable")[:_WORST]:
        largest = np.nanmax(result.errors[result.camera_of == camera]) if valid[camera] else np.nan
        label = str(camera) if names is None else str(names[camera])
        rows.append((label, f"{rms[camera]:.4g}", f"{largest:.4g}", f"{times[camera]:,}", str(times[camera] - valid[camera])))
    heading = ("camera", "rms [px]", "largest [px]", "observations", "not valid")
    return f"<details open><summary>Cameras with the largest errors</summary>{html_table(rows, heading)}</details>"
