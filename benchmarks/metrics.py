"""What a benchmark reports: figures with their opponents and bars, as a table and as JSON, and the gate against a baseline."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

Direction = Literal["lower", "higher"]
_TIMES = ("ns", "us", "ms", "s")


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure.

    What is judged, against the bar and against the baseline, is the ratio to the opponent where there is one, else the value.

    Attributes:
        name: benchmark and figure, `scan/total`.
        value: measured, in `unit`.
        unit: `ms`, `cm`, `ratio` …
        direction: which way is better.
        bar: what has to be reached, or None.
        opponent: what the value is compared with, and
        opponent_value: its value in the same unit and the same run; NaN when it failed.
        tolerance: share by which the judged figure may be worse than in the baseline.
        gated: False for figures that depend on the machine or its load: reported, but not kept in the baseline.
    """

    name: str
    value: float
    unit: str
    direction: Direction = "lower"
    bar: float | None = None
    opponent: str = ""
    opponent_value: float | None = None
    tolerance: float = 0.3
    gated: bool = True

    @property
    def ratio(self) -> float | None:
        """Value over the opponent's value; 0 when the opponent failed and lower is better."""
        if self.opponent_value is None:
            return None
        if not math.isfinite(self.opponent_value):
            return 0.0 if self.direction == "lower" else math.inf
        return self.value / self.opponent_value

    @property
    def judged(self) -> float:
        """The figure that bar and baseline refer to."""
        return self.value if self.ratio is None else self.ratio

    @property
    def judged_unit(self) -> str:
        """Unit of the judged figure."""
        return self.unit if self.ratio is None else "ratio"

    @property
    def verdict(self) -> str:
        """Against the bar: `ok`, `FALLS SHORT`, or nothing without a bar."""
        if self.bar is None:
            return ""
        return "ok" if not _worse(self.judged, self.bar, self.direction) else "FALLS SHORT"


@dataclass(frozen=True, slots=True)
class Expected:
    """A figure of the baseline; see `Metric`."""

    value: float
    unit: str
    direction: Direction
    tolerance: float


def _worse(value: float, limit: float, direction: Direction) -> bool:
    if not math.isfinite(value) and not (value == math.inf and direction == "higher"):
        return True
    return value > limit if direction == "lower" else value < limit


def table(metrics: Sequence[Metric]) -> str:
    """Fixed columns: figure, value, unit, opponent with its value, ratio, bar, verdict."""
    rows = [("figure", "value", "unit", "opponent", "its value", "ratio", "bar", "")]
    for metric in metrics:
        rows.append(
            (
                metric.name,
                f"{metric.value:.3g}",
                metric.unit,
                metric.opponent,
                "" if metric.opponent_value is None else f"{metric.opponent_value:.3g}",
                "" if metric.ratio is None else f"{metric.ratio:.2f}",
                "" if metric.bar is None else f"{'≤' if metric.direction == 'lower' else '≥'} {metric.bar:g}",
                metric.verdict,
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def to_json(metrics: Iterable[Metric]) -> list[dict[str, object]]:
    """The metrics as plain objects, judged figure and verdict included."""
    return [asdict(metric) | {"ratio": metric.ratio, "verdict": metric.verdict} for metric in metrics]


def from_json(entries: Iterable[dict[str, object]]) -> list[Metric]:
    """Back from `to_json`."""
    fields = Metric.__dataclass_fields__
    return [Metric(**{key: value for key, value in entry.items() if key in fields}) for entry in entries]  # type: ignore[arg-type]


def read_baseline(path: Path) -> dict[str, Expected]:
    """Name → expected figure; empty when the file does not exist."""
    if not path.is_file():
        return {}
    return {name: Expected(**entry) for name, entry in json.loads(path.read_text(encoding="utf-8")).items()}


def updated_baseline(baseline: dict[str, Expected], metrics: Iterable[Metric], benchmarks: Iterable[str]) -> dict[str, Expected]:
    """The baseline with the gated metrics of this run in the place of all those of the same benchmarks."""
    ran = set(benchmarks)
    kept = {name: expected for name, expected in baseline.items() if name.split("/")[0] not in ran}
    new = {
        metric.name: Expected(float(f"{metric.judged:.4g}"), metric.judged_unit, metric.direction, metric.tolerance)
        for metric in metrics
        if metric.gated and math.isfinite(metric.judged)
    }
    return dict(sorted((kept | new).items()))


def write_baseline(path: Path, baseline: dict[str, Expected]) -> None:
    """As JSON, one metric a line."""
    lines = [f"  {json.dumps(name)}: {json.dumps(asdict(expected))}" for name, expected in baseline.items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def regressions(baseline: dict[str, Expected], metrics: Iterable[Metric], benchmarks: Iterable[str]) -> list[str]:
    """One sentence for every figure worse than the baseline by more than its tolerance, or missing from the run.

    Args:
        baseline: what was committed.
        metrics: of this run.
        benchmarks: the names of the benchmarks that ran; figures of others are not expected.
    """
    found = []
    measured = {metric.name: metric for metric in metrics}
    ran = set(benchmarks)
    for name, expected in baseline.items():
        if name.split("/")[0] not in ran:
            continue
        metric = measured.get(name)
        if metric is None:
            found.append(f"{name}: in the baseline, but not measured")
            continue
        margin = expected.tolerance * abs(expected.value)
        limit = expected.value + (margin if expected.direction == "lower" else -margin)
        if metric.judged_unit != expected.unit:
            found.append(f"{name}: measured in {metric.judged_unit}, the baseline is in {expected.unit}")
        elif _worse(metric.judged, limit, expected.direction):
            found.append(
                f"{name}: {metric.judged:.4g} {expected.unit}, baseline {expected.value:.4g} and at "
                f"{'most' if expected.direction == 'lower' else 'least'} {limit:.4g} allowed"
            )
    return found


def untimed(baseline: dict[str, Expected], metrics: Sequence[Metric]) -> tuple[dict[str, Expected], list[Metric]]:
    """Of a baseline and of a run the figures that no load changes: those that are not times, nor ratios of times."""
    kept = [metric for metric in metrics if metric.unit not in _TIMES]
    timed = {metric.name for metric in metrics} - {metric.name for metric in kept}
    return {name: expected for name, expected in baseline.items() if name not in timed}, kept


def run_as_script(
    description: str,
    measure: Callable[[argparse.Namespace], list[Metric]],
    add_arguments: Callable[[argparse.ArgumentParser], object] = lambda _: None,
) -> None:
    """The command line that every benchmark shares: its own arguments, `--json FILE`, and the table on the terminal."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    add_arguments(parser)
    options = parser.parse_args()
    metrics = measure(options)
    print(table(metrics))
    if options.json:
        options.json.write_text(json.dumps(to_json(metrics), indent=1) + "\n", encoding="utf-8")
