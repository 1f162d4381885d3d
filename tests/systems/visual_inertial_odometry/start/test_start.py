"""The start on simulated corners: right where it is given, refused with its number where it cannot be known."""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.manifolds import quaternion
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.start.search import StartSearch
from boxplus.systems.visual_inertial_odometry.start.start import Start, find_rest

CONFIG = VioConfig()


@pytest.fixture(scope="module")
def bench() -> Iterator[ModuleType]:
    """The simulated starts of the benchmark, which is not a package of the library; it leaves no trace."""
    folder = str(Path(__file__).resolve().parents[4] / "benchmarks")
    sys.path.insert(0, folder)
    try:
        yield importlib.import_module("bench_vio_start")
    finally:
        sys.path.remove(folder)
        sys.modules.pop("bench_vio_start", None)


def seed_of(bench: ModuleType, motion: str, cameras: int, number: int = 0) -> int:
    """An odd seed with this motion and so many cameras."""
    of_motion = (s for s in range(1, 4001, 2) if bench.MOTIONS[(s // 2) % len(bench.MOTIONS)] == motion)
    fits = [s for s, _ in zip(of_motion, range(40), strict=False) if bench.cameras_of(s) == cameras]
    return fits[number]


@pytest.mark.slow
def test_most_starts_are_found_and_none_is_wrong(bench) -> None:
    """A part of `benchmarks/bench_vio_start.py`."""
    lines = [bench.run_seed(seed) for seed in range(3001, 3049, 2)]
    assert Counter(line["verdict"] for line in lines)["wrong"] == 0
    moving = [line for line in lines if line["excitation"] > 0.5 and line["motion"] in ("flying", "handheld")]
    assert len(moving) > 5 and all(line["verdict"] == "right" for line in moving)
    assert all(line["verdict"] == "right" for line in lines if line["motion"] in ("rest", "take-off"))


@pytest.mark.parametrize("motion", ["constant velocity", "rotation"])
def test_one_camera_refuses_what_does_not_show_the_scale(bench, motion) -> None:
    line = bench.run_seed(seed_of(bench, motion, 1))
    assert line["verdict"] == "refused" and "needed to see the scale" in line["said"]


def test_several_cameras_start_at_constant_velocity(bench) -> None:
    line = bench.run_seed(seed_of(bench, "constant velocity", 2))
    assert line["verdict"] == "right" and line["said"] == "moving stereo"


def find_start(seen: Sequence[Tracks], imu: ImuSamples, rig: Rig, config: VioConfig) -> Start | str | None:
    """What is found in all these frames at once."""
    search = StartSearch()
    for tracks in seen:
        search.add(tracks, config)
    return search.look(imu, rig, config) or search.problem


def start_of(bench: ModuleType, motion: str, cameras: int, frames: int = 41) -> tuple[Start | str, object]:
    drawn = bench.draw(seed_of(bench, motion, cameras))
    return find_start(drawn.seen[:frames], drawn.imu, drawn.rig, CONFIG), drawn


def test_a_moving_start_has_keyframes_that_begin_at_the_origin(bench) -> None:
    found, drawn = start_of(bench, "handheld", 2)
    assert isinstance(found, Start) and found.kind == "moving stereo"
    assert found.frames[0] == 0 and found.frames[-1] == 40 and (np.diff(found.frames) > 0).all()
    assert found.time_ns.tolist() == [drawn.seen[k].time_ns for k in found.frames]
    assert np.allclose(found.T_world_imu[0, 4:], 0.0) and np.allclose(np.linalg.norm(found.T_world_imu[:, :4], axis=1), 1.0)
    assert np.linalg.eigvalsh(found.last_covariance)[0] > -1e-12 and found.sigma.shape == (15,)
    assert found.facts["gravity, deviation beside the bias [deg]"] < 0.45 and not found.bias_before.any()


def test_rest_knows_that_bias_and_tilt_are_not_told_apart(bench) -> None:
    found, _ = start_of(bench, "rest", 1)
    assert isinstance(found, Start) and found.kind == "at rest" and found.frames.tolist() == [40]
    P = found.covariance
    tilt, bias = np.sqrt(np.trace(P[:3, :3])), np.sqrt(np.trace(P[12:, 12:]))
    assert bias / 9.81 == pytest.approx(tilt, rel=0.1)
    assert tilt == pytest.approx(np.sqrt(2.0) * CONFIG.accel_bias_sigma / 9.81, rel=0.1)
    theta = np.array([0.0, 0.01, 0.0])
    up = quaternion.to_matrix(found.T_world_imu[:, :4])[0].T @ [0.0, 0.0, 1.0]
    change = -np.cross(up, theta) * 9.81  # the bias that hides a turn by theta: R Exp(θ) up
    hidden = np.concatenate([theta - up * (up @ theta), np.zeros(9), change])
    shown = np.concatenate([theta - up * (up @ theta), np.zeros(9), -change])
    information = np.linalg.inv(P + 1e-10 * np.eye(15))
    assert hidden @ information @ hidden < 3.0 < 100.0 < shown @ information @ shown


def test_too_short_too_few_and_gaps_are_named(bench) -> None:
    drawn = bench.draw(seed_of(bench, "handheld", 2))
    assert "s of frames were seen (1 are needed)" in str(find_start(drawn.seen[:10], drawn.imu, drawn.rig, CONFIG))
    few = [replace(t, ids=t.ids[:5], pixels=t.pixels[:5], rays=t.rays[:5], is_new=t.is_new[:5]) for t in drawn.seen[:41]]
    assert "corners were followed through 3 keyframes (20 are needed)" in str(find_start(few, drawn.imu, drawn.rig, CONFIG))
    time_s = (drawn.imu.time_ns - drawn.imu.time_ns[0]) * 1e-9
    there = (time_s < 0.7) | (time_s > 1.0)
    holed = ImuSamples(drawn.imu.time_ns[there], drawn.imu.gyro[there], drawn.imu.accel[there])
    assert "a gap of 0.3" in str(find_start(drawn.seen[:41], holed, drawn.rig, CONFIG))


@pytest.mark.parametrize(("motion", "cameras"), [("flying", 1), ("handheld", 2)])
def test_no_start_ends_in_frames_that_see_nothing(bench, motion, cameras) -> None:
    """A lens that is covered at the end: nothing holds the pose that the run would begin with."""
    drawn = bench.draw(seed_of(bench, motion, cameras))
    seen = drawn.seen[:61]
    assert isinstance(find_start(seen, drawn.imu, drawn.rig, CONFIG), Start)
    few = [replace(t, ids=t.ids[:3], pixels=t.pixels[:3], rays=t.rays[:3], is_new=t.is_new[:3]) for t in seen[-4:]]
    said = str(find_start([*seen[:-4], *few], drawn.imu, drawn.rig, CONFIG))
    assert "corners are in the newest frame (6 are needed): it is blind" in said


def test_a_saturated_gyroscope_is_refused(bench) -> None:
    drawn = bench.draw(seed_of(bench, "flying", 2))
    random = np.random.default_rng(0)
    jumping = replace(drawn.imu, gyro=drawn.imu.gyro + random.choice([0.0, 3.0], drawn.imu.gyro.shape))
    assert "as a saturated or loose one does" in str(find_start(drawn.seen[:41], jumping, drawn.rig, CONFIG))


def test_a_wrong_mounting_is_refused(bench) -> None:
    """The camera turned by a quarter: nothing fits."""
    drawn = bench.draw(seed_of(bench, "handheld", 2))
    Rz = np.eye(4)
    Rz[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    cameras = drawn.rig.cameras
    turned = Rig.of([c.model for c in cameras], [Rz @ c.T_imu_camera for c in cameras], [(752, 480)] * 2, drawn.rig.noise)
    for frames in (31, 61):
        assert isinstance(find_start(drawn.seen[:frames], drawn.imu, turned, CONFIG), str)


def test_the_same_frames_give_the_same_bits(bench) -> None:
    first, _ = start_of(bench, "handheld", 1, 61)
    again, _ = start_of(bench, "handheld", 1, 61)
    if isinstance(first, str):
        assert first == again
    else:
        assert isinstance(again, Start) and np.array_equal(first.T_world_imu, again.T_world_imu)


def test_two_samples_are_too_few_to_tell_rest() -> None:
    seen: Any = [SimpleNamespace(time_ns=0), SimpleNamespace(time_ns=10**9)]
    imu = ImuSamples(np.array([-1, 10**9 + 1]), np.zeros((2, 3)), np.ones((2, 3)))
    rig: Any = SimpleNamespace(noise=ImuNoise(1e-3, 1e-2, 1e-4, 1e-3))
    assert find_rest(seen, imu, rig, CONFIG) == "0 IMU samples in 1.00 s (10 are needed)"
