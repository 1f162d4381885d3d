"""Loop closure over simulated drives whose odometry drifts: false loops, recall, error before and after, NEES of the loops.

    python benchmarks/slam_campaign.py --worlds city,car_park,storeys,corridors --seeds 11:15

A loop is false where it is off by more than half a metre or 2°, or, with directions that the surfaces leave open, where its
error is far beyond its covariance. A revisit is a local map near an earlier one (8 m outdoors, 3.5 m within buildings) with 30 m
of way between.
Settings were chosen on seeds below 10.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drifting_drive
from boxplus.simulation.worlds.alike import car_park, parallel_corridors, storeys
from boxplus.simulation.worlds.world import World
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.slam.slam import Slam

Case = tuple[World, list[list[float]], DriftConfig, float]

INDOORS = {"speed": 1.5, "step_m": 0.5, "corner_radius": 1.0, "height": 1.2, "max_range": 40.0, "vertical_fov_deg": (-25.0, 25.0)}


def _city(seed: int) -> Case:
    routes = [
        [[0, 0], [60, 0], [60, 60], [0, 60], [0, 0], [60, 0], [120, 0], [120, 60], [60, 60], [60, 20]],
        [[0, 0], [120, 0], [120, 120], [0, 120], [0, 0], [120, 0], [120, 60], [60, 60], [60, 120], [0, 120], [0, 80]],
        [[60, 60], [180, 60], [180, 120], [60, 120], [60, 0], [120, 0], [120, 60], [60, 60], [60, 120], [120, 120]],
    ]
    return city(3, 3, seed=seed), routes[seed % 3], DriftConfig(), 8.0


def _car_park(seed: int) -> Case:
    del seed
    route = [[x, 8.0 * j] for j in range(1, 6) for x in ((8, 72) if j % 2 else (72, 8))]
    route += [[72, 48], [8, 48], [8, 8], [40, 8], [40, 32]]
    config = DriftConfig(speed=3.0, corner_radius=3.0, max_range=40.0, vertical_fov_deg=(-20.0, 20.0))
    return car_park(), route, config, 3.5


def _storeys(seed: int) -> Case:
    x, y = 36.0 / 2 - 1.5, 24.0 / 2 - 1.5
    route: list[list[float]] = []
    for k in range(3):
        lap = [[-x, -y, 4.0 * k], [x, -y, 4.0 * k], [x, y, 4.0 * k], [-x, y, 4.0 * k]]
        route += [*lap * (2 if k == 2 else 1), [-x, -y + 2, 4.0 * k]]
    return storeys(seed=seed), route, DriftConfig(**INDOORS), 3.5


def _corridors(seed: int) -> Case:
    del seed
    x = 31.5
    route = [[-x, 0], [x, 0], [x, 12], [-x, 12], [-x, 24], [x, 24], [x, 36], [-x, 36], [-x, 0], [x, 0], [x, 12], [0, 12]]
    return parallel_corridors(), route, DriftConfig(**INDOORS), 3.5


WORLDS: dict[str, Callable[[int], Case]] = {"city": _city, "car_park": _car_park, "storeys": _storeys, "corridors": _corridors}


def run(name: str, seed: int) -> str:
    """One drive, as a row of text."""
    world, route, config, near = WORLDS[name](seed)
    drive = simulate_drifting_drive(world, route, config, seed)
    builder, slam, maps, zero = LocalMapBuilder(), Slam(), [], np.zeros((6, 6))
    for time_ns, T, scan in zip(drive.time_ns.tolist(), drive.T_odo_body, drive.scans, strict=True):
        maps += builder.push(time_ns, T, zero, scan)
    maps += builder.flush()
    began = time.perf_counter()
    for local_map in maps:
        slam.add(local_map)
    seconds = time.perf_counter() - began
    at = np.searchsorted(drive.time_ns, [m.time_ns for m in maps])
    T_odo = np.stack([m.T_odo_map for m in maps])
    truth = se3.compose(drive.T_world_body[at], se3.compose(se3.inverse(drive.T_odo_body[at]), T_odo))
    false, nees = 0, []
    accepted = [loop for loop in slam.loops if loop.is_accepted]
    for loop in accepted:
        T = se3.compose(se3.inverse(truth[loop.place]), truth[loop.query])
        xi = se3.log(se3.compose(se3.inverse(T), loop.T_place_query))
        square = float(xi @ np.linalg.solve(loop.covariance, xi))
        is_off = np.linalg.norm(xi[3:]) > 0.5 or np.linalg.norm(xi[:3]) > np.deg2rad(2.0)
        false += bool((loop.measured == 6 and is_off) or square > 150.0)
        nees += [square] if loop.measured == 6 else []
    way = np.array([m.path_m for m in maps])
    revisits = [
        i
        for i in range(len(maps))
        if ((way[i] - way[:i] >= 30.0) & (np.linalg.norm(truth[:i, 4:] - truth[i, 4:], axis=1) < near)).any()
    ]
    found = sum(any(loop.query == i for loop in accepted) for i in revisits)
    corrected = slam.correction().apply(drive.time_ns, drive.T_odo_body)
    before, after = (_ate(T[:, 4:], drive.T_world_body[:, 4:]) for T in (drive.T_odo_body, corrected))
    return (
        f"{name:10s} {seed:4d} {way[-1]:6.0f} m {len(maps):4d} maps  {len(accepted):3d} loops  {false} false  "
        f"revisits {found}/{len(revisits)}  ATE {before:.3f} -> {after:.3f} m ({after / before:.2f})  "
        f"NEES {np.mean(nees) if nees else float('nan'):.1f} of 6 ({len(nees)})  {seconds:.0f} s"
    )


def _ate(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.sqrt(((a @ R.T - b) ** 2).sum(axis=1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="comma-separated")
    parser.add_argument("--seeds", default="11:15", help="first:last, the last one excluded")
    options = parser.parse_args()
    first, last = (int(text) for text in options.seeds.split(":"))
    for name in options.worlds.split(","):
        for seed in range(first, last):
            print(run(name, seed), flush=True)


if __name__ == "__main__":
    main()
