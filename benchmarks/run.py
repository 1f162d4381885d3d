"""Runs the benchmarks and prints one table; compares with the committed baseline.

    python benchmarks/run.py [NAME ...] [--json FILE] [--gate [--untimed] | --update-baseline] [--quick]

Names: knn_static map_dynamic scan recordings memory map_growth cholesky ordering …; all of them when none is given. Each is a
process of its own. `--gate` exits with 1 when a figure is worse than in the baseline by more than its tolerance, with
`--untimed` only when it is one that no load changes. `--update-baseline` takes the figures of this run for those to come,
deliberately. `--quick` is a smoke run: its figures mean nothing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from metrics import Metric, from_json, read_baseline, regressions, table, to_json, untimed, updated_baseline, write_baseline

HERE = Path(__file__).resolve().parent
BASELINE = HERE / "baseline.json"
Results = Mapping[str, Mapping[str, float]]


def knn_static_metrics(results: Mapping[str, float]) -> list[Metric]:
    """From the figures of bench_knn_static.py, whose ratios are medians of paired ratios."""
    scipy_us = results["scipy_us"]
    return [
        Metric("knn_static/query, 1 thread", results["ratio"] * scipy_us, "us", "lower", 0.25, "cKDTree", scipy_us),
        Metric(
            "knn_static/query, 2 threads",
            results["ratio_two_threads"] * scipy_us,
            "us",
            "lower",
            0.15,
            "cKDTree, 1 thread",
            scipy_us,
            gated=False,
        ),
        Metric("knn_static/exact", results["exact"], "yes", "higher", 1.0, tolerance=0.0),
    ]


def map_dynamic_metrics(results: Results) -> list[Metric]:
    """From the figures of bench_map_dynamic.py, the mode that the odometry uses."""
    stream, large = results["incremental"], results["large map"]
    scipy_us, query_ratio = stream["scipy_query_us"], stream["query_ratio_to_scipy"]
    name = "map_dynamic/"
    return [
        Metric(name + "query", query_ratio * scipy_us, "us", "lower", 0.3, "cKDTree, static", scipy_us),
        Metric(name + "insertion of 2,000, median", stream["insert_ms_median"], "ms", bar=0.5, gated=False),
        Metric(name + "insertion of 2,000, 99th percentile", stream["insert_ms_p99"], "ms", bar=1.5, gated=False),
        Metric(name + "insertion of 2,000, worst", stream["insert_ms_worst"], "ms", bar=3.0, gated=False),
        Metric(name + "same as brute force", stream["same_as_brute_force"], "yes", "higher", 1.0, tolerance=0.0),
        Metric(name + "memory per point, median", stream["bytes_per_point_median"], "bytes", bar=40.0, tolerance=0.05),
        Metric(name + "memory per point, peak", stream["bytes_per_point_peak"], "bytes", bar=40.0, tolerance=0.1),
        Metric(name + "build of 1M points", large["build_1m_s"], "s", bar=0.5, gated=False),
        Metric(name + "deletion of a 20 m cube from 1M", large["box_delete_ms"], "ms", bar=0.3, gated=False),
    ]


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A script beside this one.

    Attributes:
        quick: more arguments, for a smoke run.
        convert: makes metrics of its JSON; None when that is a list of metrics already.
        arguments: of every run.
    """

    quick: Sequence[str]
    convert: Callable[..., list[Metric]] | None = None
    arguments: Sequence[str] = ()


BENCHMARKS = {
    "knn_static": Benchmark(("--points", "50000", "--queries", "10000", "--repeats", "2"), knn_static_metrics),
    "map_dynamic": Benchmark(("--batches", "100"), map_dynamic_metrics, ("--modes", "incremental")),
    "scan": Benchmark(("--rounds", "1", "--duration", "8")),
    "recordings": Benchmark(("--rounds", "1", "--only", "v103_velodyne")),
    "lidar_alone": Benchmark(("--only", "v103_velodyne")),
    "lidar_start": Benchmark(("--seeds", "1:7"), arguments=("--half", "odd", "--seeds", "1:173")),
    "map_growth": Benchmark(("--batches", "100", "--duration", "10")),
    "memory": Benchmark(("--minutes", "3")),
    "cholesky": Benchmark(("--rounds", "2", "--only", "intel", "MIT")),
    "ordering": Benchmark(("--rounds", "1", "--cube", "8", "--points", "600", "--only", "cube", "walk")),
    "graphs": Benchmark(("--rounds", "1", "--only", "intel", "MIT")),
    "incremental": Benchmark(("--only", "world", "--poses", "300")),
    "loops": Benchmark(("--poses", "300", "--seeds", "1", "--without-gtsam")),
    "bundle": Benchmark(("--rounds", "1")),
    "imu": Benchmark(("--rounds", "2")),
    "residuals": Benchmark(("--edges", "1000", "--rounds", "1")),
    "direct": Benchmark(("--rounds", "1")),
    "direct_runs": Benchmark(()),
    "vio": Benchmark(("--only", "mh01")),
    "vio_runs": Benchmark(("--only", "mh01", "--modes", "stereo")),
    "vio_nees": Benchmark(("--seeds", "500:502", "--seconds", "4")),
    "slam": Benchmark(
        ("--places", "10", "30", "--maps", "100", "--loops", "5", "--recordings", "block", "--rounds", "1"),
    ),
    "closure_nees": Benchmark(("--seeds", "1:5:2", "--only", "block,sessions_city")),
    "vio_start": Benchmark(("--seeds", "2001:2021"), arguments=("--half", "odd", "--seeds", "1:1001")),
    "fleet": Benchmark(("--recordings", "3", "4", "--index", "200", "400")),
    "marginalize": Benchmark(("--landmarks", "50", "150", "--dense", "50", "--rounds", "2")),
}


def run_benchmark(name: str, *, quick: bool) -> list[Metric]:
    """Run one in a process of its own; its own output goes to the terminal.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    benchmark = BENCHMARKS[name]
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "figures.json"
        command = [sys.executable, str(HERE / f"bench_{name}.py"), "--json", str(output), *benchmark.arguments]
        subprocess.run([*command, *(benchmark.quick if quick else ())], check=True, stdout=sys.stderr)
        results = json.loads(output.read_text(encoding="utf-8"))
    return from_json(results) if benchmark.convert is None else benchmark.convert(results)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--gate", action="store_true", help="exit with 1 when worse than the baseline")
    parser.add_argument("--untimed", action="store_true", help="with --gate: judge only figures that are no times, at any load")
    parser.add_argument("--update-baseline", action="store_true", help="make this run the baseline")
    parser.add_argument("--baseline", type=Path, default=BASELINE)
    parser.add_argument("--quick", action="store_true", help="smoke run")
    options = parser.parse_args(arguments)
    names = list(dict.fromkeys(options.names)) or list(BENCHMARKS)
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    if options.quick and (options.gate or options.update_baseline):
        parser.error("a quick run measures nothing that a baseline could be compared with")
    metrics: list[Metric] = []
    failed = []
    for name in names:
        print(f"== {name}", file=sys.stderr, flush=True)
        try:
            metrics += run_benchmark(name, quick=options.quick)
        except subprocess.CalledProcessError as problem:
            failed.append(f"{name}: failed with exit code {problem.returncode}")
    print(table(metrics))
    if options.json:
        options.json.write_text(json.dumps(to_json(metrics), indent=1) + "\n", encoding="utf-8")
    baseline = read_baseline(options.baseline)
    held, judged = untimed(baseline, metrics) if options.untimed else (baseline, metrics)
    found = failed + (regressions(held, judged, names) if options.gate else [])
    for sentence in found:
        print(f"REGRESSION  {sentence}")
    if options.update_baseline and not failed:
        write_baseline(options.baseline, updated_baseline(baseline, metrics, names))
        print(f"baseline updated: {options.baseline}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
