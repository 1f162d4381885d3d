"""The report of a pose graph: poses and edges before and after, errors of the edges, course and facts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from boxplus._words import either
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.report.optimization.figures import FONT
from boxplus.report.optimization.page import write_optimization_page
from boxplus.report.optimization.plots import plain, write_optimization_plots
from boxplus.report.palette import FAINT, GRID, SERIES
from boxplus.report.skeleton import figure_section, html_table
from boxplus.runs.optimization_summary import OptimizationSummary
from boxplus.systems.pose_graph.pose_graph import PoseGraphResult
from boxplus.systems.pose_graph.problem import positions

_WORST = 15
_WORST_SHARE = 0.01
"""Share of the edges with the largest errors, drawn apart."""
_CHAIN, _LOOP, _LARGE = SERIES[0], "#a9b5c1", SERIES[4]
_KINDS = (
    ("edges to other poses", _LOOP, 1.0),
    ("edges to the next pose", _CHAIN, 2.0),
    ("largest 1 % of the errors", _LARGE, 2.0),
)


def write_graph_report(folder: Path, summary: OptimizationSummary, graph: PoseGraph, result: PoseGraphResult) -> Path:
    """Write `report.html` and the pictures in `plots/` into a folder; returns the path of the report.

    Args:
        graph: as it was read.

    Raises:
        OutputError: they cannot be written.
    """
    panels = _panels(graph, result)
    errors = (result.errors_before, result.errors)
    where = "at the start" if graph.poses is None else "in the file"
    write_optimization_plots(folder / "plots", _picture(graph, panels, result.errors), errors, "σ", summary.history)
    steps, last = summary.history[-1].number, " of the last solve, all" if summary.is_last_of_several else ""
    numbers = [
        (f"{result.chi2:.7g}", f"χ², {summary.chi2_initial:.5g} {where}"),
        (f"{summary.errors.median:.3g} σ", f"median edge error, {summary.errors_initial.median:.3g} σ {where}"),
        (result.start.replace("_", " "), "start taken"),
        (f"{steps}", f"{either(steps, 'step', 'steps')}{last} in {summary.timing_s['optimisation']:.2f} s"),
        (f"{len(graph.ids):,}", "poses"),
        (f"{len(graph.edges):,}", "edges"),
    ]
    text = (
        "Positions of the poses and the edges between them. The edges with the largest errors after the optimisation are drawn "
        "apart in red. " + ("Drag to turn, scroll to zoom." if graph.dimension == 3 else "Drag to zoom, double-click to return.")
    )
    draw = _scenes if graph.dimension == 3 else _planes
    picture = figure_section("Before and after", text, draw(graph, panels, result.errors))
    page = folder / "report.html"
    return write_optimization_page(page, summary, numbers, picture, errors, "σ", _worst_edges(graph, result))


def _panels(graph: PoseGraph, result: PoseGraphResult) -> list[tuple[str, NDArray[np.float64]]]:
    """Title and positions of what is drawn side by side."""
    if graph.poses is None:
        before = (f"start: {result.start.replace('_', ' ')}, the file has no poses", positions(graph, result.poses_start))
    else:
        before = ("before: in the file", positions(graph, graph.poses))
    return [before, ("after", positions(graph, result.graph.poses if result.graph.poses is not None else result.poses_start))]


def _kinds(graph: PoseGraph, errors: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """(m, 2) edges of each of `_KINDS`."""
    chain = np.abs(np.diff(graph.ids[graph.edges], axis=1)[:, 0]) == 1
    large = np.zeros(len(errors), dtype=np.bool_)
    large[np.argsort(-errors, kind="stable")[: int(np.ceil(_WORST_SHARE * len(errors)))]] = True
    large &= errors > 2.0 * np.median(errors)
    return [graph.edges[rows] for rows in (~chain & ~large, chain & ~large, large)]


def _lines(xyz: NDArray[np.float64], edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """(3 m, 3) a line through all edges, with NaN between them."""
    return np.stack([xyz[edges[:, 0]], xyz[edges[:, 1]], np.full((len(edges), 3), np.nan)], axis=1).reshape(-1, 3)


def _scenes(graph: PoseGraph, panels: list[tuple[str, NDArray[np.float64]]], errors: NDArray[np.float64]) -> go.Figure:
    """Scenes in 3D side by side."""
    specs = [[{"type": "scene"}] * len(panels)]
    titles = [title for title, _ in panels]
    figure = make_subplots(rows=1, cols=len(panels), specs=specs, subplot_titles=titles, horizontal_spacing=0.01)
    for column, (_, xyz) in enumerate(panels, 1):
        for (name, color, width), edges in zip(_KINDS, _kinds(graph, errors), strict=True):
            line = _lines(xyz, edges)
            figure.add_scatter3d(
                x=line[:, 0],
                y=line[:, 1],
                z=line[:, 2],
                mode="lines",
                name=name,
                legendgroup=name,
                showlegend=column == 1,
                line={"color": color, "width": width},
                hoverinfo="skip",
                row=1,
                col=column,
            )
    axis = {"backgroundcolor": "white", "gridcolor": GRID, "zerolinecolor": GRID, "showspikes": False, "nticks": 5}
    far = 0.75 + 0.15 * len(panels)  # narrow panels need distance
    eye = {"x": -0.8 * far, "y": -1.0 * far, "z": 0.7 * far}
    scene = {"aspectmode": "manual", "dragmode": "orbit", "camera": {"eye": eye}}
    figure.update_scenes({**scene, **{f"{name}axis": {**axis, "title": {"text": f"{name} [m]"}} for name in "xyz"}})
    for column, (_, xyz) in enumerate(panels, 1):
        extent = np.maximum(np.ptp(xyz, axis=0), 1e-3 * max(float(np.ptp(xyz, axis=0).max()), 1e-9))
        ratio = {name: float(value) for name, value in zip("xyz", extent / extent.max(), strict=True)}
        figure.update_scenes(aspectratio=ratio, row=1, col=column)
    return _framed(figure, 560 if len(panels) < 3 else 440, True)


def _planes(graph: PoseGraph, panels: list[tuple[str, NDArray[np.float64]]], errors: NDArray[np.float64]) -> go.Figure:
    """The plane, side by side."""
    figure = make_subplots(rows=1, cols=len(panels), subplot_titles=[title for title, _ in panels], horizontal_spacing=0.06)
    for column, (_, xyz) in enumerate(panels, 1):
        for (name, color, width), edges in zip(_KINDS, _kinds(graph, errors), strict=True):
            line = _lines(xyz, edges)
            figure.add_scatter(
                x=line[:, 0],
                y=line[:, 1],
                mode="lines",
                name=name,
                legendgroup=name,
                showlegend=column == 1,
                line={"color": color, "width": 0.7 * width},
                hoverinfo="skip",
                row=1,
                col=column,
            )
        along = f"x{column}" if column > 1 else "x"
        figure.update_yaxes(scaleanchor=along, scaleratio=1, gridcolor=GRID, zeroline=False, row=1, col=column)
        figure.update_xaxes(gridcolor=GRID, zeroline=False, title_text="x [m]", constrain="domain", row=1, col=column)
    figure.update_yaxes(title_text="y [m]", row=1, col=1)
    figure.update_layout(plot_bgcolor="white")
    return _framed(figure, 480, False)


def _framed(figure: go.Figure, height: int, is_3d: bool) -> go.Figure:
    figure.update_layout(
        height=height,
        modebar={"orientation": "v"},
        font=FONT,
        paper_bgcolor="white",
        margin={"l": 60, "r": 10, "t": 30, "b": 30},
        legend={"orientation": "h", "y": -0.02 if is_3d else -0.14, "yanchor": "top", "x": 0.0, "itemsizing": "constant"},
    )
    return figure


def _picture(graph: PoseGraph, panels: list[tuple[str, NDArray[np.float64]]], errors: NDArray[np.float64]) -> Figure:
    """The panels as a picture, in 3D seen obliquely."""
    figure = Figure(figsize=(6.0 * len(panels), 6.4))
    figure.set_layout_engine("constrained", rect=(0.0, 0.05, 1.0, 0.94))
    projection = {"projection": "3d"} if graph.dimension == 3 else {}
    for number, (title, xyz) in enumerate(panels, 1):
        axes = figure.add_subplot(1, len(panels), number, **projection)
        for (name, color, width), edges in zip(_KINDS, _kinds(graph, errors), strict=True):
            if not len(edges):
                continue
            if graph.dimension == 3:
                line = _lines(xyz, edges)
                axes.plot(line[:, 0], line[:, 1], line[:, 2], color=color, linewidth=0.4 * width, label=name)
            else:
                axes.add_collection(LineCollection(list(xyz[edges][:, :, :2]), colors=color, linewidths=0.5 * width, label=name))
        axes.set_title(title, loc="left", fontsize=11)
        axes.set(xlabel="x [m]", ylabel="y [m]")
        if graph.dimension == 3:
            axes.set_aspect("equal")
            axes.set(zlabel="z [m]")
            axes.tick_params(colors=FAINT, labelsize=8)
        else:
            axes.autoscale()
            axes.set_aspect("equal")
            plain(axes)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _worst_edges(graph: PoseGraph, result: PoseGraphResult) -> str:
    """A table of the edges with the largest errors."""
    rows = []
    for edge in np.argsort(-result.errors, kind="stable")[:_WORST]:
        i, j = graph.ids[graph.edges[edge]]
        rows.append((f"{i} → {j}", f"{result.errors[edge]:.4g}", f"{result.errors_before[edge]:.4g}", str(edge)))
    table = html_table(rows, ("edge between", "after [σ]", "before [σ]", "number in the file"))
    return f"<details open><summary>Edges with the largest errors</summary>{table}</details>"
