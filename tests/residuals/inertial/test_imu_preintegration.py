"""Preintegration: the kernel against its recursion in dense matrices, derivatives, real flights, and what is refused."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from tests.residuals.inertial.imu_streams import dense_preintegration, random_stream

NOISE = ImuNoise(gyro=0.02, accel=0.1, gyro_walk=0.003, accel_walk=0.05)
BIAS_ACCEL, BIAS_GYRO = np.array([0.1, -0.2, 0.05]), np.array([-0.02, 0.03, 0.01])
seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=25)
@given(seeds, st.integers(2, 30), st.booleans())
def test_kernel_is_the_dense_recursion(seed: int, count: int, merged: bool) -> None:
    stream = random_stream(seed, count)
    mode = "merged" if merged else "independent"
    found = Preintegration.integrate(*stream, noise=NOISE, bias_accel=BIAS_ACCEL, bias_gyro=BIAS_GYRO, mode=mode)
    alpha, R, beta, P, J = dense_preintegration(stream, BIAS_ACCEL, BIAS_GYRO, NOISE, merged)
    np.testing.assert_allclose(found.alpha[0], alpha, atol=1e-13)
    np.testing.assert_allclose(quaternion.to_matrix(found.gamma_wxyz[0]), R, atol=1e-13)
    np.testing.assert_allclose(found.beta[0], beta, atol=1e-13)
    np.testing.assert_allclose(found.covariance[0], P, atol=1e-13 * np.abs(P).max())
    np.testing.assert_allclose(found.bias_jacobian[0], J[:9, 9:], atol=1e-12)
    assert np.array_equal(found.covariance[0], found.covariance[0].T)


@given(seeds)
@settings(max_examples=10)
def test_bias_jacobian_against_differences(seed: int) -> None:
    stream = random_stream(seed, 20)

    def at(change: np.ndarray) -> Preintegration:
        return Preintegration.integrate(
            *stream, noise=NOISE, bias_accel=BIAS_ACCEL + change[:3], bias_gyro=BIAS_GYRO + change[3:]
        )

    base = at(np.zeros(6))
    R = quaternion.to_matrix(base.gamma_wxyz[0])
    h = 1e-3
    for k in range(6):
        values = []
        for step in (h, -h, 2 * h, -2 * h):
            moved = at(step * np.eye(6)[k])
            turned = so3.boxminus(quaternion.to_matrix(moved.gamma_wxyz[0]), R)
            values.append(np.concatenate([moved.alpha[0], turned, moved.beta[0]]))
        numeric = (8 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * h)
        np.testing.assert_allclose(base.bias_jacobian[0, :, k], numeric, atol=1e-9)


def test_bias_correction_errs_at_second_order() -> None:
    stream = random_stream(1, 25)
    base = Preintegration.integrate(*stream, noise=NOISE)
    errors = []
    for size in (1e-2, 1e-3):
        ba, bg = size * np.array([1.0, -2.0, 0.5]), size * np.array([0.5, 1.0, -1.0])
        exact = Preintegration.integrate(*stream, noise=NOISE, bias_accel=ba, bias_gyro=bg)
        alpha, gamma, beta = base.corrected(ba, bg)
        angle = so3.boxminus(quaternion.to_matrix(gamma[0]), quaternion.to_matrix(exact.gamma_wxyz[0]))
        errors.append([np.abs(alpha - exact.alpha).max(), np.abs(angle).max(), np.abs(beta - exact.beta).max()])
    assert (np.array(errors[1]) < 0.02 * np.array(errors[0])).all() and max(errors[0]) < 1e-3


def test_constant_motion_has_a_closed_form() -> None:
    time_ns = np.arange(201, dtype=np.int64) * 5_000_000
    w, a = np.array([0.0, 0.0, 0.7]), np.array([0.0, 0.0, 9.81])
    found = Preintegration.integrate(time_ns, np.tile(w, (201, 1)), np.tile(a, (201, 1)), noise=NOISE)
    np.testing.assert_allclose(found.gamma_wxyz[0], [np.cos(0.35), 0, 0, np.sin(0.35)], atol=1e-14)
    np.testing.assert_allclose(found.beta[0], a, atol=1e-12)
    np.testing.assert_allclose(found.alpha[0], 0.5 * a, atol=1e-12)
    assert found.duration_s[0] == 1.0 and found.steps[0] == 200
    # White noise of the gyroscope becomes a random walk of the angle: σ √T about the axis of rotation.
    np.testing.assert_allclose(np.sqrt(found.covariance[0, 5, 5]), np.hypot(0.02, 0.003 / np.sqrt(3)), rtol=1e-3)


def test_ends_between_samples_are_interpolated() -> None:
    time_ns, gyro, accel = random_stream(4, 12)
    begin, end = int(time_ns[2] + 1_000_001), int(time_ns[9] - 700_003)

    def between(values: np.ndarray, t: int, k: int) -> np.ndarray:
        return values[k] + (values[k + 1] - values[k]) * ((t - time_ns[k]) / (time_ns[k + 1] - time_ns[k]))

    cut = (
        np.array([begin, *time_ns[3:9], end]),
        np.vstack([between(gyro, begin, 2), gyro[3:9], between(gyro, end, 8)]),
        np.vstack([between(accel, begin, 2), accel[3:9], between(accel, end, 8)]),
    )
    found = Preintegration.integrate(time_ns, gyro, accel, noise=NOISE, intervals_ns=(begin, end))
    expected = Preintegration.integrate(*cut, noise=NOISE)
    for name in ("alpha", "beta", "gamma_wxyz", "covariance", "bias_jacobian"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-14)
    within = Preintegration.integrate(time_ns, gyro, accel, noise=NOISE, intervals_ns=(time_ns[3] + 10, time_ns[4] - 10))
    assert within.steps[0] == 1


def test_intervals_of_a_batch_are_those_alone() -> None:
    stream = random_stream(5, 40)
    time_ns = stream[0]
    intervals = np.array([[time_ns[0], time_ns[10]], [time_ns[5] + 7, time_ns[39]], [time_ns[10], time_ns[11]]])
    biases = np.random.default_rng(0).normal(size=(2, 3, 3)) * 0.1
    batch = Preintegration.integrate(
        *stream, noise=NOISE, intervals_ns=intervals, bias_accel=biases[0], bias_gyro=biases[1], mode="independent"
    )
    for n, interval in enumerate(intervals):
        alone = Preintegration.integrate(
            *stream, noise=NOISE, intervals_ns=interval, bias_accel=biases[0, n], bias_gyro=biases[1, n], mode="independent"
        )
        for name in ("alpha", "beta", "gamma_wxyz", "covariance", "bias_jacobian", "steps"):
            assert np.array_equal(getattr(batch, name)[n], getattr(alone, name)[0])


def test_only_stale_intervals_are_integrated_anew() -> None:
    stream = random_stream(6, 40)
    times = stream[0][[0, 10, 20, 30]]
    intervals = np.stack([times[:-1], times[1:]], axis=1)
    base = Preintegration.integrate(*stream, noise=NOISE, intervals_ns=intervals)
    ba = np.array([[0.09, 0, 0], [0.11, 0, 0], [0, 0, 0]])
    bg = np.array([[0.009, 0, 0], [0, 0, 0], [0, 0.011, 0]])
    assert base.is_stale(ba, bg).tolist() == [False, True, True]
    before = base.alpha.copy()
    anew = base.reintegrated(ba, bg)
    assert np.array_equal(base.alpha, before)
    expected = Preintegration.integrate(*stream, noise=NOISE, intervals_ns=intervals, bias_accel=ba, bias_gyro=bg)
    assert np.array_equal(anew.alpha[1:], expected.alpha[1:]) and np.array_equal(anew.covariance[1:], expected.covariance[1:])
    assert np.array_equal(anew.alpha[0], base.alpha[0]) and not anew.is_stale(ba, bg).any()
    assert np.array_equal(base.reintegrated(ba, bg, where=np.ones(3, dtype=bool)).beta, expected.beta)


WANDERING = ImuNoise(gyro=1e-4, accel=1e-3, gyro_walk=1e-6, accel_walk=1e-5, gap_gyro=0.3, gap_accel=4.0)


def wandering_stream(seed: int, gap: slice, count: int = 200) -> tuple[np.ndarray, ...]:
    """A second of samples that wander as `WANDERING` says, and those of them that are left with a gap."""
    random = np.random.default_rng(seed)
    time_ns = 10**18 + np.arange(count + 1) * (10**9 // count)
    step = np.sqrt(1.0 / count)
    gyro = np.cumsum(random.normal(size=(count + 1, 3)) * WANDERING.gap_gyro * step, axis=0)
    accel = np.cumsum(random.normal(size=(count + 1, 3)) * WANDERING.gap_accel * step, axis=0)
    accel[:, 2] += 9.81
    left = np.ones(count + 1, dtype=bool)
    left[gap] = False
    return time_ns, gyro, accel, left


@pytest.mark.parametrize(("gap", "cuts"), [(slice(20, 181), ()), (slice(20, 181), (60, 100, 140)), (slice(80, 121), ())])
def test_what_happens_within_a_gap_is_as_uncertain_as_stated(gap: slice, cuts: tuple[int, ...]) -> None:
    """Chained over intervals that end within the gap, too; a bridge is a little more certain of position than white noise."""
    errors, covariances = [], []
    for seed in range(300):
        time_ns, gyro, accel, left = wandering_stream(seed, gap)
        true = Preintegration.integrate(time_ns, gyro, accel, noise=WANDERING)
        ends = time_ns[[0, *cuts, len(time_ns) - 1]]
        holed = Preintegration.integrate(
            time_ns[left], gyro[left], accel[left], noise=WANDERING, intervals_ns=np.stack([ends[:-1], ends[1:]], axis=1)
        )
        whole = holed.merge(0, len(cuts)) if cuts else holed
        turn = so3.log(quaternion.to_matrix(whole.gamma_wxyz[0]).T @ quaternion.to_matrix(true.gamma_wxyz[0]))
        errors.append(np.concatenate([true.alpha[0] - whole.alpha[0], turn, true.beta[0] - whole.beta[0]]))
        covariances.append(whole.covariance[0, :9, :9])
    squares = np.array([error @ np.linalg.solve(P, error) for error, P in zip(errors, covariances, strict=True)])
    assert 5.5 < squares.mean() < 9.6  # 9 degrees of freedom; what position and velocity do beside each other is overstated
    shares = np.mean(np.square(errors), axis=0) / np.mean([np.diag(P) for P in covariances], axis=0)
    assert (shares[3:].reshape(2, 3).mean(axis=1) > 0.85).all() and (shares < 1.2).all()


def test_gaps_keep_their_uncertainty_when_integrated_anew() -> None:
    time_ns, gyro, accel, left = wandering_stream(0, slice(20, 181))
    ends = time_ns[[0, 100, 200]]
    holed = Preintegration.integrate(
        time_ns[left], gyro[left], accel[left], noise=WANDERING, intervals_ns=np.stack([ends[:-1], ends[1:]], axis=1)
    )
    whole = Preintegration.integrate(time_ns[left], gyro[left], accel[left], noise=WANDERING)
    np.testing.assert_allclose(holed.merge(0).covariance, whole.covariance, rtol=1e-6, atol=1e-12)
    anew = holed.reintegrated(np.full(3, 1e-9), np.zeros(3), where=np.ones(2, dtype=bool))
    np.testing.assert_allclose(anew.covariance, holed.covariance, rtol=1e-6, atol=1e-12)
    assert holed.longest_gap_s.tolist() == [0.81, 0.81] and (np.linalg.eigvalsh(holed.covariance)[:, 0] > 0.0).all()


def test_gaps_are_counted_and_told(caplog: pytest.LogCaptureFixture) -> None:
    time_ns, gyro, accel = random_stream(7, 20, longest_ns=9_000_000)
    time_ns[12:] += 150_000_000
    intervals = np.array([[time_ns[0], time_ns[8]], [time_ns[8], time_ns[19]]])
    with caplog.at_level(logging.WARNING):
        found = Preintegration.integrate(time_ns, gyro, accel, noise=NOISE, intervals_ns=intervals)
    assert found.gaps.tolist() == [1] and found.longest_gap_s[1] > 0.15
    assert "1 of 2 intervals contain a gap" in caplog.text
    caplog.clear()
    Preintegration.integrate(time_ns, gyro, accel, noise=WANDERING, intervals_ns=intervals)
    Preintegration.integrate(time_ns, gyro, accel, noise=NOISE, intervals_ns=intervals[0])
    assert not caplog.records


def _refused(message: str, **changes: object) -> None:
    time_ns, gyro, accel = random_stream(8, 6)
    arguments: dict[str, object] = {"time_ns": time_ns, "gyro": gyro, "accel": accel, "noise": NOISE} | changes
    with pytest.raises(InputError, match=message):
        Preintegration.integrate(**arguments)  # type: ignore[arg-type]


def test_refusals() -> None:
    time_ns, gyro, accel = random_stream(8, 6)
    bad = gyro.copy()
    bad[3, 1] = np.nan
    _refused("expected at least two IMU samples – got 1", time_ns=time_ns[:1], gyro=gyro[:1], accel=accel[:1])
    _refused("time_ns as integer nanoseconds", time_ns=time_ns * 1e-9)
    _refused("strictly increasing – got .* at sample 3", time_ns=time_ns[[0, 1, 2, 2, 4, 5]])
    _refused("gyro finite – got .* at sample 3", gyro=bad)
    _refused(r"accel of shape \(6, 3\)", accel=accel[:5])
    _refused("end after they begin – got .* in interval 0", intervals_ns=(time_ns[3], time_ns[3]))
    _refused("within the samples.* in interval 1", intervals_ns=[(time_ns[0], time_ns[1]), (time_ns[0], time_ns[5] + 1)])
    _refused("within the samples", intervals_ns=(time_ns[0] - 1, time_ns[5]))
    _refused("intervals_ns as integer", intervals_ns=(0.0, 1.0))
    _refused(r"bias_gyro finite, of shape \(3,\) or \(1, 3\)", bias_gyro=np.zeros((2, 3)))
    _refused("bias_accel finite", bias_accel=(np.inf, 0, 0))
    _refused('mode "merged" or "independent"', mode="both")
    for value in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="noise density accel_walk positive and finite"):
            ImuNoise(gyro=0.1, accel=0.1, gyro_walk=0.1, accel_walk=value)


@pytest.mark.parametrize(
    ("sequence", "degrees", "centimetres", "centimetres_per_second"),
    [("V1_03_difficult", 0.12, 3.0, 5.4), ("MH_05_difficult", 0.02, 2.9, 4.2)],
)
def test_one_second_of_flight(
    shared_data: Path, sequence: str, degrees: float, centimetres: float, centimetres_per_second: float
) -> None:
    """From the ground truth with its biases, the errors after 1 s are those that are known of these recordings."""
    tables = []
    for name in ("imu", "gt"):
        file = shared_data / "imu" / f"{sequence}.{name}.csv"
        tables += [np.loadtxt(file, delimiter=",", usecols=0, dtype=np.int64), np.loadtxt(file, delimiter=",")[:, 1:]]
    time_ns, samples, truth_ns, truth = tables
    start = np.arange(0, len(truth) - 200, 20)
    intervals = np.stack([truth_ns[start], truth_ns[start + 200]], axis=1)
    start = start[(intervals[:, 0] >= time_ns[0]) & (intervals[:, 1] <= time_ns[-1])]
    begin, end = truth[start], truth[start + 200]
    found = Preintegration.integrate(
        time_ns,
        samples[:, :3],
        samples[:, 3:],
        noise=ImuNoise(gyro=1.7e-4, accel=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3),
        intervals_ns=np.stack([truth_ns[start], truth_ns[start + 200]], axis=1),
        bias_gyro=begin[:, 10:13],
        bias_accel=begin[:, 13:16],
    )
    pose, state = found.predict(begin[:, [3, 4, 5, 6, 0, 1, 2]], begin[:, [7, 8, 9, 13, 14, 15, 10, 11, 12]])
    R = quaternion.to_matrix(end[:, 3:7] / np.linalg.norm(end[:, 3:7], axis=1, keepdims=True))
    angle = np.linalg.norm(so3.boxminus(quaternion.to_matrix(pose[:, :4]), R), axis=1)
    assert len(start) > 1000 and found.gaps.size == 0
    assert round(np.degrees(np.median(angle)), 2) <= degrees
    assert 100 * np.median(np.linalg.norm(pose[:, 4:] - end[:, :3], axis=1)) < centimetres + 0.05
    assert 100 * np.median(np.linalg.norm(state[:, :3] - end[:, 7:10], axis=1)) < centimetres_per_second + 0.05
