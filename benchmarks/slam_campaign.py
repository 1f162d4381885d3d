"""Loop closure over simulated drives whose odometry drifts: false loops, recall, error before and after, NEES.

    python benchmarks/slam_campaign.py --worlds city,car_park,storeys,corridors,block --seeds 11:15

A loop is false where it is off by more than half a metre or 2°, or, with directions that the surfaces leave open, where its
error is far beyond its covariance. A revisit is a local map near an earlier one (8 m outdoors, 3.5 m within buildings) with 30 m
of way between. The NEES of poses is that of local maps against the first one, after closing: of the last map, independent
from run to run, and the mean over the maps. `--drift 3` multiplies the drift, and not what is claimed of it. `--no-imu` is an
odometry of a LiDAR alone: it drifts in tilt as in yaw, nobody says where down is, and its LiDAR leans by up to 20°.
Settings were chosen on seeds below 10.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from boxplus.manifolds import se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.simulation.worlds.alike import car_park, parallel_corridors, storeys
from boxplus.simulation.worlds.world import World
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.slam.config import SlamConfig
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


def _long(seed: int) -> Case:
    """2 km through a town, at every crossing left, right or straight on, by chance."""
    random = np.random.default_rng([seed, 3])
    at, way = np.array([1, 1]), np.array([1, 0])
    route = [60.0 * at]
    for _ in range(34):
        ways = [np.array(w) for w in ((1, 0), (-1, 0), (0, 1), (0, -1)) if w != tuple(-way)]
        ways = [w for w in ways if ((at + w >= 0) & (at + w <= 3)).all()]
        way = ways[random.integers(len(ways))]
        at = at + way
        route.append(60.0 * at)
    return city(3, 3, seed=seed), [corner.tolist() for corner in route], DriftConfig(channels=16, azimuth_steps=240), 8.0


def _block(seed: int) -> Case:
    route = [[20.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0], [0.0, 0.0], [60.0, 0.0], [60.0, 25.0]]
    return city(2, 2, seed=seed), route, DriftConfig(channels=24, azimuth_steps=240), 8.0


def _two_corridors(seed: int) -> Case:
    """Twice through two neighbouring ones of four corridors that are the same."""
    x, y = 31.5, 12.0 * int(np.random.default_rng([seed, 9]).integers(0, 3))
    route = [[-x, y], [x, y], [x, y + 12], [-x, y + 12], [-x, y], [x, y], [x, y + 12], [x - 25, y + 12]]
    return parallel_corridors(), route, DriftConfig(**INDOORS), 3.5


def _two_storeys(seed: int) -> Case:
    """A lap on the lower floor and two on the upper one."""
    x, y = 36.0 / 2 - 1.5, 24.0 / 2 - 1.5
    lap = [[-x, -y], [x, -y], [x, y], [-x, y]]
    route = [[*p, 0.0] for p in [*lap, [-x, -y + 2]]] + [[*p, 4.0] for p in [*lap, *lap, [-x, -y + 2]]]
    return storeys(count=2, seed=seed), route, DriftConfig(**INDOORS), 3.5


def _aisles(seed: int) -> Case:
    """Three aisles of a car park and back through the first two."""
    j = 8.0 * int(np.random.default_rng([seed, 8]).integers(1, 4))
    route = [[8, j], [72, j], [72, j + 8], [8, j + 8], [8, j + 16], [72, j + 16], [72, j], [8, j], [8, j + 8], [40, j + 8]]
    return car_park(), route, DriftConfig(speed=3.0, corner_radius=3.0, max_range=40.0, vertical_fov_deg=(-20.0, 20.0)), 3.5


WORLDS: dict[str, Callable[[int], Case]] = {
    "block": _block,
    "long": _long,
    "city": _city,
    "car_park": _car_park,
    "storeys": _storeys,
    "corridors": _corridors,
    "two_corridors": _two_corridors,
    "two_storeys": _two_storeys,
    "aisles": _aisles,
}


@dataclass(frozen=True)
class Row:
    """One drive: counts, errors before and after [m], NEES of loops that were measured fully, of the last map and of all maps."""

    loops: int
    false: int
    found: int
    revisits: int
    before: float
    after: float
    loop_nees: list[float]
    last_nees: float
    mean_nees: float
    is_doubted: bool


def leaning(drive: DriftingDrive, seed: int) -> DriftingDrive:
    """The same drive with another body: a LiDAR that leans by up to 20°, any way; the odometry's world begins as it stands."""
    random = np.random.Generator(np.random.PCG64([seed, 701]))
    way, lean = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.0, np.deg2rad(20.0))
    T = se3.exp(np.array([lean * np.cos(way), lean * np.sin(way), 0.0, 0.0, 0.0, 0.0]))
    scans = [se3.act(se3.inverse(T), scan.astype(np.float64)).astype(np.float32) for scan in drive.scans]
    T_world, T_odo = se3.compose(drive.T_world_body, T), se3.compose(drive.T_odo_body, T)
    return replace(drive, T_world_body=T_world, T_odo_body=se3.compose(se3.inverse(T_odo[0]), T_odo), scans=scans)


def run(name: str, seed: int, drift: float, has_imu: bool = True) -> Row:
    """One drive; prints a row of text."""
    world, route, config, near = WORLDS[name](seed)
    if not has_imu:
        config = config.model_copy(update={"tilt_drift": config.yaw_drift})
    rates = {field: drift * getattr(config, field) for field in ("yaw_drift", "tilt_drift", "position_drift")}
    config = config.model_copy(update=rates)
    drive = simulate_drifting_drive(world, route, config, seed)
    builder, maps, zero = LocalMapBuilder(), [], np.zeros((6, 6))
    slam, up = (Slam(), np.array([0.0, 0.0, 1.0])) if has_imu else (Slam(SlamConfig().without_gravity()), None)
    if not has_imu:
        drive = leaning(drive, seed)
    for time_ns, T, scan in zip(drive.time_ns.tolist(), drive.T_odo_body, drive.scans, strict=True):
        maps += builder.push(time_ns, T, zero, scan, up)
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
    correction = slam.correction()
    corrected = correction.apply(drive.time_ns, drive.T_odo_body)
    before, after = (_ate(T[:, 4:], drive.T_world_body[:, 4:]) for T in (drive.T_odo_body, corrected))
    true = se3.compose(se3.inverse(truth[0]), truth)
    errors = se3.log(se3.compose(se3.inverse(true), se3.compose(se3.inverse(correction.T_map[0]), correction.T_map)))[1:]
    squares = np.einsum("ni,ni->n", errors, np.linalg.solve(correction.covariance[1:], errors[..., None])[..., 0])
    row = Row(
        len(accepted), false, found, len(revisits), before, after, nees, float(squares[-1]), float(squares.mean()),
        slam.doubt is not None,
    )  # fmt: skip
    print(
        f"{name:10s} {seed:4d} {way[-1]:6.0f} m {len(maps):4d} maps  {len(accepted):3d} loops  {false} false  "
        f"revisits {found}/{len(revisits)}  ATE {before:.3f} -> {after:.3f} m ({after / before:.2f})  "
        f"NEES {np.mean(nees) if nees else float('nan'):.1f} of 6 ({len(nees)}), poses {squares[-1]:.1f}, {squares.mean():.1f}  "
        f"{'doubted  ' if row.is_doubted else ''}{seconds:.0f} s",
        flush=True,
    )
    return row


def summarize(name: str, rows: list[Row]) -> None:
    """All drives of a world, as a row of text."""
    n = len(rows)
    low, high = chi2(6 * n).ppf([0.025, 0.975]) / n
    ratios = [row.after / row.before for row in rows]
    loops = [square for row in rows for square in row.loop_nees]
    last, poses = np.mean([row.last_nees for row in rows]), np.mean([row.mean_nees for row in rows])
    print(
        f"{name}: {n} drives, {sum(row.false for row in rows)} false of {sum(row.loops for row in rows)} loops, revisits "
        f"{sum(row.found for row in rows)}/{sum(row.revisits for row in rows)}, ATE after/before median {np.median(ratios):.2f}, "
        f"worst {max(ratios):.2f}, after median {np.median([row.after for row in rows]):.3f} m, worst "
        f"{max(row.after for row in rows):.3f} m; NEES of loops {np.mean(loops) if loops else float('nan'):.1f}, of poses "
        f"{poses:.2f}, of the last one {last:.2f} (95 % band {low:.2f} to {high:.2f}); "
        f"{sum(row.is_doubted for row in rows)} doubted",
        flush=True,
    )


def _ate(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.sqrt(((a @ R.T - b) ** 2).sum(axis=1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="comma-separated")
    parser.add_argument("--seeds", default="11:15", help="first:last:step, the last one excluded")
    parser.add_argument("--drift", type=float, default=1.0, help="factor of the drift; what is claimed of it stays")
    parser.add_argument("--no-imu", action="store_true", help="an odometry that does not know where down is")
    options = parser.parse_args()
    seeds = range(*(int(text) for text in options.seeds.split(":")))
    for name in options.worlds.split(","):
        summarize(name, [run(name, seed, options.drift, not options.no_imu) for seed in seeds])


if __name__ == "__main__":
    main()
