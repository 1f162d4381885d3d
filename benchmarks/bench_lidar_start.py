"""Many random starts in motion of a LiDAR that is alone: does its path begin at the right speed?

    python benchmarks/bench_lidar_start.py                      # 28 seeds
    python benchmarks/bench_lidar_start.py --seeds 0:342 --jobs 2
    python benchmarks/bench_lidar_start.py --seeds 17:18 -v     # one, with all it says

A seed draws a place, a spinning LiDAR or a rosette, how it is mounted, a speed of up to 18 m/s and whether the platform
turns; nine scans are cast from the first instant on, and registered without an IMU (`lidar_path`). A step of the path is
wrong where it is off by 0.5 m/s and by five of its own standard deviations; a path, where any of its steps is. Even seeds
are for choosing settings, odd seeds for reporting; the tables keep them apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from metrics import Metric
from seeds import run_seeds_as_script

from boxplus.manifolds import so3
from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions.manoeuvres import constant_turn, constant_velocity
from boxplus.simulation.scenarios import mounting
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import middle_of, with_cells_for_all
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

_SCANS, _SCANS_S, _DURATION_S = 9, 1.05, 1.3
_FASTEST, _FASTEST_TURN = 18.0, 0.7  # m/s, rad/s
_ASKEW, _TURNED = 0.4, 0.3  # share of mountings at any angle; rad, of a heading against the way
_WRONG_M_S, _WRONG_SIGMAS = 0.5, 5.0
# World of a seed, where its middle is, and whether one may drive through it in any direction.
PLACES: dict[str, tuple[Callable[[int], Any], tuple[float, float, float], bool]] = {
    "hall": (lambda seed: worlds.hall(seed=seed), (0.0, 0.0, 1.5), True),
    "yard": (lambda seed: worlds.yard(seed=seed), (0.0, 0.0, 1.8), True),
    "city": (lambda seed: worlds.city(seed=seed), (0.0, 0.0, 1.7), False),
    "street": (lambda seed: sites.street(seed=seed), (0.0, 0.0, 1.8), False),
    "warehouse": (lambda seed: sites.warehouse(seed=seed), (0.0, 0.0, 1.5), False),
    "forest": (lambda seed: sites.forest(seed=seed), (0.0, 0.0, 1.5), True),
    "open field": (lambda seed: sites.open_field(seed=seed), (0.0, 0.0, 1.6), True),
}
SENSORS: dict[str, Callable[[], Any]] = {
    "16 rings": lambda: SpinningLidar(channels=16, azimuth_steps=900),
    "32 rings": lambda: SpinningLidar(channels=32, azimuth_steps=512),
    "64 rings": lambda: SpinningLidar(channels=64, azimuth_steps=512),
    "rosette": lambda: RosetteLidar(points_per_scan=20_000),
}


def draw(seed: int) -> tuple[dict[str, Any], Simulation]:
    """What a seed stands for, and its recording."""
    random = np.random.default_rng([seed, 77])
    place = list(PLACES)[seed // 2 % len(PLACES)]
    world, middle, any_way = PLACES[place]
    sensor, speed = str(random.choice(list(SENSORS))), float(random.uniform(0.0, _FASTEST))
    way = random.uniform(-np.pi, np.pi) if any_way else float(random.choice([0.0, np.pi]))
    turn = float(random.choice([0.0, 0.0, random.uniform(-_FASTEST_TURN, _FASTEST_TURN)])) if any_way else 0.0
    heading = way + float(random.choice([0.0, random.normal(0.0, _TURNED)]))
    ahead = np.array([np.cos(way), np.sin(way), 0.0])
    begin = middle - 0.4 * speed * ahead + [0.0, random.uniform(-0.5, 0.5), random.uniform(-0.2, 0.3)]
    angles = random.uniform(-180.0, 180.0, 3) if random.random() < _ASKEW else np.zeros(3)
    if turn != 0.0 and speed > _WRONG_M_S:
        motion = constant_turn(_DURATION_S, begin, speed / abs(turn), turn)
    else:
        motion = constant_velocity(_DURATION_S, begin, speed * ahead, so3.exp(np.array([0.0, 0.0, heading])))
    mounted = mounting(*angles, (0.0, 0.0, 0.0))
    drawn = {"seed": seed, "place": place, "sensor": sensor, "speed": round(speed, 2), "turn": round(turn, 3)}
    return drawn, Simulation(Scenario("start", world(seed), motion, SENSORS[sensor](), ImuModel(), mounted), seed, _SCANS_S)


def run_seed(seed: int) -> dict[str, Any]:
    """Register the scans of a seed; what came of it."""
    drawn, simulation = draw(seed)
    all_scans = [simulation.scan(number) for number in range(min(_SCANS, simulation.scan_count))]
    scans = [scan for scan in all_scans if len(scan)]  # mounted upwards, a LiDAR may see nothing
    began = time.process_time()
    path = lidar_path(scans, with_cells_for_all(scans, LioConfig()))
    seconds = time.process_time() - began
    errors = _errors(path, simulation, [middle_of(scan) for scan in scans])
    wrong = [error is not None and error[0] >= _WRONG_M_S and error[1] >= _WRONG_SIGMAS for error in errors]
    return drawn | {
        "began": "wrong" if wrong[:1] == [True] else "right" if errors and errors[0] is not None else "refused",
        "wrong": any(wrong),
        "failed": path.failed,
        "errors": errors,
        "time_s": seconds,
    }


def _errors(path: LidarPath, simulation: Simulation, time_ns: Sequence[int]) -> list[tuple[float, float] | None]:
    """Of every step of the path: by how much its speed is off [m/s], in standard deviations; None where the path began anew."""
    truth, T = simulation.ground_truth(np.array(time_ns, np.int64)), simulation.T_imu_lidar
    R, p = truth.R_world_imu @ T[:3, :3], truth.R_world_imu @ T[:3, 3] + truth.p_world_imu
    errors: list[tuple[float, float] | None] = []
    for k in range(1, len(path)):
        if path.segment[k] != path.segment[k - 1]:
            errors.append(None)
            continue
        n = int(np.searchsorted(time_ns, path.time_ns[k]))
        found = path.R_path_lidar[k - 1].T @ (path.p_path_lidar[k] - path.p_path_lidar[k - 1])
        off = found - R[n - 1].T @ (p[n] - p[n - 1])
        along = path.R_path_lidar[k - 1] @ off
        sigmas = float(np.sqrt(along @ path.information[k, 3:, 3:] @ along))
        errors.append((float(np.linalg.norm(off)) / ((time_ns[n] - time_ns[n - 1]) * 1e-9), sigmas))
    return errors


def report(lines: Sequence[dict[str, Any]]) -> str:
    """The tables of both halves."""
    text = []
    for half, name in ((0, "even seeds (settings were chosen on these)"), (1, "odd seeds (untouched)")):
        mine = [line for line in lines if line["seed"] % 2 == half]
        if not mine:
            continue
        text.append(f"\n{name}: {len(mine)} starts, {sum(line['time_s'] for line in mine) / len(mine):.2f} s each")
        text.append(f"{'place':<12} {'runs':>5} {'begin right':>12} {'wrong':>6} {'refused':>8} {'paths wrong':>12}")
        for place in PLACES:
            rows = [line for line in mine if line["place"] == place]
            counts = [sum(line["began"] == began for line in rows) for began in ("right", "wrong", "refused")]
            wrong = sum(line["wrong"] for line in rows)
            if rows:
                text.append(f"{place:<12} {len(rows):>5} {counts[0]:>12} {counts[1]:>6} {counts[2]:>8} {wrong:>12}")
        text += [
            f"  seed {line['seed']} {line['place']}, {line['sensor']}, {line['speed']:.1f} m/s: "
            + ("begins wrongly" if line["began"] == "wrong" else "wrong later")
            for line in mine
            if line["wrong"]
        ]
    return "\n".join(text)


def figures(lines: Sequence[dict[str, Any]]) -> list[Metric]:
    """What a baseline holds: paths that are wrong."""
    share = 100.0 * sum(line["wrong"] for line in lines) / max(len(lines), 1)
    return [Metric("lidar_start/paths wrong", share, "%", "lower", 0.0, tolerance=0.2)]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    run_seeds_as_script(__doc__.splitlines()[0], run_seed, report, figures, seeds="0:28", arguments=arguments)


if __name__ == "__main__":
    main()
