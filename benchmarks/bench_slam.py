"""What loop closure costs: a search among up to 10,000 local maps, the graph of 100 km, and a scan's latency beside it.

    python benchmarks/bench_slam.py [--parts search closure latency] [--places 10 100 1000 10000] [--maps 5000]
                                    [--loops 10 150 400] [--shared ../shared] [--recordings v103_velodyne block] [--rounds 3]

**search**: a drive of as many local maps as are asked for, every 20 m, through a town of 900 blocks of houses with a random turn
at every crossing, so that places come again. Local maps are drawn, not cast: walls in a range of 45 m, half of their points, with
noise, in a frame that is level and turned as the drive is; their descriptors are those of 'boxplus slam'. Timed is everything
that `Proposer` does for a local map but describing it, which does not depend on how many there are: appearance, scan contexts
where that finds nothing, neighbours by the estimate. Median and 99th percentile of the last local maps before each size.

**closure**: the graph of a drive of 100 km that drifts as it claims, local maps every 20 m, at its end with so many loops spread
over it: seconds from loops to poses, robust weights included. Beside it the peak of the memory of the process, without the points
of local maps, which are on disk.

**latency**: recordings through the odometry alone and through 'boxplus slam' in turn, as fast as they can be read, both with
everything they write. A scan's latency is the time between two scans in which the run does not wait for the recording; the
first ones, before and at the start, are left out. The 99th percentile of each run, and the median over the rounds.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boxplus.manifolds import se3
from boxplus.maps.descriptors.scan_context import scan_context
from boxplus.maps.local_maps.local_map import LocalMap, drift_covariance
from boxplus.recordings.open import open_recording
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.slam.config import SlamRunConfig, load_slam_config
from boxplus.runs.slam.slam_run import run_slam
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import SpinningLidar
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drift
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions import trajectories
from boxplus.simulation.scenarios import make_scenario
from boxplus.simulation.simulation import Simulation
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.graph import close_graph
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.odometry_chain import OdometryChain
from boxplus.systems.slam.proposals import Proposer, described

Floats = NDArray[np.float64]

_PITCH, _BLOCKS, _RANGE = 60.0, 30, 45.0  # m, blocks a side, m
_QUERIES = 40  # timed before each size
_CITY = (60, 60.0)  # crossings a side, m between them, of the drive of 100 km
_NEAR, _TILT_SIGMA = 8.0, 1e-4  # m between the maps of a loop; rad/√m
_REGISTRATION = np.diag(np.repeat([0.001**2, 0.02**2], 3))  # [rad², m²]
_STARTING_S = 3.0  # of a recording, before and at the start
_BLOCK = "block"


@functools.cache
def town_block(i: int, j: int) -> NDArray[np.float32]:
    """(N, 3) points of the walls of six houses between four streets [m], the same ones for the same block."""
    random = np.random.Generator(np.random.PCG64([i + 2, j + 2, 77]))
    found = []
    for _ in range(6):
        middle, size, turn = random.uniform(12.0, 48.0, 2), random.uniform(4.0, 14.0, 2), random.normal(0.0, 0.15)
        corners = 0.5 * size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        corners = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + middle
        heights = np.arange(0.5, random.uniform(3.0, 9.0))
        for a, b in itertools.pairwise(corners):
            along = a + np.arange(0.0, 1.0, 0.25 / np.linalg.norm(b - a))[:, None] * (b - a)
            found.append(np.column_stack([np.repeat(along, len(heights), axis=0), np.tile(heights, len(along))]))
    return (np.concatenate(found) + np.array([_PITCH * i, _PITCH * j, 0.0])).astype(np.float32)


def town_drive(count: int, seed: int) -> Iterator[LocalMap]:
    """Local maps along a drive, every 20 m, an odometry between them that drifts."""
    random = np.random.Generator(np.random.PCG64([seed, 78]))
    at, ahead = np.array([_BLOCKS // 2, _BLOCKS // 2]), np.array([1, 0])
    T_odo, before = np.array([1.0, 0, 0, 0, 0, 0, 0]), None
    covariance = drift_covariance(20.0, 5e-4, 0.02)
    for number in range(count):
        if number % 3 == 0 and number:  # a crossing
            at = at + ahead
            ways = [np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1)) if way != tuple((-ahead).tolist())]
            ways = [way for way in ways if ((at + way >= 0) & (at + way <= _BLOCKS)).all()]
            ahead = ways[random.integers(len(ways))]
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        here = _PITCH * at + 20.0 * (number % 3) * ahead + random.normal(0.0, 0.5, 2)
        T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), *here, 0.0])
        near = [(i, j) for i in range(at[0] - 2, at[0] + 2) for j in range(at[1] - 2, at[1] + 2)]
        points = np.concatenate([town_block(*key) for key in near])
        away = points[:, :2] - here.astype(np.float32)
        points = points[np.einsum("na,na->n", away, away) < _RANGE**2]
        points = points[random.uniform(size=len(points)) < 0.5]
        seen = se3.act(se3.inverse(T), points + random.normal(0.0, 0.03, points.shape)).astype(np.float32)
        if before is not None:
            noise = se3.exp(np.linalg.cholesky(covariance) @ random.standard_normal(6))
            T_odo = se3.compose(T_odo, se3.compose(se3.compose(se3.inverse(before), T), noise))
        before, ns = T, number * 2_500_000_000
        yield LocalMap(number, ns, ns, ns, T_odo, covariance, 20.0 * number, seen, 25)


def search(options: argparse.Namespace) -> list[Metric]:
    """Time of a search at each size."""
    config, chain, took = SlamConfig(), OdometryChain(), list[float]()
    T_map = np.zeros((max(options.places), 7))
    proposer, metrics, found = Proposer(config), [], 0
    for local_map in town_drive(max(options.places), seed=1):
        query = local_map.number
        chain.add(local_map)
        T_map[query] = local_map.T_odo_map
        is_timed = any(size - _QUERIES <= query < size for size in options.places)
        own = 0.0
        if is_timed:
            began = time.process_time()
            described(local_map, config)
            scan_context(local_map.points, config.context_range)
            own = time.process_time() - began
        began = time.process_time()
        proposals = proposer.propose(query, lambda _, given=local_map: given, max(query - 1, 0), chain, T_map)  # type: ignore[misc]
        if is_timed:
            took.append(time.process_time() - began - own)
            found += any(proposal.source == "appearance" for proposal in proposals)
        if query + 1 in options.places:
            last = 1e3 * np.array(took[-min(_QUERIES, query + 1) :])
            name = f"slam/search among {query + 1:,}"
            print(
                f"{name}: median {np.median(last):.2f} ms, {found} of {len(last)} look like a place", file=sys.stderr, flush=True
            )
            bar = 5.0 if query + 1 == 10_000 else None
            metrics.append(Metric(name, float(np.median(last)), "ms", bar=bar, gated=False))
            metrics.append(Metric(f"{name}, 99th percentile", float(np.quantile(last, 0.99)), "ms", gated=False))
            found = 0
    return metrics


def measured(truth: Floats, place: int, query: int, random: np.random.Generator) -> Loop:
    """A registration of two local maps, by its covariance off the truth."""
    T = se3.compose(se3.inverse(truth[place]), truth[query])
    T = se3.compose(T, se3.exp(np.sqrt(_REGISTRATION) @ random.standard_normal(6)))
    information = np.asarray(np.linalg.inv(_REGISTRATION))
    return Loop(query, place, "nearby", 0, T, T, _REGISTRATION, information, 6, weight=1.0)


def closure(options: argparse.Namespace) -> list[Metric]:
    """Time of the graph with each number of loops."""
    random = np.random.default_rng(4)
    side, pitch = _CITY
    at, ahead, route = np.array([side // 2, side // 2]), np.array([1, 0]), []
    while len(route) * pitch < options.maps * 20.0:
        route.append((pitch * at).tolist())
        ways = [np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1)) if way != tuple((-ahead).tolist())]
        ways = [way for way in ways if ((at + way >= 0) & (at + way < side)).all()]
        ahead = ways[random.integers(len(ways))]
        at = at + ahead
    config, settings = DriftConfig(step_m=20.0, tilt_drift=0.0), SlamConfig()  # local maps are levelled
    _, truth, T_odo, _ = simulate_drift(route, config, seed=4)
    length = np.linalg.norm(np.diff(truth[:, 4:], axis=0), axis=1)
    rates = np.square([_TILT_SIGMA, _TILT_SIGMA, config.yaw_drift, *[config.position_drift] * 3])
    poses, steps = list(T_odo), [np.zeros((6, 6)), *(np.diag(metres * rates) for metres in length.tolist())]
    pairs = cKDTree(truth[:, 4:]).query_pairs(_NEAR, output_type="ndarray")
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 1]
    every = [measured(truth, int(place), int(query), random) for place, query in pairs[np.argsort(pairs[:, 1], kind="stable")]]
    metrics = []
    for count in options.loops:
        chosen = [every[k] for k in np.linspace(0, len(every) - 1, count).astype(int).tolist()]
        seconds = []
        for _ in range(options.rounds):
            began = time.process_time()
            graph = close_graph(poses, steps, chosen, settings.gravity_sigma)
            seconds.append(time.process_time() - began)
        off = np.linalg.norm(graph.T_map[:, 4:] - truth[:, 4:], axis=1)
        name = f"slam/closure of {20 * len(poses) / 1000:.0f} km, {count} loops"
        print(
            f"{name}: {np.median(seconds):.2f} s, {graph.is_kept.sum()} kept, {len(poses)} local maps, off by "
            f"{np.median(off):.1f} m in the median",
            file=sys.stderr,
            flush=True,
        )
        metrics.append(Metric(name, float(np.median(seconds)), "s", bar=1.0, gated=False))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return [*metrics, Metric("slam/peak memory of that", peak, "MB", gated=False)]


class Timed:
    """A recording that notes, for each scan, the time until the run asks for what comes after it and its samples."""

    def __init__(self, recording: Recording) -> None:
        self._recording, self.latency_s = recording, list[float]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def __iter__(self) -> Iterator[Any]:
        return self.events()

    def events(self) -> Iterator[Any]:
        """See `Recording.events`."""
        self.latency_s, own, first_ns = [], 0.0, None
        for event in self._recording.events():
            if isinstance(event, Scan):
                first_ns = event.start_ns if first_ns is None else first_ns
                if event.start_ns - first_ns > _STARTING_S * 1e9:
                    self.latency_s.append(own)
                own = 0.0
            began = time.perf_counter()
            yield event
            own += time.perf_counter() - began


@dataclass(frozen=True)
class Case:
    """A recording and the settings of its runs."""

    name: str
    recording: Recording
    config: SlamRunConfig


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """The recordings that there are, one after the other."""
    folder = options.shared / "data" / "recordings"
    for name in options.recordings:
        if name == _BLOCK:
            lidar = SpinningLidar(channels=16, azimuth_steps=450, vertical_fov_deg=(-25.0, 15.0))
            route = ((18.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0), (0.0, 0.0), (40.0, 0.0), (40.0, 22.0))
            way = trajectories.drive(route, speed=5.0, standstill_s=1.0, seed=3)
            world = city(1, 1, pitch=40.0, street=14.0, seed=3)
            scenario = replace(make_scenario("drive"), name="round a block", world=world, trajectory=way, lidar=lidar)
            yield Case(name, as_recording(Simulation(scenario, seed=3)), SlamRunConfig())
            continue
        path = next((p for p in (folder / name, folder / f"{name}.bag") if p.exists()), None)
        if path is None:
            print(f"slam: {name} left out: it is not in {folder}", file=sys.stderr)
            continue
        facts, T = json.loads((folder / f"{name}.json").read_text(encoding="utf-8")), np.eye(4)
        T[:3, :3], T[:3, 3] = facts["R_imu_lidar"], facts["t_imu_lidar"]
        with open_recording(path) as opened:
            yield Case(name, opened, load_slam_config(overrides={"odometry": {"T_imu_lidar": T.tolist()}}))


def latency(options: argparse.Namespace) -> list[Metric]:
    """99th percentile of a scan, and median, with and without loop closure."""
    metrics = []
    for case in cases(options):
        found: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
        for _ in range(options.rounds + 1):  # the first compiles
            for closes in (False, True):
                timed = Timed(case.recording)
                with tempfile.TemporaryDirectory() as scratch:
                    if closes:
                        result = run_slam(timed, Path(scratch) / "out", case.config)  # type: ignore[arg-type]
                    else:
                        run_odometry(timed, Path(scratch) / "out", case.config.of_odometry())  # type: ignore[arg-type]
                ms = 1e3 * np.array(timed.latency_s)
                found[closes].append((float(np.median(ms)), float(np.quantile(ms, 0.99))))
        loops_text = f"{result.summary.loops_accepted} loops, {result.summary.local_maps} local maps, {len(ms)} scans"
        alone, beside = (np.array(found[closes][1:]) for closes in (False, True))
        print(f"slam/latency, {case.name}: {loops_text}; alone {alone.tolist()}, beside {beside.tolist()}", file=sys.stderr)
        for column, what in enumerate(("median", "99th percentile")):
            ours, theirs = (float(np.median(rows[:, column])) for rows in (beside, alone))
            name, bar = f"slam/latency of {case.name}, {what}", 1.2 if column else None
            metrics.append(Metric(name, ours, "ms", "lower", bar, "odometry alone", theirs, gated=False))
    return metrics


PARTS = {"search": search, "closure": closure, "latency": latency}


def measure(options: argparse.Namespace) -> list[Metric]:
    """All parts that are asked for."""
    return [metric for part in options.parts for metric in PARTS[part](options)]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--parts", nargs="+", choices=tuple(PARTS), default=list(PARTS))
    parser.add_argument("--places", type=int, nargs="+", default=[10, 100, 1000, 10_000], help="local maps that are searched")
    parser.add_argument("--maps", type=int, default=5000, help="local maps of the graph, every 20 m")
    parser.add_argument("--loops", type=int, nargs="+", default=[10, 150, 400], help="of the graph")
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--recordings", nargs="+", default=["v103_velodyne", "mh05_ouster_ros2", _BLOCK])
    parser.add_argument("--rounds", type=int, default=3)


if __name__ == "__main__":
    run_as_script(__doc__ or "", measure, _arguments)
