"""Pictures of an evaluation: the trajectories, the errors over time, and which stamps were matched."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.evaluation.evaluation import Evaluation
from boxplus.evaluation.statistics import rms
from boxplus.formats.output import atomic_file, make_folder
from boxplus.formats.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRUTH = "#222222"
_ESTIMATE, _MUTED = "#1f5fa8", "#b0b0b0"


def write_plots(evaluation: Evaluation, folder: str | Path, estimate: Trajectory, ground_truth: Trajectory) -> list[Path]:
    """Draw `trajectories.png`, `errors.png` and, for stamped trajectories, `association.png` into a folder.

    Args:
        evaluation: what `evaluate` returned.
        folder: created where it does not exist.
        estimate, ground_truth: what was compared, all poses.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    figures = {"trajectories": _trajectories(evaluation, ground_truth), "errors": _errors(evaluation)}
    if evaluation.association.method != "index":
        figures["association"] = _association(evaluation, estimate, ground_truth)
    return save_figures(figures, folder)


def save_figures(figures: dict[str, Figure], folder: str | Path) -> list[Path]:
    """Write `NAME.png` for every figure into a folder, which is created where it does not exist.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    base, paths = make_folder(folder), []
    for name, figure in figures.items():
        path = base / f"{name}.png"
        with atomic_file(path) as file:
            figure.savefig(file, format="png", dpi=120)
        paths.append(path)
    return paths


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> Figure:
    """A figure of that size [inches] with empty axes, drawn without any window."""
    agg = require("matplotlib.backends.backend_agg", "which draws plots")
    figure: Figure = require("matplotlib.figure", "which draws plots").Figure(figsize=size, layout="constrained")
    agg.FigureCanvasAgg(figure)
    for axes in np.ravel(figure.subplots(rows, columns)):
        axes.grid(color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _trajectories(evaluation: Evaluation, ground_truth: Trajectory) -> Figure:
    """From above and from the side, the estimate coloured by its error."""
    figure = new_figure(1, 2, (13.0, 6.0))
    aligned, truth = evaluation.aligned, evaluation.truth
    for axes, (a, b) in zip(figure.axes, ((0, 1), (0, 2)), strict=True):
        whole, index = ground_truth.p, truth.p
        axes.plot(whole[:, a], whole[:, b], color=_MUTED, linewidth=1.0, label="ground truth")
        axes.plot(index[:, a], index[:, b], color=TRUTH, linewidth=1.2, label="ground truth, matched")
        points = axes.scatter(
            aligned.p[:, a], aligned.p[:, b], c=evaluation.translation_error_m, s=6.0, cmap="viridis", label="estimate", zorder=3
        )
        axes.set_xlabel(f"{'xyz'[a]} [m]")
        axes.set_ylabel(f"{'xyz'[b]} [m]")
        axes.set_aspect("equal", adjustable="datalim")
    figure.axes[0].legend(frameon=False, loc="best")
    figure.colorbar(points, ax=figure.axes, label="absolute translation error [m]", shrink=0.8)
    figure.suptitle(f"{evaluation.title} – ATE rmse {evaluation.ate.rmse:.4f} m", fontsize=11)
    return figure


def _errors(evaluation: Evaluation) -> Figure:
    """Absolute and relative errors over time (over the pose number where there is no time)."""
    at, label = _abscissa(evaluation)
    figure = new_figure(2 + len(evaluation.relative), 1, (11.0, 2.6 * (2 + len(evaluation.relative))))
    absolute = ((evaluation.translation_error_m, "translation [m]"), (evaluation.rotation_error_deg, "rotation [°]"))
    for axes, (values, name) in zip(figure.axes, absolute, strict=False):
        axes.plot(at, values, color=_ESTIMATE, linewidth=0.9)
        rmse = rms(values)
        axes.axhline(rmse, color=TRUTH, linewidth=0.8, linestyle="--", label=f"rmse {rmse:.4g}")
        axes.set_ylabel(f"absolute error,\n{name}")
        axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0.0)
    for axes, errors in zip(figure.axes[2:], evaluation.relative, strict=True):
        axes.plot(at[errors.pairs[:, 1]], errors.translation_m, color=_ESTIMATE, linewidth=0.9, marker=".", markersize=3.0)
        axes.set_ylabel(f"relative error\nover {errors.delta} [m]")
    for axes in figure.axes:
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(at[0], at[-1])
    figure.axes[-1].set_xlabel(label)
    figure.suptitle(evaluation.title, fontsize=11)
    return figure


def _association(evaluation: Evaluation, estimate: Trajectory, ground_truth: Trajectory) -> Figure:
    """Where on the time axis both trajectories have poses, which were matched, and how far apart the stamps are."""
    association = evaluation.association
    figure = new_figure(2, 1, (11.0, 5.0))
    timeline, differences = figure.axes
    begin = min(estimate.times[0] + round(association.offset_s * 1e9), ground_truth.times[0])
    stamps = _seconds(estimate.times + round(association.offset_s * 1e9), begin)
    unmatched = np.ones(len(stamps), dtype=bool)
    unmatched[association.estimate_index] = False
    rows = (
        ("ground truth", _seconds(ground_truth.times, begin), TRUTH),
        ("estimate, matched", stamps[~unmatched], _ESTIMATE),
        (f"estimate, unmatched ({int(unmatched.sum())})", stamps[unmatched], "#c0392b"),
    )
    for row, (_, values, colour) in enumerate(rows):
        timeline.plot(values, np.full(len(values), -row), "|", color=colour, markersize=14.0, markeredgewidth=0.6)
    overlap = max(estimate.times[0] + round(association.offset_s * 1e9), ground_truth.times[0])
    for a, b in association.gaps:
        timeline.axvspan(a + (overlap - begin) * 1e-9, b + (overlap - begin) * 1e-9, color="#f5d5d0", zorder=0)
    timeline.set_yticks([0, -1, -2], [name for name, _, _ in rows])
    timeline.set_ylim(-2.6, 0.6)
    differences.plot(stamps[~unmatched], association.difference_s * 1e3, ".", color=_ESTIMATE, markersize=3.0)
    differences.set_ylabel("stamp difference [ms]")
    differences.set_ylim(bottom=0.0)
    differences.set_xlabel("time [s]")
    differences.sharex(timeline)
    figure.suptitle(association.lines()[0].split(";")[0], fontsize=11)
    return figure


def _abscissa(evaluation: Evaluation) -> tuple[NDArray[np.float64], str]:
    time_ns = evaluation.aligned.time_ns
    if time_ns is None:
        return np.arange(len(evaluation.aligned), dtype=np.float64), "pose"
    return _seconds(time_ns, time_ns[0]), "time [s]"


def _seconds(time_ns: NDArray[np.int64], begin: np.int64) -> NDArray[np.float64]:
    return np.asarray((time_ns - begin) * 1e-9)
