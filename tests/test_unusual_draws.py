"""Varieties of the campaign: sensors and mountings on which nothing has been chosen, and platforms that hardly move."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from tests.campaign_modules import campaign_modules

SEEDS = range(150)


@pytest.fixture(scope="module")
def campaign() -> Iterator[SimpleNamespace]:
    with campaign_modules(draws="lio_campaign.draws", unusual="lio_campaign.unusual") as modules:
        yield modules


def test_every_sensor_is_drawn_and_sees_something(campaign: SimpleNamespace) -> None:
    kinds = [campaign.draws.draw_kinds(seed, "odd") for seed in SEEDS]
    assert set(Counter(kind.sensor for kind in kinds)) == set(campaign.unusual.SENSORS)
    for sensor in campaign.unusual.SENSORS:
        wanted = {"sensor": sensor, "world": "hall", "fault": "none"}
        seed = next(seed for seed in range(5000) if campaign.draws.draw_kinds(seed, "odd").matches(wanted))
        made = campaign.draws.draw(seed, "odd")
        assert len(made.truth().scan(0)) > 1000
        assert made.scenario.imu.rate_hz in campaign.unusual.IMU_RATES_HZ


def test_nothing_else_of_the_usual_draws_changes(campaign: SimpleNamespace) -> None:
    usual, odd = campaign.draws.draw_kinds(7), campaign.draws.draw_kinds(7, "odd")
    assert usual.sensor in campaign.draws.SENSORS
    assert (usual.world, usual.motion) == (odd.world, odd.motion)


def test_lidars_hang_askew_lie_and_stand(campaign: SimpleNamespace) -> None:
    random = np.random.default_rng(0)
    mountings = np.array([campaign.unusual.any_mounting(False, random) for _ in range(400)])
    R = mountings[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (400, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    tilt = np.degrees(np.arccos(np.clip(R[:, 2, 2], -1.0, 1.0)))
    assert 0.15 < np.mean(tilt < 1e-3) < 0.35  # upright
    assert 0.4 < np.mean((tilt > 14.9) & (tilt < 60.1)) < 0.7
    assert 0.08 < np.mean(tilt > 90.0) < 0.2  # upside down


def test_platforms_that_hardly_move_go_their_few_metres(campaign: SimpleNamespace) -> None:
    motions = campaign.draws.VARIETIES["still"].motions
    for motion in motions:
        seed = next(seed for seed in range(5000) if campaign.draws.draw_kinds(seed, "still").motion == motion)
        made = campaign.draws.draw(seed, "still")
        every = np.arange(made.scenario.trajectory.start_ns, made.scenario.trajectory.end_ns, 20_000_000)
        went = made.scenario.trajectory.evaluate(every)
        extent, turned = np.ptp(went.p_world_imu, axis=0).max(), np.linalg.norm(went.omega_imu, axis=1).max()
        assert 0.0 < extent < (10.0 if motion == "stop_and_go" else 4.0)
        assert motion == "creep" or turned > np.radians(1.0)
        assert (made.scenario.imu.accel_vibration > 0.0) == (motion == "hover")
