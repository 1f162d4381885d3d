"""A benchmark of many random seeds as a script: even ones for choosing settings, odd ones for reporting, on several processes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from metrics import Metric, to_json

Line = dict[str, Any]


def run_seeds_as_script(
    what: str,
    run_seed: Callable[[int], Line],
    report: Callable[[Sequence[Line]], str],
    figures: Callable[[Sequence[Line]], list[Metric]],
    *,
    seeds: str,
    arguments: Sequence[str] | None = None,
) -> None:
    """The command.

    Args:
        what: its first sentence of help.
        run_seed: a line of results for a seed; a function of a module, for other processes to find.
        report: the tables of all lines; figures: what a baseline holds of them.
        seeds: first:last+1 where none are given.
    """
    parser = argparse.ArgumentParser(description=what)
    parser.add_argument("--seeds", default=seeds, help="first:last+1")
    parser.add_argument("--half", choices=("even", "odd", "both"), default="both")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write a line of JSON for every seed")
    parser.add_argument("--json", type=Path, help="write the figures that a baseline holds")
    parser.add_argument("-v", action="store_true", help="print these lines")
    options = parser.parse_args(arguments)
    begin, end = (int(part) for part in options.seeds.split(":"))
    chosen = [s for s in range(begin, end) if options.half == "both" or s % 2 == ("even", "odd").index(options.half)]
    if options.jobs > 1:
        with ProcessPoolExecutor(options.jobs) as pool:
            lines = list(pool.map(run_seed, chosen, chunksize=4))
    else:
        lines = [run_seed(seed) for seed in chosen]
    if options.out:
        options.out.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    if options.json:
        options.json.write_text(json.dumps(to_json(figures(lines))), encoding="utf-8")
    if options.v:
        for line in lines:
            print(json.dumps(line, indent=1))
    print(report(lines))
