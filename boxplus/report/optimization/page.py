"""The page that the reports of bundle adjustment and of pose graphs have in common."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted
from boxplus.report.optimization import figures
from boxplus.report.skeleton import figure_section, html_table, tiles, warnings_section, write_html
from boxplus.runs.optimization_summary import OptimizationSummary

_PARAMETER = {"Levenberg-Marquardt": "λ", "dogleg": "radius"}


def write_optimization_page(
    path: Path,
    summary: OptimizationSummary,
    numbers: list[tuple[str, str]],
    picture: str,
    errors: tuple[NDArray[np.float64], NDArray[np.float64]],
    unit: str,
    largest: str,
) -> Path:
    """Write the page; returns its path.

    Args:
        numbers: the large ones at the top: value, and what it is.
        picture: HTML, the section with the scene before and after.
        errors: before and after, (k,) each, NaN where invalid.
        largest: HTML, a table of the largest errors.

    Raises:
        OutputError: it cannot be written.
    """
    parts = [_head(summary, numbers), warnings_section(_warnings(summary)), picture, _errors(summary, errors, unit, largest)]
    parts += [_course(summary), _facts(summary)]
    return write_html(path, Path(summary.input).name, "\n".join(parts))


def _head(summary: OptimizationSummary, numbers: list[tuple[str, str]]) -> str:
    good = summary.state == "finished" and summary.status == "converged" and summary.doubt is None
    doubt = "" if summary.doubt is None else ", not to be trusted"
    state = ("interrupted" if summary.state == "interrupted" else summary.status) + doubt
    return (
        f"<h1>{escape(Path(summary.input).name)}</h1>"
        f'<p class="lead"><span class="state{"" if good else " interrupted"}">{state}</span> {escape(summary.reason)} · '
        f"{escape(summary.program)} {escape(summary.versions['boxplus'])} · {summary.started:%Y-%m-%d %H:%M} UTC</p>"
        f"{tiles(numbers)}"
    )


def _warnings(summary: OptimizationSummary) -> list[str]:
    lines = [escape(note) for note in summary.notes]
    if summary.state == "finished" and summary.status != "converged":
        lines.insert(0, f"not converged: {escape(summary.reason)}")
    if summary.doubt is not None:
        lines.insert(0, f"not to be trusted: {escape(summary.doubt)}")
    lines += [
        f"{count} residuals of {escape(group)} could not be evaluated at the end and do not count"
        for group, count in summary.invalid.items()
        if count
    ]
    return lines


def _errors(
    summary: OptimizationSummary, errors: tuple[NDArray[np.float64], NDArray[np.float64]], unit: str, largest: str
) -> str:
    before, after = summary.errors_initial, summary.errors
    rows = [
        (name, f"{getattr(before, key):.4g}", f"{getattr(after, key):.4g}")
        for key, name in (("rms", "root mean square"), ("median", "median"), ("p99", "99th percentile"), ("largest", "largest"))
    ]
    rows.append(("not valid", str(before.invalid), str(after.invalid)))
    table = html_table(rows, (f"error [{unit}]", "before", "after"))
    text = f"{summary.convention}. The largest errors after the optimisation are listed below."
    return figure_section("Errors", text, figures.error_histogram(*errors, unit), table + largest)


def _course(summary: OptimizationSummary) -> str:
    rows = [
        (
            str(i.number),
            f"{i.cost:.9e}",
            "–" if i.tried_cost is None else f"{i.tried_cost:.6e}",
            f"{i.gradient:.3e}",
            f"{i.step:.3e}",
            f"{i.parameter:.2e}",
            "" if i.accepted else "rejected",
            f"{i.time_s:.3f}",
        )
        for i in summary.history
    ]
    parameter = _PARAMETER.get(summary.method, "step length")
    heading = ("step", "cost", "tried", "largest gradient", "largest step", parameter, "", "time [s]")
    table = f"<details><summary>All steps: {len(rows) - 1}</summary>{html_table(rows, heading)}</details>"
    text = f"From {summary.cost_initial:.6e} to {summary.cost:.6e} in {counted(summary.history[-1].number, 'step')}"
    text += f"{' of the last of several solves' if summary.is_last_of_several else ''}; {summary.status}: {summary.reason}."
    return figure_section("Cost", text, figures.cost_over_iterations(summary.history, parameter), table)


def _facts(summary: OptimizationSummary) -> str:
    stages = ", ".join(f"{name} {seconds:.3f} s" for name, seconds in summary.timing_s.items())
    rows: list[tuple[str, ...]] = [
        ("input", summary.input),
        ("sizes", ", ".join(f"{count:,} {name}" for name, count in summary.sizes.items())),
        ("result", summary.output),
        ("why it stopped", f"{summary.status}: {summary.reason}"),
        ("start", summary.start),
        ("method", summary.method),
        ("linear solver", summary.linear_solver),
        ("cost", f"{summary.convention}; {summary.cost_initial:.9e} at the start, {summary.cost:.9e} at the end"),
    ]
    if summary.chi2 is not None and summary.chi2_initial is not None:
        rows.append(("χ²", f"{summary.chi2_initial:.6f} at the start, {summary.chi2:.6f} at the end, without robust loss"))
    rows += [(name, text) for name, text in (("loop closures", summary.loops), ("optimality", summary.certificate)) if text]
    rows += [
        ("not evaluated", ", ".join(f"{count} of {group}" for group, count in summary.invalid.items()) + " at the end"),
        ("time", stages),
        ("settings", ", ".join(f"{name} {value}" for name, value in summary.settings.items())),
        ("versions", ", ".join(f"{name} {version}" for name, version in summary.versions.items())),
    ]
    return f"<section><h2>Facts</h2>{html_table(rows)}</section>"
