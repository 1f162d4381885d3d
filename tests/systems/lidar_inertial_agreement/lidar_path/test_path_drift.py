"""A path of the LiDAR alone that drifts is told by its last scans against its first ones; a right one is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.path_drift import path_drift
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG

COUNT, PERIOD_S, SIGMA_M = 15, 0.1, 0.01
HALF = np.array([5.0, 4.0, 2.0])


def box(random: np.random.Generator, count: int) -> np.ndarray:
    """Points (count, 3) on the sides of a box about the origin."""
    points = random.uniform(-1.0, 1.0, (count, 3)) * HALF
    axes = random.integers(0, 3, count)
    points[np.arange(count), axes] = random.choice((-1.0, 1.0), count) * HALF[axes]
    return points + random.normal(0.0, SIGMA_M, points.shape)


def drifting(drift: np.ndarray, seed: int) -> tuple[LidarPath, list[Scan]]:
    """A platform on its way through a box, and its path with a drift (6,) a second, [θ about the LiDAR's axes, p]."""
    random = np.random.default_rng(seed)
    R0 = so3.exp(random.normal(size=3))
    scans, poses = [], []
    for k in range(COUNT):
        t, at_ns = k * PERIOD_S, 10**9 + round(k * PERIOD_S * 1e9)
        R, p = R0 @ so3.exp(np.array([0.0, 0.05, 0.3]) * t), np.array([0.6 * t, 0.2 * np.sin(t), 0.0])
        points = ((box(random, 1500) - p) @ R).astype(np.float32)
        scans.append(Scan(points, np.full(len(points), at_ns), None, at_ns, at_ns))
        poses.append((at_ns, R0.T @ R @ so3.exp(drift[:3] * t), R0.T @ p + drift[3:] * t))
    times, rotations, positions = (np.array(values) for values in zip(*poses, strict=True))
    none = np.zeros(COUNT)
    path = LidarPath(
        times, rotations, positions, np.zeros((COUNT, 6, 6)), np.zeros(COUNT, np.int64), np.zeros(COUNT, bool), none, none, 0
    )
    return path, scans


def still(time_ns: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.eye(3), (len(time_ns), 3, 3))


@pytest.mark.parametrize("seed", range(5))
def test_a_path_that_is_right_does_not_drift(seed: int) -> None:
    assert path_drift(*drifting(np.zeros(6), seed), CONFIG, still) is None


@pytest.mark.parametrize("axis", range(6))
def test_a_drift_is_what_the_last_scans_are_off_by(axis: int) -> None:
    drift = np.zeros(6)
    drift[axis] = np.deg2rad(1.0) if axis < 3 else 0.08
    found = path_drift(*drifting(drift, axis), CONFIG, still)
    assert found is not None
    seconds = (COUNT - 4) * PERIOD_S
    assert found[axis] == pytest.approx(-drift[axis] * seconds, rel=0.35)


@pytest.mark.parametrize("axis", range(6))
def test_a_path_does_not_drift_along_what_its_scans_did_not_show(axis: int) -> None:
    """A weak scan goes on as the ones before it: the batch over path and accelerometer takes nothing from it there."""
    drift = np.zeros(6)
    drift[axis] = np.deg2rad(1.0) if axis < 3 else 0.08
    path, scans = drifting(drift, axis)
    known = np.tile(np.diag(np.repeat([1e6, 1e5], 3)), (COUNT, 1, 1))
    known[6:9, axis] = 0.0
    shown = replace(path, information=known)
    weak = replace(shown, weak=np.isin(np.arange(COUNT), (6, 7, 8)))
    assert path_drift(shown, scans, CONFIG, still) is not None
    assert path_drift(weak, scans, CONFIG, still) is None


def test_scans_of_another_place_tell_nothing() -> None:
    path, scans = drifting(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]), 0)
    far = [
        Scan((scan.p_lidar + 100.0 * (k > 7)).astype(np.float32), scan.time_ns, None, scan.start_ns, scan.end_ns)
        for k, scan in enumerate(scans)
    ]
    assert path_drift(path, far, CONFIG, still) is None
    assert path_drift(path.part(np.arange(COUNT) < 1), scans[:1], CONFIG, still) is None
