"""Maps laid onto the Earth by simulated receivers: how far off the result is, against the odometry alone, and what is refused.

    python benchmarks/gnss_campaign.py --seeds 1:13:2

Drives whose odometry drifts by random walks, without points: loops play no part. A result that is off by more than four of its
own standard deviations without a warning is a silent failure. Settings were chosen on even seeds.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drift
from boxplus.simulation.gnss import GnssConfig, simulate_gnss
from boxplus.systems.georeference.georeference import georeference
from boxplus.systems.slam.graph import MapGraph

Floats = NDArray[np.float64]

ORIGIN = EnuFrame(49.01, 8.43, 116.0)
LEVER = (0.6, 0.0, 1.2)
SCANS_OF_A_MAP = 20
SIGMAS = 4.0


@dataclass(frozen=True)
class Case:
    """A receiver; whether the right answer is a map, a refusal, or either with a warning.

    Attributes:
        lever: what is told of the antenna, over where it is; None: nothing.
        spoil: what becomes of positions (N, 3) [m] at times (N,) [s] beside what the simulation of a receiver does.
        climbs: the way goes up and down.
    """

    gnss: dict[str, object]
    expected: str
    lever: float | None = 1.0
    spoil: Callable[[Floats, Floats], Floats] | None = None
    climbs: bool = False


def _jumps_early(p: Floats, seconds: Floats) -> Floats:
    return p + np.where(seconds < 0.3 * seconds[-1], 0.0, 1.0)[:, None] * [2.4, 1.8, 0.0]


def _jumps_in_multipath(p: Floats, seconds: Floats) -> Floats:
    since = seconds - 0.5 * seconds[-1]
    burst = (since >= 0.0) & (since < 8.0)
    return p + (since >= 0.0)[:, None] * [4.0, 3.0, 0.0] + burst[:, None] * [-7.0, 10.0, 0.0]


def _bursts(*levels: tuple[float, tuple[float, float, float]]) -> Callable[[Floats, Floats], Floats]:
    """Multipath in the middle of the recording, one after the other: how long it lasts [s], and where it puts fixes."""

    def spoil(p: Floats, seconds: Floats) -> Floats:
        begin, moved = 0.5 * seconds[-1], p.copy()
        for duration_s, metres in levels:
            moved[(seconds >= begin) & (seconds < begin + duration_s)] += metres
            begin += duration_s
        return moved

    return spoil


def _stuck(begin: float, duration_s: float) -> Callable[[Floats, Floats], Floats]:
    """The same position from a share of the recording on, for a time."""

    def spoil(p: Floats, seconds: Floats) -> Floats:
        first = begin * seconds[-1]
        inside = (seconds >= first) & (seconds < first + duration_s)
        return np.where(inside[:, None], p[np.searchsorted(seconds, first)], p)

    return spoil


def _in_feet(p: Floats, seconds: Floats) -> Floats:
    return np.column_stack([p[:, :2], (p[:, 2] + ORIGIN.altitude) / 0.3048 - ORIGIN.altitude])


RTK: dict[str, object] = {"sigma": 0.01, "slow_sigma": 0.01, "claimed": 0.02}
CASES = {
    "good": Case({}, "map"),
    "RTK": Case(RTK, "map"),
    "poor": Case({"sigma": 2.0, "slow_sigma": 2.0, "claimed": 3.0}, "map"),
    "states nothing": Case({"claimed": None}, "map"),
    "claims 1 cm": Case({"claimed": 0.01}, "map"),
    "no lever arm": Case({}, "map", lever=None),
    "hills": Case({}, "map", climbs=True),
    "hills, heights in feet": Case({}, "said", spoil=_in_feet, climbs=True),
    "RTK, hills, in feet": Case(RTK, "said", spoil=_in_feet, climbs=True),
    "RTK, lever arm reversed": Case(RTK, "said", lever=-1.0),
    "datum jumps 3 m early": Case({}, "said", spoil=_jumps_early),
    "datum jumps 5 m in multipath": Case({}, "said", spoil=_jumps_in_multipath),
    "stuck for 20 s": Case({}, "said", spoil=_stuck(0.4, 20.0)),
    "stuck at the end": Case({}, "said", spoil=_stuck(0.7, np.inf)),
    "stuck throughout": Case({}, "refusal", spoil=_stuck(0.0, np.inf)),
    "multipath": Case({"multipath": 3, "multipath_s": 6.0}, "map"),
    "much multipath": Case({"multipath": 10, "multipath_s": 10.0}, "said"),
    "small multipath": Case({"multipath": 3, "multipath_s": 6.0, "multipath_m": 4.0}, "map"),
    "two bursts": Case({}, "map", spoil=_bursts((6.0, (-7.0, 4.0, 0.0)), (6.0, (-6.0, -2.0, 0.0)))),
    "two longer bursts": Case({}, "map", spoil=_bursts((8.0, (-8.0, 1.0, 0.0)), (7.0, (-6.0, -2.0, 0.0)))),
    "two long bursts": Case({}, "map", spoil=_bursts((10.0, (6.0, 8.0, 0.0)), (12.0, (-5.0, 6.0, 0.0)))),
    "bursts with a pause": Case({}, "map", spoil=_bursts((5.0, (8.0, 0.0, 0.0)), (2.0, (0.0, 0.0, 0.0)), (8.0, (0.0, 8.0, 0.0)))),
    "1 Hz, two bursts": Case({"rate_hz": 1.0}, "map", spoil=_bursts((6.0, (-7.0, 4.0, 0.0)), (6.0, (-6.0, -2.0, 0.0)))),
    "a burst of 25 s": Case({}, "map", spoil=_bursts((25.0, (12.0, 0.0, 0.0)))),
    "1 Hz, a burst of 25 s": Case({"rate_hz": 1.0}, "map", spoil=_bursts((25.0, (12.0, 0.0, 0.0)))),
    "tunnels": Case({"tunnels": 2}, "map"),
    "0.3 s late": Case({"delay_s": 0.3}, "said"),
    "18 s late": Case({"delay_s": 18.0}, "refusal"),
    "swapped": Case({"swapped": True}, "refusal"),
    "radians": Case({"unit": "rad"}, "refusal"),
    "datum jumps 5 m": Case({"jump": (4.0, 3.0, 0.0)}, "said"),
    "RTK, datum jumps 0.5 m": Case({**RTK, "jump": (0.4, 0.3, 0.0)}, "said"),
    "RTK, datum jumps 1.5 m": Case({**RTK, "jump": (1.2, 0.9, 0.0)}, "said"),
    "datum jumps 50 m": Case({"jump": (40.0, 30.0, 0.0)}, "said"),
    "other vehicle": Case({}, "refusal"),
}


def route(seed: int) -> NDArray[np.float64]:
    """A walk along the streets of a grid, 40 to 120 m to the next corner, never straight back."""
    random = np.random.default_rng([seed, 31])
    corners, heading = [np.zeros(2)], int(random.integers(4))
    for _ in range(int(random.integers(8, 17))):
        direction = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[heading]
        corners.append(corners[-1] + random.uniform(40.0, 120.0) * direction)
        heading = (heading + int(random.choice([-1, 1]))) % 4
    return np.stack(corners)


def run(name: str, seed: int) -> tuple[str, str, float, float, float]:
    """Verdict, a line about it, root mean square errors of the odometry, which begins at the truth, and of the map; seconds."""
    case = CASES[name]
    corners = route(seed)
    if case.climbs:
        up = np.cumsum(np.random.default_rng([seed, 77]).normal(0.0, 5.0, len(corners)))
        corners = np.column_stack([corners, up])
    time_ns, truth, odometry, covariance = simulate_drift(corners, DriftConfig(), seed)
    random = np.random.default_rng([seed, 32])
    yaw = random.uniform(-np.pi, np.pi)
    T_enu = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), *random.uniform(-50.0, 50.0, 3)])
    T_enu_imu = se3.compose(T_enu, truth)
    at = np.arange(SCANS_OF_A_MAP // 2, len(time_ns), SCANS_OF_A_MAP)
    steps = [np.zeros((6, 6))]
    for a, b in itertools.pairwise(at):
        Ad = se3.adjoint(se3.compose(se3.inverse(truth[b]), truth[a]))  # P was made along the truth
        steps.append(covariance[b] - Ad @ covariance[a] @ Ad.T + 1e-8 * np.eye(6))
    graph = MapGraph(time_ns[at], odometry[at], odometry[at], np.stack(steps))
    seen, seen_ns = T_enu_imu, time_ns
    if name == "other vehicle":
        seen_ns, other, _, _ = simulate_drift(route(seed + 1000), DriftConfig(), seed)
        seen = se3.compose(T_enu, other)
    receiver = GnssConfig(**{"lever": LEVER, **case.gnss})
    fixes = simulate_gnss(seen_ns, seen, ORIGIN, receiver, seed)
    if case.spoil is not None:
        p = case.spoil(ORIGIN.to_enu(fixes.lat_lon_alt), (fixes.time_ns - fixes.time_ns[0]) * 1e-9)
        fixes = replace(fixes, lat_lon_alt=ORIGIN.to_geodetic(p))
    began = time.perf_counter()
    lever = None if case.lever is None else case.lever * np.array(LEVER)
    found = georeference(graph, fixes, time_ns, odometry, None, lever)
    seconds = time.perf_counter() - began
    before = _rms(se3.compose(T_enu, odometry)[at, 4:6] - T_enu_imu[at, 4:6])
    if found.fit is None or found.frame is None:
        verdict = "refused" if case.expected == "refusal" else "REFUSED" if case.expected == "map" else "said"
        return verdict, f"{found.refusal}", before, float("nan"), seconds
    p = se3.compose(found.fit.T_enu_map, found.fit.T_map)[:, 4:]
    off = (p - found.frame.to_enu(ORIGIN.to_geodetic(T_enu_imu[at, 4:])))[:, :2]
    after, sigma = _rms(off), _rms(found.fit.sigma[:, None] * [1.0, 1.0])
    is_off = bool((np.linalg.norm(off, axis=1) > SIGMAS * np.sqrt(2.0) * found.fit.sigma).any()) or case.expected == "refusal"
    told = [*found.warnings, *([found.contradiction] if found.contradiction is not None else [])]
    verdict = "map" if not is_off else "off, said" if _serious(told) else "SILENT"
    gated = 1.0 - found.used / len(found.attached)
    line = f"sigma {sigma:.2f} gated {100 * gated:.0f} % delay {found.fit.delay:+.2f}"
    return verdict, " | ".join([line, *told]), before, after, seconds


def _serious(warnings: list[str]) -> bool:
    """That the lever arm is not known is said of every such run and speaks against none."""
    return any(not text.startswith("the lever arm of the antenna") for text in warnings)


def _rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=";".join(CASES), help="separated by semicolons")
    parser.add_argument("--seeds", default="1:13:2", help="first:last:step, the last one excluded")
    parser.add_argument("--verbose", action="store_true", help="a line a run")
    options = parser.parse_args()
    seeds = range(*(int(text) for text in options.seeds.split(":")))
    for name in options.cases.split(";"):
        rows = [run(name, seed) for seed in seeds]
        if options.verbose:
            for seed, (verdict, line, before, after, _) in zip(seeds, rows, strict=True):
                print(f"  {name:22s} {seed:3d} {verdict:9s} {before:6.2f} -> {after:6.2f} m  {line}")
        verdicts = [verdict for verdict, *_ in rows]
        counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in sorted(set(verdicts)))
        laid = [(before, after) for _, _, before, after, _ in rows if np.isfinite(after)]
        medians = f"{np.median([b for b, _ in laid]):.2f} -> {np.median([a for _, a in laid]):.2f} m" if laid else "-"
        print(f"{name:22s} {counts:28s} {medians:18s} {np.mean([row[-1] for row in rows]):.1f} s", flush=True)


if __name__ == "__main__":
    main()
