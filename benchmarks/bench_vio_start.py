"""Many random starts of visual-inertial odometry: is every one right, or refused?

    python benchmarks/bench_vio_start.py                      # 40 seeds
    python benchmarks/bench_vio_start.py --seeds 0:2000 --half odd --jobs 2
    python benchmarks/bench_vio_start.py --seeds 17:18 -v     # one, with all it says

A seed draws a motion, a room, one camera or two, noise, mistaken tracks and the biases of an IMU like EuRoC's. Corners and
IMU samples are simulated; images are not. Frames are given one after the other, as in the odometry, until there is a start or
five seconds are over. A start is wrong when the scale is off by more than 10 %
(where something moved by 5 cm or more), gravity by more than 1° and 3 of the standard deviations stated, or a component of the
last state by more than 5. Before a body has turned, a bias of the accelerometer is not told from tilt: how many starts are off
by more than 1° within what they state is counted apart. Even seeds are for choosing settings, odd seeds for reporting; the
tables keep them apart.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from metrics import Metric
from numpy.typing import NDArray
from seeds import run_seeds_as_script

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras.feature_tracks import TrackModel, track_points
from boxplus.simulation.imu import BiasWalk, ImuModel, Vibration, measure
from boxplus.simulation.motions.manoeuvres import constant_turn, constant_velocity, drone_within, handheld, level
from boxplus.simulation.motions.spline import Motion, Trajectory
from boxplus.simulation.motions.trajectories import at_rest, spin_in_place
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.start.search import StartSearch
from boxplus.systems.visual_inertial_odometry.start.start import Start

MOTIONS = (
    "flying", "handheld", "flying", "handheld", "flying", "handheld",
    "rest", "shaken rest", "take-off", "constant velocity", "rotation", "constant turn",
)  # fmt: skip
_DURATION_S = 5.0
_FRAME_HZ = 20.0
_FOCAL = 460.0
_EXCITED = 0.5  # m/s²
_MOVED_M = 0.05
_SCALE, _GRAVITY_DEG, _GRAVITY_SIGMAS, _SIGMAS = 0.1, 1.0, 3.0, 5.0
_LOOKING_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera axes in an IMU whose x is forward


@dataclass
class Drawn:
    """What a seed stands for."""

    motion: str
    cameras: int
    noise_px: float
    outliers: float
    rig: Rig
    seen: list[Tracks]
    imu: ImuSamples
    truth: Motion
    gyro_bias: NDArray[np.float64]
    accel_bias: NDArray[np.float64]


def cameras_of(seed: int) -> int:
    """One or two."""
    return int(_random(seed).integers(1, 3))


def _random(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64([seed, 77]))


def draw(seed: int) -> Drawn:
    """Everything about a seed."""
    random = _random(seed)
    kind = MOTIONS[(seed // 2) % len(MOTIONS)]
    cameras = int(random.integers(1, 3))
    trajectory, low, high = _trajectory(kind, random)
    rig = _rig(cameras, random)
    model = ImuModel(
        gyro_bias=tuple(_in_ball(random, 0.1)),
        accel_bias=tuple(_in_ball(random, 0.15)),
        accel_vibration=random.uniform(0.3, 1.5) if kind == "shaken rest" else 0.0,
        gyro_vibration=random.uniform(0.01, 0.05) if kind == "shaken rest" else 0.0,
    )
    imu_ns = trajectory.start_ns + np.arange(int((_DURATION_S + 0.1) * model.rate_hz) + 1) * round(1e9 / model.rate_hz)
    offset_s = (imu_ns - imu_ns[0]) * 1e-9
    walk, shaking = BiasWalk(model, _DURATION_S + 0.2, random), Vibration(model, _DURATION_S + 0.2, random)
    gyro, accel = measure(model, trajectory.evaluate(imu_ns), *walk.at(offset_s), random)
    extra = shaking.at(offset_s)
    imu = ImuSamples(imu_ns, gyro + extra[0], accel + extra[1])
    frame_ns = imu_ns[0] + round(random.uniform(1e6, 4e7)) + np.arange(int(_DURATION_S * _FRAME_HZ)) * round(1e9 / _FRAME_HZ)
    front = TrackModel(noise_px=random.uniform(0.3, 1.0), outliers=random.uniform(0.0, 0.2), wanted=int(random.integers(60, 150)))
    margin = random.uniform(1.0, 5.0, (2, 3))
    seen = track_points(trajectory, frame_ns, rig.mountings, [low - margin[0], high + margin[1]], random, front)
    gyro_bias, accel_bias = walk.at((frame_ns - imu_ns[0]) * 1e-9)
    truth = trajectory.evaluate(frame_ns)
    return Drawn(kind, cameras, front.noise_px, front.outliers, rig, seen, imu, truth, gyro_bias, accel_bias)


def _trajectory(kind: str, random: np.random.Generator) -> tuple[Trajectory, NDArray[np.float64], NDArray[np.float64]]:
    """A motion and the box it stays in."""
    seed, duration = int(random.integers(1 << 30)), _DURATION_S + 1.0
    half = random.uniform(0.5, 2.5, 3) * [1.0, 1.0, 0.5]
    low, high = -half, half
    if kind in ("flying", "take-off"):
        rest = random.uniform(1.5, 2.5) if kind == "take-off" else 0.0
        speed = min(random.uniform(0.5, 3.0), 2.0 * np.sqrt(half.min()))  # a faster one would have to flip over
        return drone_within(duration, low, high, speed, rest, seed), low, high
    if kind == "handheld":
        return handheld(duration, low, high, random.uniform(0.3, 1.5), random.uniform(0.5, 2.0), 0.0, seed), low, high
    if kind == "constant velocity":
        v = random.standard_normal(3)
        v *= random.uniform(0.2, 2.0) / np.linalg.norm(v)
        R = level(random.uniform(-3.0, 3.0), *random.uniform(-0.2, 0.2, 2))
        reach = np.abs(v) * duration
        return constant_velocity(duration, np.zeros(3), v, R), -reach, reach
    if kind == "rotation":
        spin = spin_in_place(duration + 3.0, np.deg2rad(random.uniform(20.0, 90.0)), (0.0, 0.0, 0.0), 0.5)
        return spin.starting_at(2.0), np.full(3, -0.2), np.full(3, 0.2)
    if kind == "constant turn":
        radius, rate = random.uniform(0.3, 2.0), random.uniform(0.3, 1.0)
        reach = np.array([radius, radius, 0.1])
        return constant_turn(duration, np.zeros(3), radius, rate, random.uniform(-0.2, 0.2, 2)), -reach, reach
    return at_rest(duration, (0.0, 0.0, 0.0)), np.full(3, -0.2), np.full(3, 0.2)


def _rig(cameras: int, random: np.random.Generator) -> Rig:
    R = so3.exp(random.uniform(-0.1, 0.1, 3)) @ _LOOKING_AHEAD
    mountings = []
    for c in range(cameras):
        T = np.eye(4)
        T[:3, :3] = R @ so3.exp(random.uniform(-0.02, 0.02, 3) * (c > 0))
        T[:3, 3] = random.uniform(-0.06, 0.06, 3) if c == 0 else mountings[0][:3, 3] + 0.11 * R[:, 0]
        mountings.append(T)
    model = Pinhole(_FOCAL, _FOCAL, 0.0, 0.0)
    noise = ImuNoise(gyro=1.7e-4, accel=2.0e-3, gyro_walk=1.9e-5, accel_walk=3.0e-3)
    return Rig.of([model] * cameras, mountings, [(752, 480)] * cameras, noise)


def _in_ball(random: np.random.Generator, radius: float) -> list[float]:
    direction = random.standard_normal(3)
    return [float(x) for x in direction / np.linalg.norm(direction) * radius * random.random() ** (1.0 / 3.0)]


def run_seed(seed: int) -> dict[str, Any]:
    """Ask for a start until there is one; a line of JSON."""
    drawn = draw(seed)
    config, search = VioConfig(), StartSearch()
    line: dict[str, Any] = {
        "seed": seed, "motion": drawn.motion, "cameras": drawn.cameras, "noise_px": drawn.noise_px, "outliers": drawn.outliers,
        "excitation": float(np.sqrt(drawn.truth.a_world_imu.var(axis=0).sum())), "verdict": "refused", "time_s": 0.0,
    }  # fmt: skip
    begin = time.process_time()
    for number, tracks in enumerate(drawn.seen):
        search.add(tracks, config)
        until = int(np.searchsorted(drawn.imu.time_ns, tracks.time_ns)) + 1
        known = ImuSamples(drawn.imu.time_ns[:until], drawn.imu.gyro[:until], drawn.imu.accel[:until])
        found = search.look(known, drawn.rig, config)
        line |= {"time_s": time.process_time() - begin, "said": search.problem if found is None else found.kind}
        if found is not None:
            after_s = 1e-9 * (tracks.time_ns - drawn.seen[0].time_ns)
            return line | {"after_s": after_s} | _judge(found, drawn, number + 1 - len(search.seen))
    return line


def _judge(found: Start, drawn: Drawn, first: int) -> dict[str, Any]:
    """Errors of an accepted start."""
    k = first + found.frames
    R_true, p_true = drawn.truth.R_world_imu[k], drawn.truth.p_world_imu[k]
    R = quaternion.to_matrix(found.T_world_imu[:, :4])
    z = np.array([0.0, 0.0, 1.0])
    gravity_deg = np.rad2deg(np.arccos(np.clip((R[-1].T @ z) @ (R_true[-1].T @ z), -1.0, 1.0)))
    # Turn the truth about z and move it, so that the first poses agree as well as that allows.
    M = R[0] @ R_true[0].T
    yaw = np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])
    A = so3.exp(yaw * z)
    R_true, p_true, v_true = A @ R_true, (p_true - p_true[0]) @ A.T, drawn.truth.v_world_imu[k] @ A.T
    p = found.T_world_imu[:, 4:] - found.T_world_imu[0, 4:]
    arm, arm_true = p - p.mean(axis=0), p_true - p_true.mean(axis=0)
    moved = float(np.linalg.norm(p_true - p_true[0], axis=1).max())
    scale = float(np.sqrt((arm**2).sum() / (arm_true**2).sum())) if moved > _MOVED_M else 1.0
    error = np.concatenate(
        [
            so3.log(R[-1].T @ R_true[-1]),
            p_true[-1] - p[-1],
            v_true[-1] - found.velocity_world[-1],
            drawn.gyro_bias[k[-1]] - found.gyro_bias,
            drawn.accel_bias[k[-1]] - found.accel_bias,
        ]
    )
    sigmas = np.abs(error) / np.sqrt(np.maximum(np.diag(found.last_covariance), 1e-18))
    if found.kind == "at rest":
        sigmas[3:6] = 0.0
    wrong = []
    if abs(scale - 1.0) > _SCALE:
        wrong.append(f"scale {scale:.3f}")
    tilt, P_tilt = (R[-1] @ error[:3])[:2], (R[-1] @ found.last_covariance[:3, :3] @ R[-1].T)[:2, :2]
    tilt_sigmas = float(np.sqrt(tilt @ np.linalg.solve(P_tilt, tilt)))
    if gravity_deg > _GRAVITY_DEG and tilt_sigmas > _GRAVITY_SIGMAS:
        wrong.append(f"gravity {gravity_deg:.2f} deg, {tilt_sigmas:.1f} sigma")
    if sigmas.max() > _SIGMAS:
        wrong.append(f"{sigmas.max():.1f} sigma in {int(np.argmax(sigmas))}")
    P = found.last_covariance + np.diag(np.repeat([1e-12, 1e-9, 1e-12, 1e-14, 1e-12], 3))
    return {
        "verdict": "wrong" if wrong else "right",
        "wrong": wrong,
        "scale": scale,
        "gravity_deg": float(gravity_deg),
        "sigmas": float(sigmas.max()),
        "nees": float(error @ np.linalg.solve(P, error)) / 15.0,
        "facts": dict(found.facts),
        "v_error": float(np.linalg.norm(error[6:9])),
    }


def report(lines: Sequence[dict[str, Any]]) -> str:
    """Tables, even and odd seeds apart."""
    text = []
    for half, name in ((0, "even seeds (settings were chosen on these)"), (1, "odd seeds (untouched)")):
        mine = [line for line in lines if line["seed"] % 2 == half]
        if not mine:
            continue
        tilted = sum(line["verdict"] == "right" and line["gravity_deg"] > _GRAVITY_DEG for line in mine)
        wrong = sum(line["verdict"] == "wrong" for line in mine)
        text.append(f"\n{name}: {len(mine)} starts, {wrong} wrong; {tilted} right ones off by more than 1° as they state")
        text.append(
            f"{'motion':<18} {'cameras':>7} {'runs':>5} {'right':>6} {'refused':>8} {'wrong':>6} {'after s':>8} {'NEES':>6}"
        )
        for motion in dict.fromkeys(MOTIONS):
            for cameras in (2, 1):
                rows = [line for line in mine if line["motion"] == motion and line["cameras"] == cameras]
                if rows:
                    text.append(_row(motion, cameras, rows))
        for cameras in (2, 1):
            rows = [line for line in mine if line["cameras"] == cameras and _is_excited(line)]
            if rows:
                text.append(_row(f"above {_EXCITED:g} m/s²", cameras, rows) + f"   {100 * _share(rows):.1f} % right")
        text.append(f"looking for a start takes {np.mean([line['time_s'] for line in mine]):.2f} s in the mean")
        text += [
            f"  seed {line['seed']} {line['motion']}, {line['cameras']}: {line['wrong']}"
            for line in mine
            if line["verdict"] == "wrong"
        ]
    return "\n".join(text)


def figures(lines: Sequence[dict[str, Any]]) -> list[Metric]:
    """What a baseline holds: wrong starts, and the share of right ones where the acceleration varies."""
    wrong = sum(line["verdict"] == "wrong" for line in lines)
    excited = [line for line in lines if _is_excited(line)]
    return [
        Metric("vio_start/wrong", wrong, "starts", "lower", 0.0, tolerance=0.0),
        Metric("vio_start/right where the acceleration varies", 100.0 * _share(excited), "%", "higher", 95.0, tolerance=0.03),
    ]


def _is_excited(line: dict[str, Any]) -> bool:
    return line["excitation"] > _EXCITED and line["motion"] not in ("rest", "shaken rest")


def _share(rows: Sequence[dict[str, Any]]) -> float:
    return sum(line["verdict"] == "right" for line in rows) / len(rows)


def _row(motion: str, cameras: int, rows: Sequence[dict[str, Any]]) -> str:
    counts = [sum(line["verdict"] == verdict for line in rows) for verdict in ("right", "refused", "wrong")]
    after = [line["after_s"] for line in rows if "after_s" in line]
    nees = [line["nees"] for line in rows if "nees" in line]
    middle = f"{np.median(after):8.2f} {np.mean(nees):6.2f}" if after else f"{'-':>8} {'-':>6}"
    return f"{motion:<18} {cameras:>7} {len(rows):>5} {counts[0]:>6} {counts[1]:>8} {counts[2]:>6} {middle}"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    run_seeds_as_script(__doc__.splitlines()[0], run_seed, report, figures, seeds="0:40", arguments=arguments)


if __name__ == "__main__":
    main()
