"""A fleet of 100 short recordings: what two workers save, what a recording costs, and how candidates grow to 100,000 recordings.

    python benchmarks/bench_fleet.py [--recordings 10 100] [--index 1000 10000 100000] [--json FILE]

Recordings are drives of 5 s along one street of a simulated city, each of which shares two thirds of its way with the next one
and begins where nobody knows. Instead of 'boxplus slam', whose tasks do not depend on each other, runs are written
as odometry with drift leaves them; everything after that is that of 'boxplus fleet run': descriptors, pairs, graph, map.
Cost is the CPU time of the processes, which other work on the machine changes little; the speed-up is that of the schedule: the
CPU time with one worker by that of the busiest of two and of the process that gives out the work. The wall clock is
printed beside it.

The index is fed with descriptors of recordings each of which shares a place with the next one of ten: 40 % of the features are
others, the rest differ in 12 % of their bits.
"""

from __future__ import annotations

import csv
import os
import resource
import sys
import tempfile
import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from metrics import Metric, run_as_script

from boxplus.maps.descriptors.features import Features
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.runs.fleet import fleet_run
from boxplus.runs.fleet.executor import RayExecutor, TaskEnd
from boxplus.runs.fleet.status import FleetStatus, RecordingStatus
from boxplus.runs.fleet.store import open_store
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.summary import read_merge_summary
from boxplus.runs.settings_file import load_settings
from boxplus.runs.slam.config import SlamRunConfig
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.candidates import Looks

ROOT = str(Path(__file__).resolve().parents[1])
STEP_M, WAY_M, BLOCKS = 14.0, 40.0, 40
DRIFT = DriftConfig(channels=16, azimuth_steps=180, step_m=2.0, max_range=45.0)
MAPS = LocalMapConfig(length=6.0)
MERGING = ["map.voxel=0.2", "map.ply=false", "sessions.slam={least_overlap: 0.6, rival_fit: 0.85, descriptor: {candidates: 2}}"]
FEATURES, VISITS, PER_SESSION = 60, 10, 6


def drive(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
    """A run as 'boxplus slam' leaves it."""
    if ROOT not in sys.path:  # of a worker
        sys.path.append(ROOT)
    from tests.runs.sessions.runs import written_run

    number, began = int(recording), time.perf_counter()
    route = [[STEP_M * number, 0.0], [STEP_M * number + WAY_M, 0.0]]
    with open_store(store).writing(f"runs/{name}") as folder:
        written_run(folder, city(BLOCKS, 2, seed=5), route, DRIFT, seed=number, maps_config=MAPS)
    seconds = time.perf_counter() - began
    return RecordingStatus(name=name, recording=recording, state="finished", seconds=seconds, path_length_m=WAY_M)


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, int, float]:
    """A task: its value, the process that did it, and the CPU time that took."""
    began = _cpu_s()
    value = function(*arguments)
    return value, os.getpid(), _cpu_s() - began


def _cpu_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


@dataclass
class Clocked:
    """A Ray executor that notes the CPU time of every task."""

    inner: RayExecutor
    worker_s: Counter[int] = field(default_factory=Counter)
    stage_s: Counter[str] = field(default_factory=Counter)

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[TaskEnd]:
        """See `Executor`."""
        for end in self.inner.run(timed, [(function, *given) for given in arguments]):
            if end.error is not None:
                raise RuntimeError(end.error)
            value, worker, seconds = end.value
            self.worker_s[worker] += seconds  # type: ignore[assignment]
            self.stage_s[function.__name__] += seconds  # type: ignore[assignment]
            yield TaskEnd(end.number, value)


@dataclass(frozen=True)
class Figures:
    """Of one fleet.

    Attributes:
        cost_s: CPU time in all; length_s: that of the busiest worker and of the process that gives out the work.
        wall_s: clock on the wall; met: share of the pairs of neighbours along the street that met.
        error: of where a recording's frame is, along the worst axis of the worst one [standard deviations].
    """

    status: FleetStatus
    cost_s: float
    length_s: float
    wall_s: float
    met: float
    error: float


def fleet(count: int, workers: int) -> Figures:
    """From nothing, with workers that have loaded their kernels."""
    merging = load_settings(MergeConfig, None, MERGING)
    fleet_run.run_recording = drive
    with tempfile.TemporaryDirectory() as scratch, RayExecutor(workers=workers) as inner:
        warm, executor = Clocked(inner), Clocked(inner)
        few = {f"drive_{number}": Path(str(number)) for number in range(3)}
        fleet_run.run_fleet(few, Path(scratch) / "warm", warm, None, merging)
        recordings = {f"drive_{number}": Path(str(number)) for number in range(count)}
        wall, driver = time.perf_counter(), time.process_time()
        status = fleet_run.run_fleet(recordings, Path(scratch) / "fleet", executor, None, merging)
        wall, driver = time.perf_counter() - wall, time.process_time() - driver
        merged = Path(scratch) / "fleet" / "merged"
        placed, met = read_merge_summary(merged / "run.json").joined, _neighbours_met(merged)
    each = executor.worker_s.values()
    first = _number(placed[0].name)
    off = [
        np.abs(np.subtract(own.T_world_session[4:6], [STEP_M * (_number(own.name) - first), 0.0])) / own.sigma[3:5]
        for own in placed[1:]
        if own.T_world_session is not None and own.sigma is not None
    ]
    found = Figures(status, sum(each) + driver, max(each) + driver, wall, met / (count - 1), float(np.max(off)))
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in executor.stage_s.items())
    print(
        f"fleet: {count} recordings, {workers} workers: {found.cost_s:.1f} s CPU ({stages}, driver {driver:.1f}), "
        f"busiest worker {max(each):.1f}, {wall:.1f} s on the wall; {status.pairs_looked_at} pairs, {status.pairs_joined} met, "
        f"{met} of {count - 1} neighbours, {len(status.joined)} joined, off by {found.error:.1f} σ at most; {status.doubts[:3]}",
        file=sys.stderr,
        flush=True,
    )
    return found


def _number(name: str) -> int:
    return int(name.removeprefix("drive_"))


def _neighbours_met(merged: Path) -> int:
    """Pairs of recordings one step apart that the joint graph has encounters of."""
    with (merged / "encounters.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if not row["refusal"]]
    pairs = {frozenset((_number(row["query_session"]), _number(row["place_session"]))) for row in rows}
    return sum(max(pair) - min(pair) == 1 for pair in pairs)


def described(count: int) -> list[list[Features]]:
    """Two places of each of so many recordings, the second of which the next one of ten has seen first."""
    random = np.random.default_rng(1)

    def bits(shape: tuple[int, ...]) -> np.ndarray:
        return random.integers(0, 2**64, shape, dtype=np.uint64)

    places = bits((count, FEATURES, 4))

    def seen(place: int) -> Features:
        found = places[place] ^ (bits((FEATURES, 4)) & bits((FEATURES, 4)) & bits((FEATURES, 4)) & bits((FEATURES, 4)))
        others = random.random(FEATURES) < 0.4
        found[others] = bits((int(others.sum()), 4))
        return Features(random.uniform(-40.0, 40.0, (FEATURES, 2)), found)

    return [[seen(number), seen(_next(number))] for number in range(count)]


def _next(number: int) -> int:
    return number // VISITS * VISITS + (number + 1) % VISITS


def index(count: int) -> tuple[float, float, float]:
    """CPU time [ms] and pairs of a recording, and the share of true pairs that is among them."""
    recordings = described(count)
    Looks(recordings[:20]).pairs(PER_SESSION)  # loads the kernels
    began = time.process_time()
    pairs = Looks(recordings).pairs(PER_SESSION)
    ms = 1e3 * (time.process_time() - began) / count
    true = {(min(k, _next(k)), max(k, _next(k))) for k in range(count)}
    share = len(true & set(pairs)) / len(true)
    print(
        f"fleet: index of {count} recordings: {ms:.2f} ms and {len(pairs) / count:.2f} pairs each, {share:.1%} of the true ones",
        file=sys.stderr,
        flush=True,
    )
    return ms, len(pairs) / count, share


def measure(options: Namespace) -> list[Metric]:
    """Of the fleets, then of the index."""
    return [*(of_fleets(*options.recordings) if options.recordings else []), *(of_index(options.index) if options.index else [])]


def of_fleets(few: int, many: int) -> list[Metric]:
    """A small fleet with one worker and with two, and a large one."""
    one, two, large = fleet(few, 1), fleet(few, 2), fleet(many, 2)
    saved, cost = large.cost_s / large.length_s, (large.cost_s / many) / (two.cost_s / few)
    title = "fleet/"
    return [
        Metric(f"{title}speed-up of two workers, small", one.cost_s / two.length_s, "ratio", "higher", tolerance=0.15),
        Metric(f"{title}speed-up of two workers, large", saved, "ratio", "higher", 1.7, tolerance=0.05),
        Metric(f"{title}speed-up on the wall, small", one.wall_s / two.wall_s, "ratio", "higher", 1.7, gated=False),
        Metric(f"{title}cost of a recording, large to small", cost, "ratio", bar=1.2, tolerance=0.2),
        Metric(f"{title}recordings joined, large", len(large.status.joined) / many, "share", "higher", 0.95, tolerance=0.02),
        Metric(f"{title}neighbours that met, large", large.met, "share", "higher", 0.95, tolerance=0.02),
        Metric(f"{title}place of a recording, worst", large.error, "σ", bar=4.0, tolerance=0.5),
    ]


def of_index(counts: Sequence[int]) -> list[Metric]:
    """The index of the smallest and of the largest of these numbers of recordings."""
    found = {count: index(count) for count in counts}
    first, last = found[min(counts)], found[max(counts)]
    title = "fleet/index: "
    return [
        Metric(f"{title}time a recording, large to small", last[0] / first[0], "ratio", bar=4.0, tolerance=0.5),
        Metric(f"{title}pairs a recording, large", last[1], "pairs", bar=float(PER_SESSION), tolerance=0.1),
        Metric(f"{title}true pairs found, large", last[2], "share", "higher", 0.9, tolerance=0.03),
    ]


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("--recordings", type=int, nargs="*", default=[10, 100], help="of a small and of a large fleet")
    parser.add_argument("--index", type=int, nargs="*", default=[1000, 10_000, 100_000], help="recordings in the index")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
