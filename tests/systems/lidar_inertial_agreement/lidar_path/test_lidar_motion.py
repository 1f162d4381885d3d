"""Paths of a LiDAR beside an estimate, where registrations are spared, against the truth and against paths without one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks import scan_fit
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, FINE, data, handheld, true_poses, true_twists


def errors(path: LidarPath, simulation: Simulation) -> tuple[float, float]:
    """How far the end of a path is off, relative to its beginning [m, rad]."""
    R, p = true_poses(simulation, path.time_ns[[0, -1]])
    turned = path.R_path_lidar[0].T @ path.R_path_lidar[-1]
    moved = path.R_path_lidar[0].T @ (path.p_path_lidar[-1] - path.p_path_lidar[0])
    return float(np.linalg.norm(moved - R[0].T @ (p[1] - p[0]))), float(np.linalg.norm(so3.log(turned.T @ R[0].T @ R[1])))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 0.8, 1.0])  # of the motion, that the estimate knows
@pytest.mark.parametrize(("seed", "speed", "rate"), [(3, 1.0, 1.5), (4, 1.0, 1.5), (4, 0.6, 0.4)])
def test_a_path_beside_an_estimate_is_as_near_to_the_truth(
    monkeypatch: pytest.MonkeyPatch, seed: int, speed: float, rate: float, factor: float
) -> None:
    simulation = handheld(seed, 4.0, speed, rate, FINE)
    scans, _ = data(simulation)
    asked: list[int] = []

    def measurement(points: np.ndarray, *arguments: Any, **options: Any) -> PlaneMeasurement:
        asked.append(len(points))
        return PlaneMeasurement(points, *arguments, **options)

    monkeypatch.setattr(scan_fit, "PlaneMeasurement", measurement)
    expected = true_twists(simulation, scans, factor)
    beside = lidar_path(scans, CONFIG, expected=expected)
    whole = sum(points > 0.6 * max(asked) for points in asked)
    few = len(asked) - whole
    alone = lidar_path(scans, CONFIG)
    assert beside.failed == alone.failed == 0 and len(beside) == len(scans)
    metres, radians = errors(beside, simulation)
    metres_alone, radians_alone = errors(alone, simulation)
    assert metres < metres_alone + 0.02 and radians < radians_alone + 0.01 and radians_alone < 0.03
    assert np.median(beside.misfit) < 1.1 * np.median(alone.misfit)
    # Each of one start or two takes a third of the points once, and all of them twice at most; where it turns slowly, the second
    # mostly comes to where the first has been.
    assert few >= len(scans) - 1 and whole <= 2 * few
    if rate < 1.0 and factor == 0.8:
        assert few > 1.5 * len(scans) and whole < 1.5 * few


def test_where_a_third_of_the_points_is_too_few_all_of_them_count() -> None:
    simulation = handheld(4, 4.0, lidar=FINE)
    scans, _ = data(simulation)
    demanding = CONFIG.model_copy(update={"min_points": 400})
    still = [(np.zeros(3), np.zeros(3))] * 12
    path = lidar_path(scans[:12], demanding, expected=still)
    assert path.failed == 0 and len(path) == 12 and path.segment.max() == 0


def test_what_is_held_along_the_way_is_registered_with_all_points(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = handheld(4, 4.0, lidar=FINE)
    scans, _ = data(simulation)
    monkeypatch.setattr(scan_fit.ScanFitter, "_roughly", None)  # nothing asks for it
    assert lidar_path(scans[:6], CONFIG, expected=true_twists(simulation, scans[:6]), held=True).failed == 0


def at_14_m_s(world: str, lidar: SpinningLidar, seed: int) -> Simulation:
    """0.7 s of a LiDAR that goes straight on at a steady speed."""
    places = {"warehouse": sites.warehouse, "city": worlds.city, "hall": worlds.hall}
    motion = manoeuvres.constant_velocity(1.3, (-5.6, 0.3, 1.6), (14.0, 0.0, 0.0), so3.exp(np.array([0.0, 0.0, 0.2])))
    return Simulation(Scenario(world, places[world](seed=seed), motion, lidar, ImuModel(), np.eye(4)), seed, 0.7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "channels", "seed"),
    [("warehouse", 16, 22), ("warehouse", 32, 24), ("city", 64, 22), ("hall", 16, 24), ("hall", 32, 22), ("hall", 64, 24)],
)
def test_a_path_begins_at_the_speed_of_its_first_scans(world: str, channels: int, seed: int) -> None:
    simulation = at_14_m_s(world, SpinningLidar(channels=channels, azimuth_steps=512), seed)
    path = lidar_path(data(simulation)[0], CONFIG)
    assert path.failed == 0 and len(path) == 6
    metres, radians = errors(path, simulation)  # of 7 m
    assert metres < 0.05 and radians < 0.005


@pytest.mark.slow
def test_tracks_that_lose_hold_together_leave_the_best_one() -> None:
    """An empty scan ends them all before later scans have settled between them: the path goes on from what had fitted best."""
    scans = data(at_14_m_s("hall", SpinningLidar(channels=32, azimuth_steps=900), 23))[0]
    nothing = replace(scans[4], p_lidar=scans[4].p_lidar[:0], time_ns=scans[4].time_ns[:0])
    alone, broken = lidar_path(scans[:4], CONFIG), lidar_path([*scans[:4], nothing, scans[5]], CONFIG)
    assert broken.failed == 1 and len(broken) == 5 and len(alone) == 4
    assert np.array_equal(broken.p_path_lidar[:4], alone.p_path_lidar) and np.array_equal(broken.cost[:4], alone.cost)
