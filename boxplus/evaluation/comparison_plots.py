"""Pictures of several estimates beside one ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from boxplus.evaluation.comparison import Comparison
from boxplus.evaluation.plots import TRUTH, new_figure, save_figures
from boxplus.formats.trajectory import Trajectory

# Told apart without colours by their dashes; the colours are those of Okabe and Ito, for every kind of sight.
_LINES = (
    ("#0072b2", "-"),
    ("#d55e00", "--"),
    ("#009e73", "-."),
    ("#cc79a7", ":"),
    ("#56b4e9", (0, (6, 1, 1, 1, 1, 1))),
    ("#e69f00", (0, (3, 3))),
)


def write_comparison_plots(comparison: Comparison, folder: str | Path, ground_truth: Trajectory) -> list[Path]:
    """Draw `trajectories.png` (from above and from the side) and `errors.png` (over time) of all estimates into a folder.

    Args:
        comparison: what `compare` returned, of at least one estimate that was compared.
        folder: created where it does not exist.
        ground_truth: all poses of it, in the frame they were compared in.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    paths, errors = new_figure(1, 2, (13.0, 6.0)), new_figure(2, 1, (11.0, 6.0))
    for axes, (a, b) in zip(paths.axes, ((0, 1), (0, 2)), strict=True):
        axes.plot(ground_truth.p[:, a], ground_truth.p[:, b], color=TRUTH, linewidth=1.6, label="ground truth")
        axes.set_xlabel(f"{'xyz'[a]} [m]")
        axes.set_ylabel(f"{'xyz'[b]} [m]")
        axes.set_aspect("equal", adjustable="datalim")
    for number, (name, evaluation) in enumerate(comparison.evaluations.items()):
        colour, dashes = _LINES[number % len(_LINES)]
        style: dict[str, Any] = {
            "color": colour,
            "linestyle": dashes,
            "linewidth": 1.2,
            "label": f"{name} ({evaluation.ate.rmse:.3g} m)",
        }
        p = evaluation.aligned.p
        for axes, (a, b) in zip(paths.axes, ((0, 1), (0, 2)), strict=True):
            axes.plot(p[:, a], p[:, b], **style)
        time_ns = evaluation.aligned.time_ns
        if time_ns is None or ground_truth.time_ns is None:
            at = np.arange(len(p), dtype=np.float64)
        else:
            at = (time_ns - ground_truth.time_ns[0]) * 1e-9
        errors.axes[0].plot(at, evaluation.translation_error_m, **style)
        errors.axes[1].plot(at, evaluation.rotation_error_deg, **style)
    for axes, name in zip(errors.axes, ("translation [m]", "rotation [°]"), strict=True):
        axes.set_ylabel(f"absolute error,\n{name}")
        axes.set_ylim(bottom=0.0)
    errors.axes[1].set_xlabel("pose" if ground_truth.time_ns is None else "time [s]")
    for figure in (paths, errors):
        figure.axes[0].legend(frameon=False, loc="best", title="ATE rmse")
    return save_figures({"trajectories": paths, "errors": errors}, folder)
