"""An odometry that slips, and says nothing of it: which drives of `Slam` are in doubt, slipped ones and sound ones.

    python benchmarks/slip_campaign.py --seeds 7:10:2 --slips none,within,gradual
    python benchmarks/slip_campaign.py --worlds estates,block --seeds 7:10:2 --slips none,within --loops

At 0.3 to 0.6 of the way everything moves by 6 to 25 m, any way (`within`: from one scan to the next; `gradual`: along 20 m of
way; `small`: by 2 to 6 m; `turn`: by 5° to 12° about where it is). Sound drives: `none`; `drift`, three times what is claimed;
`convoy`, lorries that go along on both sides and ahead, each for some of the way. Local maps are cut from that odometry, so that
a slip falls anywhere in them. `--loops` closes loops as well, which may bear an odometry out; without, successive local maps are
asked alone. Settings were chosen on even seeds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from slam_campaign import INDOORS, WORLDS

from boxplus.manifolds import se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.registration import Surface
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drifting_drive
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.alike import estates
from boxplus.simulation.worlds.world import World, box
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.odometry_chain import OdometryChain
from boxplus.systems.slam.seam import Seams
from boxplus.systems.slam.slam import Slam

Floats = NDArray[np.float64]
Drive = tuple[World, list[list[float]], DriftConfig]
SOUND = ("none", "drift", "convoy")
SLIPS = (*SOUND, "within", "gradual", "small", "turn")
_OUTDOORS = DriftConfig(channels=24, azimuth_steps=240)
_INDOORS = DriftConfig(**INDOORS)
_GRADUAL_M = 20.0


def _round(x: float, y: float, laps: int = 1) -> list[list[float]]:
    lap = [[-x, -y], [x, -y], [x, y], [-x, y]]
    return [*lap * laps, *lap[:2]]


def _estates(seed: int) -> Drive:
    """Round a block of one, over to the other one, round its block; every second drive comes back."""
    route = [[0, 0], [60, 0], [60, 60], [0, 60], [0, 0], [180, 0], [240, 0], [240, 60], [180, 60], [180, 0]]
    route += [[240, 0], [240, 60], [60, 60], [60, 20]] if seed % 4 == 1 else [[200, 0]]
    return estates(seed=seed), route, _OUTDOORS


def _alleys(seed: int) -> Drive:
    route = [[10, 0], [40, 0], [40, 40], [0, 40], [0, 0], [40, 0], [80, 0], [80, 40], [40, 40], [40, 10]]
    config = _OUTDOORS.model_copy(update={"speed": 3.0, "corner_radius": 2.0})
    return worlds.city(2, 2, pitch=40.0, street=7.0, seed=seed), route, config


def _squares(seed: int) -> Drive:
    _, route, config, _ = WORLDS["city"](seed)
    return worlds.city(3, 3, squares=[(0, 0), (1, 1)], seed=seed), route, config


MORE: dict[str, Callable[[int], Drive]] = {
    "estates": _estates,
    "alleys": _alleys,
    "squares": _squares,
    "hall": lambda seed: (worlds.hall(seed=seed), _round(20.0, 4.0, 2), _INDOORS.model_copy(update={"corner_radius": 2.0})),
    "room": lambda seed: (worlds.room(seed=seed), _round(3.0, 1.5, 3), _INDOORS.model_copy(update={"corner_radius": 0.5})),
    "yard": lambda seed: (worlds.yard(seed=seed), _round(40.0, 40.0), _OUTDOORS),
    "forest": lambda seed: (sites.forest(seed=seed), _round(28.0, 28.0), _OUTDOORS),
    "field": lambda seed: (sites.open_field(seed=seed), _round(40.0, 40.0), _OUTDOORS),
    "street": lambda seed: (sites.street(seed=seed), [[-110.0, 0.0], [110.0, 0.0]], _OUTDOORS),
    "highway": lambda seed: (sites.highway(600.0, seed=seed), [[-200.0, 0.0], [200.0, 0.0]], _OUTDOORS),
    "tunnel": lambda seed: (sites.tunnel(300.0), [[-100.0, 0.0], [100.0, 0.0]], _OUTDOORS),
    "smooth_corridor": lambda seed: (worlds.corridor(200.0), [[-80.0, 0.0], [80.0, 0.0]], _INDOORS),
}
# Storeys alike are doubted whatever happens.
ALL = [name for name in (*MORE, *WORLDS) if "storeys" not in name and name != "long"]


class _Convoy(World):
    """A world with lorries beside and before whoever looks: each for a third of the way, and then it is gone."""

    def __init__(self, world: World, config: DriftConfig, seed: int) -> None:
        super().__init__(list(world.solids))
        random = np.random.default_rng([seed, 77])
        self._scale, self._config = (0.3, config) if config.max_range < 50.0 else (1.0, config)
        self._begins, self._scan = random.uniform(0.0, 1.0, 3), 0

    def cast(
        self, directions_lidar: Floats, R_world_lidar: Floats, p_world_lidar: Floats, max_range: float = 200.0
    ) -> tuple[Floats, NDArray[np.uint32]]:
        """One scan, the next of the drive."""
        ranges, hits = super().cast(directions_lidar, R_world_lidar, p_world_lidar, max_range)
        way, self._scan = self._scan * self._config.step_m, self._scan + 1
        R, p = R_world_lidar[0], p_world_lidar[0]
        there = (self._begins + way / (150.0 * self._scale)) % 1.0 < 1.0 / 3.0
        ahead = 2.0 * np.sin(way / 15.0)
        places = np.array([[ahead, 2.9, 0.2], [11.0 + ahead, 0.0, 0.2], [ahead - 1.0, -2.9, 0.2]])[there]
        size = self._scale * np.array([12.0, 2.4, 3.6])
        if len(places):
            lorries = World([box(p + self._scale * (R @ place), size, R_world_box=R) for place in places])
            ranges = np.minimum(ranges, lorries.cast(directions_lidar, R_world_lidar, p_world_lidar, max_range)[0])
        return ranges, hits


def slipped(T_odo: Floats, slip: str, name: str, seed: int) -> tuple[Floats, str]:
    """The poses (K, 7) with a slip drawn from world and seed, and how large it is."""
    random = np.random.default_rng([seed, *name.encode()])
    at, way, metres = random.uniform(0.3, 0.6), random.uniform(0.0, 2.0 * np.pi), random.uniform(6.0, 25.0)
    small, turn = random.uniform(2.0, 6.0), np.deg2rad(random.uniform(5.0, 12.0)) * random.choice([-1.0, 1.0])
    if slip in SOUND:
        return T_odo, ""
    metres, turn = (0.0, turn) if slip == "turn" else (small if slip == "small" else metres, 0.0)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T_odo[:, 4:], axis=0), axis=1))])
    first = int(at * len(T_odo))
    length = _GRADUAL_M if slip == "gradual" else 1e-6
    share = np.clip((travelled - travelled[first - 1]) / length, 0.0, 1.0)
    there = np.array([1.0, 0.0, 0.0, 0.0, *T_odo[first, 4:]])
    xi = np.array([0.0, 0.0, turn, metres * np.cos(way), metres * np.sin(way), 0.0])
    jump = se3.compose(se3.compose(there, se3.exp(share[:, None] * xi)), se3.inverse(there))
    return se3.compose(jump, T_odo), f"{metres:.1f} m" if metres else f"{np.rad2deg(turn):.0f} deg"


def local_maps(name: str, seed: int, slip: str) -> tuple[list[LocalMap], str]:
    world, route, config = MORE[name](seed) if name in MORE else WORLDS[name](seed)[:3]
    if slip == "drift":
        rates = {field: 3.0 * getattr(config, field) for field in ("yaw_drift", "tilt_drift", "position_drift")}
        config = config.model_copy(update=rates)
    if slip == "convoy":
        world = _Convoy(world, config, seed)
    drive = simulate_drifting_drive(world, route, config, seed)
    T_odo, size = slipped(drive.T_odo_body, slip, name, seed)
    builder, maps, zero = LocalMapBuilder(), [], np.zeros((6, 6))
    for time_ns, T, scan in zip(drive.time_ns.tolist(), T_odo, drive.scans, strict=True):
        maps += builder.push(time_ns, T, zero, scan)
    return maps + builder.flush(), size


def run(name: str, seed: int, slip: str, with_loops: bool) -> bool:
    """One drive; whether it is in doubt. Prints a row of text."""
    maps, size = local_maps(name, seed, slip)
    began = time.perf_counter()
    if with_loops:
        slam = Slam()
        for local_map in maps:
            slam.add(local_map)
        doubt, most = slam.doubt, f"{sum(loop.is_accepted for loop in slam.loops)} loops"
    else:
        seams, odometry = Seams(SlamConfig()), OdometryChain()
        for local_map in maps:
            odometry.add(local_map)
            seams.add(local_map, Surface.of(local_map.points), odometry)
        doubt, worst = seams.doubt([]), max(seams.pairs, key=lambda seam: seam.share, default=None)
        most = "" if worst is None else f"{worst.share:.2f} of {worst.told}, {worst.before} to {worst.after}"
    seconds = time.perf_counter() - began
    told = "-" if doubt is None else doubt.split(":")[0]
    print(f"{name:16s} {seed:4d} {slip:8s} {size:7s} {len(maps):4d} maps  {most:28s} {seconds:4.0f} s  {told}", flush=True)
    return doubt is not None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(ALL), help="comma-separated")
    parser.add_argument("--seeds", default="7:10:2", help="first:last:step, the last one excluded")
    parser.add_argument("--slips", default="none,within", help=f"comma-separated, of {', '.join(SLIPS)}")
    parser.add_argument("--loops", action="store_true", help="close loops as well")
    options = parser.parse_args()
    seeds = range(*(int(text) for text in options.seeds.split(":")))
    for slip in options.slips.split(","):
        told = {name: [run(name, seed, slip, options.loops) for seed in seeds] for name in options.worlds.split(",")}
        worlds_told = ", ".join(f"{name} {sum(of)}/{len(of)}" for name, of in told.items())
        print(f"{slip}: {sum(map(sum, told.values()))} of {sum(map(len, told.values()))} in doubt ({worlds_told})", flush=True)


if __name__ == "__main__":
    main()
