"""Pictures of any optimisation as PNG files, for papers and tickets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from boxplus.formats.output import atomic_file, make_folder
from boxplus.report.optimization.figures import AFTER, BEFORE, counts_per_bin, error_bins
from boxplus.report.palette import FAINT, GRID, SERIES
from boxplus.runs.optimization_summary import PLOTS, IterationFacts

_DPI = 130


def write_optimization_plots(
    folder: Path,
    picture: Figure,
    errors: tuple[NDArray[np.float64], NDArray[np.float64]],
    unit: str,
    history: list[IterationFacts],
) -> None:
    """Write `PLOTS` into a folder, which is made.

    Args:
        picture: what it looks like before and after.
        errors: before and after, (k,) each, NaN where invalid.

    Raises:
        OutputError: they cannot be written.
    """
    make_folder(folder)
    for name, figure in zip(PLOTS, (picture, _histogram(*errors, unit), _cost(history)), strict=True):
        with atomic_file(folder / name) as file:
            figure.savefig(file, format="png", dpi=_DPI)


def _histogram(before: NDArray[np.float64], after: NDArray[np.float64], unit: str) -> Figure:
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    axes = figure.subplots()
    edges = error_bins(before, after)
    for name, errors, color in (("before", before, BEFORE), ("after", after, AFTER)):
        axes.stairs(counts_per_bin(errors, edges), edges, color=color, linewidth=1.6, label=name)
        valid = errors[np.isfinite(errors)]
        if len(valid):
            median = float(np.median(valid))
            axes.axvline(median, color=color, linestyle=":", linewidth=1.2, label=f"median {median:.3g} {unit}")
    axes.set(xscale="log", yscale="log", xlabel=f"error [{unit}]", ylabel="how many")
    axes.legend(fontsize=9, frameon=False)
    plain(axes)
    return figure


def _cost(history: list[IterationFacts]) -> Figure:
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.plot([i.number for i in history], [i.cost for i in history], color=SERIES[0], marker="o", markersize=4, label="cost")
    rejected = [i for i in history if not i.accepted and i.tried_cost is not None]
    if rejected:
        costs = [i.cost for i in history if i.cost > 0.0] or [1.0]
        top = max(costs) * (max(costs) / min(costs)) ** 0.1  # steps that led further up are drawn at the upper edge
        steps, tried = [i.number for i in rejected], [min(i.tried_cost or top, top) for i in rejected]
        axes.plot(steps, tried, "x", color=SERIES[4], label="tried and rejected")
    axes.set(yscale="log" if any(i.cost > 0.0 for i in history) else "linear", xlabel="step", ylabel="cost")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(fontsize=9, frameon=False)
    plain(axes)
    return figure


def plain(axes: Axes) -> None:
    """The look of all axes."""
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=FAINT, labelsize=9)
