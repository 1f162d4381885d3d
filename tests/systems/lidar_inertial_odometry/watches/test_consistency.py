"""What the scans say against the estimate, scan by scan, and how long it takes to be said."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.filtering.nav_state import BA, BW, T_P, TANGENT, NavState, P, V
from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import T_imu_lidar_of, T_world_imu_of, first_sensitivity
from boxplus.systems.lidar_inertial_odometry.watches.consistency import (
    _MEASUREMENT_SIGMA,
    Consistency,
    _largest_innovation,
    _lidar_twist,
)

PERIOD_NS = 100_000_000
ABOUT_Z, ALONG_X = np.eye(6)[2], np.eye(6)[T_P]


def follow(shares: list[float]) -> tuple[Consistency, list[str]]:
    """The shares of the points that lie on their planes, a scan each at 10 Hz."""
    consistency, told = Consistency(LioConfig()), []
    for number, share in enumerate(shares):
        frame: Any = SimpleNamespace(scan=SimpleNamespace(start_ns=number * PERIOD_NS, end_ns=(number + 1) * PERIOD_NS))
        told += consistency._fit(frame, share)
    return consistency, told


@pytest.mark.parametrize("shares", [[0.95] * 50, [0.2] * 9, ([0.3] * 9 + [0.9]) * 5])
def test_what_fits_or_misses_for_a_moment_is_no_contradiction(shares: list[float]) -> None:
    consistency, told = follow(shares)
    assert not told and consistency.contradiction is None


def test_a_second_of_misses_is_a_contradiction_and_stays_one() -> None:
    consistency, told = follow([0.98] * 20 + [0.4] * 30 + [0.98] * 10)
    assert len(told) == 1 and told[0].startswith("for 1.0 s only 40% of the points near surfaces of the map lie on them")
    assert consistency.contradiction == told[0]


@pytest.mark.parametrize(
    ("gyro", "accel", "sigma", "told"),
    [(0.085, 0.6, 0.0, 0), (0.12, 0.0, 0.0, 1), (0.0, 0.8, 0.0, 1), (0.12, 0.8, 0.3, 0)],
)
def test_biases_that_no_sensor_in_order_has_are_named_once(gyro: float, accel: float, sigma: float, told: int) -> None:
    """The gyroscope of EuRoC's flights has 0.085 rad/s and is in order; what is not known yet is not held against it."""
    x = NavState.identity().pack()
    x[BW], x[BA + 1] = gyro, accel
    consistency = Consistency(LioConfig())
    found = consistency._biases(x, sigma**2 * np.eye(TANGENT)) + consistency._biases(x, sigma**2 * np.eye(TANGENT))
    assert len(found) == told
    assert all("T_imu_lidar is wrong" in text for text in found)


@pytest.mark.parametrize(("first", "then", "contradicted"), [(0.0, 0.8, True), (0.8, 0.85, False), (0.0, 0.6, False)])
def test_a_bias_that_changes_by_more_than_any_sensor_does_is_a_contradiction(
    first: float, then: float, contradicted: bool
) -> None:
    """One that was large from the start is that of a bad sensor, and a warning."""
    consistency, x, told = Consistency(LioConfig()), NavState.identity().pack(), []
    for accel in (first, then, then):
        x[BA + 1] = accel
        told += consistency._biases(x, np.zeros((TANGENT, TANGENT)))
    assert (consistency.contradiction is not None) == contradicted
    assert len(told) == (max(first, then) > 0.7)


def innovate(
    corrections: list[np.ndarray],
    samples: int = 10,
    weak: tuple[int, ...] = (),
    v: tuple[float, float, float] = (0.0, 0.0, 0.0),
    mounting: np.ndarray | None = None,
    B: np.ndarray | None = None,
) -> tuple[Consistency, list[list[str]]]:
    """Corrections of the pose (6,), a scan each at 10 Hz, of a prediction that is good for 0.1 mm.

    With each that of the `mounting` (6,), with which the pose moves by `B` (18, 6).
    """
    consistency, found = Consistency(LioConfig()), []
    directions = SimpleNamespace(weak=np.isin(np.arange(6), weak), vectors=np.eye(6), lever_arm=10.0)
    for number, pose in enumerate(corrections):
        correction = np.concatenate([pose, np.zeros(TANGENT - 12), np.zeros(6) if mounting is None else mounting])
        x = NavState.identity().pack()
        x[P : P + 3], x[V : V + 3] = pose[T_P : T_P + 3], v
        posterior: Any = SimpleNamespace(x=x, valid=True, last=SimpleNamespace(directions=directions))
        frame: Any = SimpleNamespace(scan=SimpleNamespace(end_ns=number * PERIOD_NS), imu=range(samples))
        update: Any = SimpleNamespace(
            posterior=posterior, cov_prior=1e-8 * np.eye(TANGENT), B_prior=np.zeros((18, 6)) if B is None else B
        )
        found.append(consistency._innovate(frame, correction, update))
    return consistency, found


@pytest.mark.parametrize(("off_m", "samples", "told"), [(0.02, 10, 1), (0.005, 10, 0), (0.02, 1, 0)])
def test_corrections_beyond_noise_are_named_once_after_two_seconds(off_m: float, samples: int, told: int) -> None:
    """2 cm a scan, where the prediction and a registration are good for 1 cm; with one IMU sample a scan nobody knows."""
    consistency, found = innovate([off_m * ALONG_X] * 40, samples)
    assert sum(map(len, found)) == told and consistency.contradiction is None
    assert not any(found[:20])


@pytest.mark.parametrize("off", [0.08 * ALONG_X, 0.008 * ABOUT_Z], ids=["8 cm", "half a degree"])
def test_what_the_lidar_corrects_scan_after_scan_is_a_contradiction_within_a_second_and_a_half(off: np.ndarray) -> None:
    """By eight standard deviations of a registration, whether it is a way or a turn."""
    consistency, found = innovate([np.zeros(6)] * 5 + [off] * 30 + [np.zeros(6)] * 5)
    scans = [number for number, texts in enumerate(found, -5) if any("contradicted what the IMU predicts" in t for t in texts)]
    assert len(scans) == 1 and 1.0 <= scans[0] * PERIOD_NS * 1e-9 <= 1.5
    assert str(consistency.contradiction).startswith("for 1.0 s the LiDAR has contradicted what the IMU predicts, scan after")


@pytest.mark.parametrize("off", [0.08 * ALONG_X, 0.008 * ABOUT_Z])
def test_a_few_scans_apart_or_along_what_they_do_not_show_are_no_contradiction(off: np.ndarray) -> None:
    """A bump that the IMU missed is over at once; along a direction that the scan does not show nothing is measured."""
    assert innovate(([off] * 3 + [np.zeros(6)] * 17) * 3)[0].contradiction is None
    assert innovate([off] * 40, weak=(2, 3))[0].contradiction is None
    assert innovate([off] * 40, weak=(0, 4))[0].contradiction is not None


@pytest.mark.parametrize("seed", range(4))
def test_what_the_imu_moves_with_its_mounting_is_no_contradiction(seed: int) -> None:
    """The LiDAR stays where it is, and the IMU goes elsewhere on it; a pose that moves by more than that is contradicted."""
    random = np.random.default_rng(seed)
    x = NavState.identity()
    x = replace(x, R_imu_lidar=so3.exp(random.normal(size=3)), p_imu_lidar=random.normal(size=3))
    B = first_sensitivity(x.pack())
    mounting = np.concatenate([0.01 * random.normal(size=3), 0.1 * random.normal(size=3)])
    moved = (B @ mounting)[:6]
    assert innovate([moved] * 40, mounting=mounting, B=B)[0].contradiction is None
    assert innovate([moved] * 40)[0].contradiction is not None
    assert innovate([moved + 0.1 * ALONG_X] * 40, mounting=mounting, B=B)[0].contradiction is not None


def test_a_speed_that_no_platform_has_is_a_contradiction_at_once() -> None:
    for speed, contradicted in ((110.0, False), (130.0, True)):
        consistency, found = innovate([np.zeros(6)] * 5, v=(0.0, 0.8 * speed, -0.6 * speed))
        assert (consistency.contradiction is not None) == contradicted
        assert [len(texts) for texts in found] == [int(contradicted), 0, 0, 0, 0]
        assert not contradicted or found[0][0].startswith("the estimate moves at 130 m/s")


@pytest.mark.parametrize(("by_gyroscope", "by_lidar", "suspicious"), [(0.0, 2.0, True), (2.0, 0.0, True), (2.0, 2.0, False)])
def test_whichever_sensor_turns_alone_raises_a_suspicion(by_gyroscope: float, by_lidar: float, suspicious: bool) -> None:
    """In degrees a scan: a gyroscope that claims not to turn is as wrong as one that turns alone.

    Nothing else speaks against it: the prediction is taken to be good for next to nothing.
    """
    consistency, seen = Consistency(LioConfig()), []

    def add(*_: object, suspicious: bool, **__: object) -> None:
        seen.append(suspicious)

    consistency._watch = SimpleNamespace(add=add, contradiction=None, mounting_borne_out=True)  # type: ignore[assignment]
    time_ns = np.linspace(0, PERIOD_NS, 20).astype(np.int64)
    directions = SimpleNamespace(weak=np.zeros(6, bool), vectors=np.eye(6), lever_arm=1.0)
    cov = np.eye(TANGENT)
    B = np.zeros((TANGENT, 6))
    for number in range(30):
        x_before, x_prior, x = (
            replace(NavState.identity(), R_world_imu=so3.exp(np.radians([0.0, 0.0, turned]))).pack()
            for turned in (0.0, by_gyroscope, by_lidar)
        )
        begin_ns = number * PERIOD_NS
        imu = ImuSamples(begin_ns + time_ns, np.zeros((20, 3)), np.tile([0.0, 0.0, 9.81], (20, 1)))
        scan = SimpleNamespace(start_ns=begin_ns, end_ns=begin_ns + PERIOD_NS)
        frame: Any = SimpleNamespace(scan=scan, begin_ns=begin_ns, imu=imu, duration_s=0.1, largest_gap_s=0.005)
        posterior = SimpleNamespace(x=x, cov=cov, valid=True, last=SimpleNamespace(directions=directions))
        update: Any = SimpleNamespace(posterior=posterior, cov_prior=cov, cov=cov, B=B, B_prior=B)
        consistency.update(frame, x_before, x_prior, update, 1.0, 1.0)
    assert seen[-1] == suspicious


@pytest.mark.parametrize("seed", range(20))
def test_the_innovation_is_that_of_the_direction_that_is_off_most(seed: int) -> None:
    random = np.random.default_rng(seed)
    vectors, weak, off = random.normal(size=(6, 6)), random.random(6) < 0.3, random.normal(size=6)
    root = random.normal(size=(24, 24))
    cov = root @ root.T
    strong = vectors[:, ~weak].T * np.repeat([7.0, 1.0], 3)
    variance = np.einsum("ij,jk,ik->i", strong, cov[:6, :6], strong) + strong**2 @ _MEASUREMENT_SIGMA**2
    expected = np.max((strong @ off) ** 2 / variance, initial=0.0)
    assert _largest_innovation(vectors, weak, 7.0, off, cov) == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(10))
def test_the_lidar_moves_as_the_imu_carries_it(seed: int) -> None:
    random = np.random.default_rng(seed)
    before, now = (
        NavState(
            *(so3.exp(random.normal(size=3)), random.normal(size=3), *np.zeros((4, 3))),
            so3.exp(random.normal(size=3)),
            random.normal(size=3),
        ).pack()
        for _ in range(2)
    )
    T_before, T_now = (T_world_imu_of(x) @ T_imu_lidar_of(x) for x in (before, now))
    turn, velocity = _lidar_twist(before, now, 0.1)
    assert np.allclose(so3.exp(0.1 * turn), T_before[:3, :3].T @ T_now[:3, :3], atol=1e-9)
    assert np.allclose(T_now[:3, :3] @ velocity * 0.1, T_now[:3, 3] - T_before[:3, 3], atol=1e-12)
