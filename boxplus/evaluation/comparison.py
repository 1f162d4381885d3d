"""Several estimates of one ground truth: one table, and what speaks against reading it line by line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from boxplus.errors import InputError
from boxplus.evaluation.evaluation import Evaluation
from boxplus.evaluation.rpe import Delta
from boxplus.formats.trajectory import Trajectory

_OTHER_STRETCH = 0.05  # of the longest time compared: what another estimate may lack without a word


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of `compare`.

    Attributes:
        evaluations: of every estimate that could be compared, in the order they were given.
        refused: why the others could not.
        warnings: what speaks against comparing the lines of the table, one sentence each.
    """

    evaluations: dict[str, Evaluation]
    refused: dict[str, str]
    warnings: tuple[str, ...]

    def table(self) -> str:
        """One line an estimate: matches, ATE and the rmse of every relative error; – where there is none."""
        deltas = self._deltas()
        head = ["estimate", "matches", "ATE rmse m", "mean m", "median m", "max m", "rmse °"]
        head += [f"RPE {delta} rmse {unit}" for delta in deltas for unit in "m°"]
        rows = [head]
        for name, evaluation in self.evaluations.items():
            ate = evaluation.ate
            figures: list[float | None] = [ate.rmse, ate.mean, ate.median, ate.max, evaluation.ate_rotation.rmse]
            relative = {errors.delta: errors for errors in evaluation.relative}
            for delta in deltas:
                found = relative.get(delta)
                figures += [None, None] if found is None else [found.translation.rmse, found.rotation.rmse]
            rows.append([name, str(len(evaluation.association)), *("–" if f is None else f"{f:.6f}" for f in figures)])
        widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
        return "\n".join(
            "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))])
            for row in rows
        )

    def _deltas(self) -> list[Delta]:
        return list(dict.fromkeys(errors.delta for evaluation in self.evaluations.values() for errors in evaluation.relative))

    def summary(self) -> str:
        """The table, how its numbers came about, refused estimates and warnings."""
        lines = []
        if self.evaluations:
            lines += [self.table(), ""]
            lines += [f"{name}: {evaluation.title}" for name, evaluation in self.evaluations.items()]
        lines += [f"{name}: not compared, {reason}" for name, reason in self.refused.items()]
        warnings = [*self.warnings, *(f"{name}: {text}" for name, e in self.evaluations.items() for text in e.warnings)]
        if warnings:
            lines += ["", "Warnings", *(f"- {warning}" for warning in warnings)]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, object]:
        """All figures as plain numbers, for JSON: `Evaluation.to_dict` of every estimate."""
        return {
            "estimates": {name: evaluation.to_dict() for name, evaluation in self.evaluations.items()},
            "refused": dict(self.refused),
            "warnings": list(self.warnings),
        }


def compare(
    estimates: Mapping[str, Trajectory], one: Callable[[Trajectory], Evaluation], unread: Mapping[str, str] | None = None
) -> Comparison:
    """Compare several estimates with one ground truth, each as if it were alone.

    Args:
        estimates: the trajectories by name.
        one: `evaluate` with ground truth and settings. Where it refuses an estimate, the others are compared all the same.
        unread: names of estimates that could not be read, and why.

    Example:
        >>> compare({"a": a, "b": b}, functools.partial(evaluate, ground_truth=truth)).table()  # doctest: +SKIP
    """
    evaluations, refused = {}, dict(unread or {})
    for name, estimate in estimates.items():
        try:
            evaluations[name] = one(estimate)
        except InputError as error:
            refused[name] = str(error)
    return Comparison(evaluations, refused, tuple(_doubts(evaluations)))


def short_names(paths: list[Path]) -> list[str]:
    """The shortest ends of paths that tell them apart, without the ending of the file where that is possible.

    A path that is there again is numbered.

    Example:
        >>> short_names([Path("a/run.tum"), Path("b/run.tum"), Path("b/other.tum")])
        ['a/run', 'b/run', 'other']
    """
    whole = [path.resolve().parts for path in paths]
    plain = [(*parts[:-1], Path(parts[-1]).stem) for parts in whole]
    if len(set(plain)) == len(set(whole)):
        whole = plain
    names = []
    for parts in whole:
        size = 1
        while size < len(parts) and any(other[-size:] == parts[-size:] for other in whole if other != parts):
            size += 1
        names.append("/".join(parts[-size:]))
    before = [names[:row].count(name) for row, name in enumerate(names)]
    return [f"{name} ({count + 1})" if count else name for name, count in zip(names, before, strict=True)]


def _doubts(evaluations: dict[str, Evaluation]) -> list[str]:
    """Errors of other stretches of the way are no errors of the same thing."""
    spans = {
        name: (float(e.aligned.time_ns[0]) * 1e-9, float(e.aligned.time_ns[-1]) * 1e-9)
        for name, e in evaluations.items()
        if e.aligned.time_ns is not None
    }
    if not spans:
        return []
    begin, end = min(a for a, _ in spans.values()), max(b for _, b in spans.values())
    lacking = [
        f"{name} ({a - begin:.1f} to {b - begin:.1f} s)"
        for name, (a, b) in spans.items()
        if (b - a) < (1.0 - _OTHER_STRETCH) * (end - begin)
    ]
    doubts = []
    if lacking and len(spans) > 1:
        doubts.append(
            f"the estimates are not compared over the same stretch of {end - begin:.1f} s: {', '.join(lacking)}; a shorter one "
            "may look better for what it leaves out"
        )
    counts = np.array([len(evaluation.association) for evaluation in evaluations.values()])
    if len(counts) > 1 and counts.min() < 0.5 * counts.max():
        doubts.append("some estimates have less than half the matches of others: their errors are sampled at other instants")
    return doubts
