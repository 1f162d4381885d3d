"""Sessions joined or kept apart, over simulated drives with unknown start poses: false merges, recall, error of the alignment.

    python benchmarks/sessions_campaign.py --cases city,city_other,corridors,corridors_other --seeds 1:10:2

Each row is a pair of sessions. `city`, `city_another_day` (a fifth of its objects elsewhere), `corridors`, `car_park` and
`storeys` share a stretch of way; `…_other` do not: another city, another corridor that is the same, another aisle, another
storey. A merge is false where the sessions share nothing, or where it is off by more than half a metre or 2°. Settings were
chosen on even seeds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from localization_campaign import another_day

from boxplus.manifolds import se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drifting_drive
from boxplus.simulation.worlds.alike import car_park, parallel_corridors, storeys
from boxplus.simulation.worlds.world import World
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.session import Session
from boxplus.systems.sessions.sessions import align_sessions

Route = list[list[float]]
Case = tuple[World, Route, World, Route, DriftConfig]

_RAYS = {"channels": 24, "azimuth_steps": 240}
OUTDOORS = DriftConfig(**_RAYS)
INDOORS = DriftConfig(
    speed=1.5, step_m=0.5, corner_radius=1.0, height=1.2, max_range=40.0, vertical_fov_deg=(-25.0, 25.0), **_RAYS
)
PARKING = DriftConfig(speed=3.0, corner_radius=3.0, max_range=40.0, vertical_fov_deg=(-20.0, 20.0), **_RAYS)


def _city(seed: int) -> Case:
    random = np.random.default_rng([seed, 1])
    world, s = city(3, 3, seed=seed), 60.0
    i, j = random.integers(0, 2, 2).tolist()
    a = [[s * i, s * j + 10], [s * i, s * j + s], [s * i + s, s * j + s], [s * i + s, s * j]]
    b = [[s * i + s, s * j + 20], [s * i + s, s * j + s], [s * i, s * j + s], [s * i, s * j + 5]]
    return world, a, world, b if seed % 4 < 2 else [*b[::-1]], OUTDOORS


def _city_another_day(seed: int) -> Case:
    """The same city, a fifth of its objects elsewhere."""
    world, a, _, b, config = _city(seed)
    return world, a, another_day(world, seed), b, config


def _city_other(seed: int) -> Case:
    world, a, _, b, config = _city(seed)
    return world, a, city(3, 3, seed=seed + 1000), b, config


def _corridor_route(k: int, half: float, random: np.random.Generator) -> Route:
    first, last = -half + random.uniform(0, 4), half - random.uniform(0, 4)
    return [[first, 12.0 * k], [last, 12.0 * k]][:: 1 if random.random() < 0.5 else -1]


def _corridors(seed: int) -> Case:
    """The same corridor, whole, and a passage at its end that is not the same everywhere."""
    random, world = np.random.default_rng([seed, 2]), parallel_corridors()
    k = int(random.integers(0, 2))
    x = 31.5
    a = [[-x + 5, 12.0 * k], [x, 12.0 * k], [x, 12.0 * k + 12], [x - 20, 12.0 * k + 12]]
    b = [[x - 30, 12.0 * k + 12], [x, 12.0 * k + 12], [x, 12.0 * k], [-x + 10, 12.0 * k]]
    return world, a, world, b, INDOORS


def _corridors_other(seed: int) -> Case:
    """Two corridors that are the same, whole or a part of them."""
    random, world = np.random.default_rng([seed, 3]), parallel_corridors()
    a, b = random.permutation(4)[:2].tolist()
    half = [30.0, 22.0, 15.0][seed % 3]
    return world, _corridor_route(a, half, random), world, _corridor_route(b, half, random), INDOORS


def _car_park(seed: int) -> Case:
    random, world = np.random.default_rng([seed, 4]), car_park()
    j = 8.0 * int(random.integers(1, 5))
    a = [[8, j], [72, j], [72, j + 8], [20, j + 8]]
    b = [[30, j + 8], [72, j + 8], [72, j], [16, j]]
    return world, a, world, b, PARKING


def _car_park_other(seed: int) -> Case:
    random, world = np.random.default_rng([seed, 5]), car_park()
    j, k = 8.0 * (1 + random.permutation(6)[:2])
    return world, [[16, j], [64, j]], world, [[16, k], [64, k]], PARKING


def _lap(k: int) -> Route:
    x, y = 36.0 / 2 - 1.5, 24.0 / 2 - 1.5
    return [[-x, -y, 4.0 * k], [x, -y, 4.0 * k], [x, y, 4.0 * k], [-x, y, 4.0 * k], [-x, -y + 2, 4.0 * k]]


def _storeys(seed: int) -> Case:
    """One storey, of a building whose others neither of them saw."""
    world = storeys(seed=seed)
    return world, _lap(1), world, _lap(1)[1:4], INDOORS


def _storeys_other(seed: int) -> Case:
    """Two storeys that are the same, and a third one: which of the two it is cannot be told."""
    world = storeys(seed=seed)
    return world, _lap(0) + _lap(1), world, _lap(2), INDOORS


CASES: dict[str, Callable[[int], Case]] = {name[1:]: case for name, case in list(globals().items()) if name in (
    "_city", "_city_another_day", "_city_other", "_corridors", "_corridors_other",
    "_car_park", "_car_park_other", "_storeys", "_storeys_other",
)}  # fmt: skip


def session(name: str, world: World, route: Route, config: DriftConfig, seed: int) -> tuple[Session, np.ndarray]:
    """A session whose frame is where its first scan was, and that frame in the world."""
    drive = simulate_drifting_drive(world, route, config, seed)
    builder, maps, zero = LocalMapBuilder(), [], np.zeros((6, 6))
    start = drive.T_world_body[0]
    for time_ns, T, scan in zip(drive.time_ns.tolist(), drive.T_odo_body, drive.scans, strict=True):
        maps += builder.push(time_ns, T, zero, scan)
    maps += builder.flush()
    return Session.of(name, [replace(m, T_odo_map=se3.compose(se3.inverse(start), m.T_odo_map)) for m in maps]), start


def run(name: str, seed: int) -> dict[str, float | str | bool]:
    """One pair of sessions."""
    first, route_a, second, route_b, config = CASES[name](seed)
    a, T_a = session("a", first, route_a, config, 2 * seed)
    b, T_b = session("b", second, route_b, config, 2 * seed + 1)
    began = time.perf_counter()
    alignment = align_sessions([a, b])
    seconds = time.perf_counter() - began
    (meeting,) = alignment.meetings
    row: dict[str, float | str | bool] = {"maps": f"{len(a.maps)}+{len(b.maps)}", "seconds": seconds, "joined": False}
    row["standing"] = meeting.standing
    row["why"] = meeting.refusal or f"{len(meeting.accepted)} encounters, {meeting.confirmed} of {meeting.predicted} confirmed"
    if len(alignment.worlds) == 1:
        (world,) = alignment.worlds
        xi = se3.log(se3.compose(se3.inverse(se3.compose(se3.inverse(T_a), T_b)), world.T_world_session[1]))
        row["joined"], row["error_m"] = True, float(np.linalg.norm(xi[3:]))
        row["nees"] = float(xi @ np.linalg.solve(world.covariance[1], xi))
        is_off = np.linalg.norm(xi[3:]) > 0.5 or np.linalg.norm(xi[:3]) > np.deg2rad(2.0)
        row["false"] = bool(name.endswith("_other") or is_off)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="comma-separated")
    parser.add_argument("--seeds", default="1:10:2", help="first:last:step, the last one excluded")
    options = parser.parse_args()
    seeds = range(*(int(text) for text in options.seeds.split(":")))
    for name in options.cases.split(","):
        rows = []
        for seed in seeds:
            rows.append(run(name, seed))
            r = rows[-1]
            found = f"{r['error_m']:.3f} m, NEES {r['nees']:.1f} of 6" if r["joined"] else "apart"
            mark = "FALSE " if r.get("false") else ""
            stands = f", {r['standing']:.2f} stands" if np.isfinite(float(r["standing"])) else ""
            print(
                f"{name:16s} {seed:4d} {r['maps']:>6s} maps {r['seconds']:5.1f} s  {mark}{found}{stands}: {r['why']}",
                flush=True,
            )
        joined = [r for r in rows if r["joined"]]
        errors = [float(r["error_m"]) for r in joined if not r.get("false")]
        nees = [float(r["nees"]) for r in joined if not r.get("false")]
        print(
            f"{name:16s} {len(joined)} of {len(rows)} joined, {sum(bool(r.get('false')) for r in joined)} false, "
            f"median error {np.median(errors) if errors else float('nan'):.3f} m, "
            f"mean NEES {np.mean(nees) if nees else float('nan'):.1f} of 6",
            flush=True,
        )


if __name__ == "__main__":
    main()
