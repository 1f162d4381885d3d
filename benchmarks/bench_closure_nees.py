"""Whether covariances after closing loops and joining sessions mean something: NEES of drives that drift as they claim.

    python benchmarks/bench_closure_nees.py [--seeds 1:101:2] [--only block,sessions_city]

Graph level: nothing is cast and nothing registered, so that fifty drives take seconds. Poses drift by random walks, and the
covariance the odometry gives is that of these walks; local maps are cut as always, and bent by the drift while they are made.
A loop is what two bent maps, laid over each other on the whole, would say, with noise of 1 cm and 0.03° on top, and the
covariance that registration gives to both. What is measured is the graph: steps, verticals, loops, the frame of a session.
The error of the last local map against the first, or of a session's frame in the other one, over its covariance, is compared
with its six degrees of freedom: the mean over independent drives lies below the 97.5 % quantile of χ² when the covariance is
right, and above the 2.5 % quantile when it says no more than it has to.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np
import sessions_campaign
import slam_campaign
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from scipy.stats import chi2

from boxplus.manifolds import se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drift
from boxplus.systems.sessions.encounter import Encounter
from boxplus.systems.sessions.graph import join
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.graph import close_graph
from boxplus.systems.slam.loop import Loop

Floats = NDArray[np.float64]

_REGISTRATION = np.diag(np.repeat([0.0005**2, 0.01**2], 3))  # [rad², m²]
_EXACT = LocalMapConfig(drift_rotation=0.0, drift_position=0.0)  # type: ignore[call-arg]  # nothing beside the odometry's own
_PLACES = 2  # that a local map is laid over, at most
_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Drive:
    """Local maps, where they truly are (n, 7), what bends each (n, 6), on the left, and where the drive began (7,)."""

    maps: list[LocalMap]
    T_world_map: Floats
    bends: Floats
    start: Floats


def drive(route: list[list[float]], config: DriftConfig, seed: int) -> Drive:
    """One drive without its scans."""
    time_ns, T_world_body, T_odo_body, covariance = simulate_drift(route, config, seed)
    builder, maps, point = LocalMapBuilder(_EXACT), list[LocalMap](), np.ones((1, 3), np.float32)
    for t, T, P in zip(time_ns.tolist(), T_odo_body, covariance, strict=True):
        maps += builder.push(t, T, P, point)
    maps += builder.flush()
    at = np.searchsorted(time_ns, [m.time_ns for m in maps])
    T_odo_map = np.stack([m.T_odo_map for m in maps])
    truth = se3.compose(T_world_body[at], se3.compose(se3.inverse(T_odo_body[at]), T_odo_map))
    bends = []
    for m, T in zip(maps, truth, strict=True):
        own = (time_ns >= m.begin_ns) & (time_ns <= m.end_ns)
        n = int(np.count_nonzero(own))
        real = se3.compose(np.broadcast_to(se3.inverse(T), (n, 7)), T_world_body[own])
        drawn = se3.compose(np.broadcast_to(se3.inverse(m.T_odo_map), (n, 7)), T_odo_body[own])
        bends.append(se3.log(se3.compose(drawn, se3.inverse(real))).mean(axis=0))
    return Drive(maps, truth, np.array(bends), T_world_body[0])


def loops(places: Drive, queries: Drive, near: float, least_way: float | None, random: np.random.Generator) -> list[Loop]:
    """What registration would say of the nearest places of every query; of earlier ones, a way back, with `least_way` [m]."""
    found = []
    for q, own in enumerate(queries.maps):
        far = np.linalg.norm(places.T_world_map[:, 4:] - queries.T_world_map[q, 4:], axis=1)
        if least_way is not None:
            far[[own.path_m - m.path_m < least_way for m in places.maps]] = np.inf
        for p in np.argsort(far)[:_PLACES].tolist():
            if far[p] > near:
                continue
            Z = se3.compose(se3.inverse(places.T_world_map[p]), queries.T_world_map[q])
            Ad = se3.adjoint(se3.inverse(Z))
            P = places.maps[p if p else 1].covariance
            covariance = _REGISTRATION + (queries.maps[q if q else 1].covariance + Ad @ P @ Ad.T) / 12.0
            noise = np.sqrt(_REGISTRATION) @ random.standard_normal(6)
            T = se3.compose(se3.exp(places.bends[p]), se3.compose(Z, se3.exp(-queries.bends[q])))
            T = se3.compose(T, se3.exp(noise))
            found.append(Loop(q, p, "nearby", 0, T, T, covariance, np.asarray(np.linalg.inv(covariance)), 6, weight=1.0))
    return found


def closed(name: str, seed: int) -> float:
    """NEES of the last local map of a drive against the first, after closing its loops."""
    _, route, config, near = slam_campaign.WORLDS[name](seed)
    own, settings = drive(route, config, seed), SlamConfig()
    found = loops(own, own, near, settings.least_way, np.random.default_rng([seed, 5]))
    if not found:
        return float("nan")
    poses, steps = [m.T_odo_map for m in own.maps], [m.covariance for m in own.maps]
    graph = close_graph(poses, steps, found, settings.gravity_sigma, [True] * len(found))
    true = se3.compose(se3.inverse(own.T_world_map[0]), own.T_world_map[-1])
    made = se3.compose(se3.inverse(graph.T_map[0]), graph.T_map[-1])
    return _squared(true, made, graph.covariances()[0][-1])


def joined(name: str, seed: int) -> float:
    """NEES of the frame of a session in that of another."""
    _, route_a, _, route_b, config = sessions_campaign.CASES[name](seed)
    a, b = drive(route_a, config, 2 * seed), drive(route_b, config, 2 * seed + 1)
    found = [Encounter(0, 1, loop) for loop in loops(a, b, 8.0, None, np.random.default_rng([seed, 6]))]
    if len(found) < 3:
        return float("nan")
    true = se3.compose(se3.inverse(a.start), b.start)
    graph = join([_session("a", a), _session("b", b)], found, np.stack([_START, true]), SlamConfig().gravity_sigma)
    return _squared(true, graph.T_world_session[1], graph.covariance[1])


def _session(name: str, own: Drive) -> Session:
    moved = [replace(m, T_odo_map=se3.compose(se3.inverse(own.start), m.T_odo_map)) for m in own.maps]
    return Session.of(name, moved)


def _squared(true: Floats, made: Floats, covariance: Floats) -> float:
    xi = se3.log(se3.compose(se3.inverse(true), made))
    return float(xi @ np.linalg.solve(covariance, xi))


CASES = {
    **{name: (closed, name) for name in ("block", "corridors", "storeys", "car_park")},
    **{f"sessions_{name}": (joined, name) for name in ("city", "corridors")},
}


def measure(options: argparse.Namespace) -> list[Metric]:
    """The mean over drives, each with its bar."""
    metrics = []
    for case in options.only.split(","):
        run, name = CASES[case]
        squares = np.array([run(name, seed) for seed in range(*(int(part) for part in options.seeds.split(":")))])
        squares = squares[np.isfinite(squares)]
        n = len(squares)
        low, high = chi2(6 * n).ppf([0.025, 0.975]) / n
        print(f"closure_nees: {case}: {n} drives, {squares.mean():.2f} of {low:.2f} to {high:.2f}", file=sys.stderr, flush=True)
        title = f"closure_nees/{case}, 6 degrees of freedom"
        metrics.append(Metric(title, float(squares.mean()), "NEES", bar=high, tolerance=0.2))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", default="1:101:2", help="first:last+1:step")
    parser.add_argument("--only", default=",".join(CASES), help="comma-separated")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
