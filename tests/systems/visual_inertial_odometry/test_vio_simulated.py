"""Visual-inertial odometry on simulated corners: truth, consistency, failures, and what it costs in the long run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from boxplus import CameraImage, InputError
from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig, VioEstimate, VisualInertialOdometry
from boxplus.systems.visual_inertial_odometry.odometry import BEFORE_A_GAP
from tests.systems.visual_inertial_odometry.simulated_rays import (
    PIXEL_SIGMA,
    Flight,
    SimulatedTracker,
    at,
    rig,
    run,
    truth_relative_to_first,
)

CONFIG = VioConfig(pixel_sigma=PIXEL_SIGMA)


def position_and_yaw_error(flight: Flight, first: VioEstimate, estimate: VioEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Error [yaw, p] (4,) and its covariance (4, 4)."""
    R, p = truth_relative_to_first(flight, first, at(flight, estimate))
    turned = R @ so3.log(R.T @ estimate.T_world_imu[:3, :3])
    by = np.zeros((4, 15))
    by[0, :3], by[1:, 3:6] = R[2], np.eye(3)
    error = np.array([turned[2], *(estimate.T_world_imu[:3, 3] - p)])
    return error, by @ estimate.covariance @ by.T


@pytest.fixture(scope="module")
def flown() -> tuple[Flight, VisualInertialOdometry, list[VioEstimate]]:
    flight = Flight(3, 7.0)
    return flight, *run(flight, rig(), CONFIG)


def test_every_frame_gets_one_estimate_and_the_truth_is_found(flown) -> None:
    flight, vio, estimates = flown
    assert [e.time_ns for e in estimates] == flight.time_ns[: len(estimates) * 10 : 10].tolist()
    known = [e for e in estimates if e.status != "starting"]
    assert {e.status for e in known} == {"ok"} and vio.contradiction is None and vio.start is not None
    last = known[-1]
    error, covariance = position_and_yaw_error(flight, known[0], last)
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all()
    assert np.sqrt(np.diag(covariance)[1:]).max() < 0.05
    k = at(flight, last)
    state = [*last.velocity_world, *last.gyro_bias, *last.accel_bias]
    R, _ = truth_relative_to_first(flight, known[0], k)
    truth = [*(R @ flight.R[k].T @ flight.v[k]), *flight.bias_gyro[k], *flight.bias_accel[k]]
    assert (np.abs(np.subtract(state, truth)) < 4.5 * np.sqrt(np.diag(last.covariance)[6:])).all()


def test_landmarks_are_where_the_points_are(flown) -> None:
    flight, _, estimates = flown
    last, first = estimates[-1], next(e for e in estimates if e.status != "starting")
    R, p = truth_relative_to_first(flight, first, at(flight, last))
    k = at(flight, last)
    points = SimulatedTracker(flight, rig()).points
    truth = (points - flight.p[k]) @ flight.R[k] @ R.T + p
    off = np.linalg.norm(last.landmarks[:, None] - truth[None], axis=2).min(axis=1)
    near = last.landmark_sigmas < 0.2
    assert near.sum() > 30 and np.median(off[near]) < 0.1
    assert len(last.landmark_ids) == len(last.landmarks) == len(set(last.landmark_ids.tolist()))


@pytest.mark.slow
def test_errors_of_position_and_yaw_have_the_covariance_stated() -> None:
    total, count = 0.0, 0
    for seed in range(6):
        flight = Flight(50 + seed, 6.0)
        _, estimates = run(flight, rig(), CONFIG)
        known = [e for e in estimates if e.status != "starting"]
        error, covariance = position_and_yaw_error(flight, known[0], known[-1])
        total, count = total + float(error @ np.linalg.solve(covariance, error)), count + 4
    low, high = chi2.ppf([0.025, 0.975], count)
    assert low < total < high


def test_yaw_and_position_are_never_known_better_than_at_first(flown) -> None:
    _, vio, estimates = flown
    known = [e for e in estimates if e.status != "starting"]
    variance = np.array([(e.T_world_imu[2, :3] @ e.covariance[:3, :3] @ e.T_world_imu[2, :3]) for e in known])
    assert (variance[1:] > variance[0] * (1.0 - 1e-6)).all()
    position = np.array([np.linalg.eigvalsh(e.covariance[3:6, 3:6])[0] for e in known])
    assert (position[1:] > position[0] * (1.0 - 1e-6)).all()
    assert vio.window.leak is not None and vio.window.leak.is_anchored  # by the first pose, which is known by definition


def test_one_camera_has_a_longer_window_unless_told_otherwise() -> None:
    assert CONFIG.keyframes_of(1) > CONFIG.keyframes_of(2)
    assert VioConfig(keyframes=5).keyframes_of(1) == VioConfig(keyframes=5).keyframes_of(2) == 5


def test_the_same_run_has_the_same_bits_and_the_window_stays_small(flown) -> None:
    flight, vio, estimates = flown
    _, again = run(flight, rig(), CONFIG)
    assert all(np.array_equal(a.T_world_imu, b.T_world_imu, equal_nan=True) for a, b in zip(estimates, again, strict=True))
    window = vio.window
    assert len(window.frames) <= CONFIG.keyframes_of(2) + CONFIG.recent_frames + 1
    assert len(window.bodies) == len(window.states) == len(window.frames)
    assert len(vio._imu) < 200 * 10 and len(window._free_from) <= 400


def test_stamps_that_differ_a_little_from_camera_to_camera_change_nothing() -> None:
    flight = Flight(3, 3.0)
    (_, together), (_, apart) = (run(flight, rig(), CONFIG, late_ns=late_ns) for late_ns in (0, 300_000))
    assert [e.time_ns for e in together] == [e.time_ns for e in apart] and together[-1].status == "ok"
    assert all(np.array_equal(a.T_world_imu, b.T_world_imu, equal_nan=True) for a, b in zip(together, apart, strict=True))


def test_one_camera_is_enough_once_the_scale_was_found(flown) -> None:
    flight, _, _ = flown
    _, estimates = run(flight, rig(1), CONFIG)
    known = [e for e in estimates if e.status != "starting"]
    error, covariance = position_and_yaw_error(flight, known[0], known[-1])
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all() and np.linalg.norm(error[1:]) < 0.2


def test_one_camera_that_knows_no_depth_yet_replaces_corners_that_are_lost() -> None:
    """While it rests it has no landmark whose loss could ask for a keyframe; before that, a change of light left it blind."""
    vio, estimates = run(Flight(3, 1.5), rig(1), CONFIG)
    newest = vio.window.frames[-1]
    assert estimates[-1].status != "starting" and not len(vio.window.points)
    pose, count = vio.window.bodies.values[-1], len(newest.tracks)
    few = replace(
        newest.tracks, **{name: getattr(newest.tracks, name)[: count // 2] for name in ("ids", "pixels", "rays", "is_new")}
    )
    assert vio.window.wants_keyframe(few, pose) and not vio.window.wants_keyframe(newest.tracks, pose)


def test_a_dark_while_is_weak_then_lost_and_the_map_frame_is_kept() -> None:
    flight = Flight(7, 7.5)
    vio, estimates = run(flight, rig(), CONFIG, SimulatedTracker(flight, rig(), dark=(3.5, 5.3)))
    known = [e for e in estimates if e.status != "starting"]
    time = np.array([at(flight, e) / 200 for e in known])
    status = np.array([e.status for e in known])
    assert (status[time < 3.45] == "ok").all()
    assert (status[(time > 3.55) & (time < 4.4)] == "weak").all()
    assert (status[(time > 4.6) & (time < 5.25)] == "lost").all()
    assert (status[time > 5.6] == "ok").all()
    dark = [e for e in known if e.status == "lost"]
    assert "dark or covered" in dark[0].reasons[0] and "no landmark was seen for 1." in dark[0].reasons[1]
    sigma = np.array([np.sqrt(np.trace(e.covariance[3:6, 3:6])) for e in known])
    assert sigma[time < 5.2][-1] > 3.0 * sigma[time < 3.45][-1]
    error, covariance = position_and_yaw_error(flight, known[0], known[-1])
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all() and vio.contradiction is None


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [1, 2])
def test_a_silent_imu_is_bridged_by_the_images_taken_meanwhile(cameras: int) -> None:
    flight = Flight(703, 6.0)
    vio, estimates = run(flight, rig(cameras), CONFIG, silent=(3.5, 4.7))
    known = [e for e in estimates if e.status != "starting"]
    assert vio.contradiction is None and not vio.counters
    assert np.diff([e.time_ns for e in known]).max() == 50_000_000
    time = np.array([at(flight, e) / 200 for e in known])
    silent = [e for e, t in zip(known, time, strict=True) if 3.55 < t < 4.65]
    assert all(e.status == "weak" and "the IMU was silent for 1.2" in e.reasons[0] for e in silent)
    velocity = np.array([np.trace(e.covariance[6:9, 6:9]) for e in known])
    assert velocity[(time > 3.55) & (time < 4.65)].min() > velocity[time < 3.5][-1]
    for estimate in (silent[-1], known[-1]):
        error, covariance = position_and_yaw_error(flight, known[0], estimate)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, 4)


def test_the_same_view_again_tells_nothing_new_of_focal_lengths() -> None:
    """A minute of rest, whose corners err alike in every image, passed for a focal length that is 1 % off."""
    resting, _ = run(Flight(3, 1.2), rig(), CONFIG)
    moving, _ = run(Flight(3, 3.0), rig(), CONFIG)
    assert resting.start is not None and resting.start.kind == "at rest"
    at_rest, on_the_way = resting._watches._focal.sigma, moving._watches._focal.sigma
    assert np.isinf(at_rest).all() and np.isfinite(on_the_way).all()


@pytest.mark.parametrize("limit", [0.55, 0.7, np.inf])
def test_frames_whose_samples_sit_at_the_limit_of_the_gyroscope_are_weak_and_say_so(limit: float) -> None:
    flight = Flight(705, 5.0)
    clipped = (np.abs(flight.gyro) > limit).any(axis=1)
    flight.gyro = np.clip(flight.gyro, -limit, limit)
    _, estimates = run(flight, rig(), CONFIG)
    told = [e for e in estimates if any(f"saturated at {limit:.2f} rad/s" in reason for reason in e.reasons)]
    assert all(e.status != "ok" and clipped[max(at(flight, e) - 11, 0) : at(flight, e) + 2].any() for e in told)
    assert len(told) > 10 if clipped.any() else not any("saturated" in reason for e in estimates for reason in e.reasons)


@pytest.mark.parametrize(("begin_s", "end_s"), [(0.22, 0.9), (0.0, 0.6)])
def test_no_start_reaches_across_a_silent_imu(begin_s: float, end_s: float) -> None:
    """The samples are missing between two frames that wait for a start: those before it are of no use, and nothing breaks."""
    flight = Flight(703, 3.0)
    vio, estimates = run(flight, rig(), CONFIG, silent=(begin_s, end_s))
    assert vio.start is not None and vio.contradiction is None
    assert (BEFORE_A_GAP in vio.counters) == (begin_s > 0.0)  # from the beginning on, no frame waited
    known = [e for e in estimates if e.status != "starting"]
    assert known[0].time_ns * 1e-9 >= flight.time_ns[0] * 1e-9 + end_s
    error, covariance = position_and_yaw_error(flight, known[0], known[-1])
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all()


def test_what_moves_on_its_own_is_left_out_or_named() -> None:
    flight = Flight(11, 6.0)
    _, estimates = run(flight, rig(), CONFIG, SimulatedTracker(flight, rig(), moving=0.5))
    known = [e for e in estimates if e.status != "starting"]
    error, covariance = position_and_yaw_error(flight, known[0], known[-1])
    named = [r for e in known for r in e.reasons if "a moving object" in r]
    assert named or (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all()
    assert sum(e.rejected["does not fit the window"] for e in known if at(flight, e) > 640) > 50


def test_cameras_that_are_not_where_the_calibration_says_are_contradicted() -> None:
    flight, true = Flight(13, 6.0), rig()
    wrong = []
    for camera in true.cameras:
        T = camera.T_imu_camera.copy()
        T[:3, :3] = so3.exp(np.array([0.0, 0.15, 0.0])) @ T[:3, :3]
        wrong.append(T)
    believed = Rig.of([c.model for c in true.cameras], wrong, [(752, 480)] * 2, true.noise)
    vio = VisualInertialOdometry(CONFIG, believed, SimulatedTracker(flight, true))
    blank, statuses = np.zeros((480, 752), np.uint8), []
    for k in range(0, len(flight.time_ns) - 10, 10):
        for camera in range(2):
            vio.push_image(CameraImage(camera, "", int(flight.time_ns[k]), blank))
        ready = vio.push_imu(flight.time_ns[k : k + 10], flight.gyro[k : k + 10], flight.accel[k : k + 10])
        statuses += [e.status for e in ready]
    assert "weak" in statuses[60:] and vio.contradiction is not None


def test_what_cannot_be_used_is_refused_or_counted() -> None:
    flight = Flight(1, 1.0)
    vio = VisualInertialOdometry(CONFIG, rig(), SimulatedTracker(flight, rig()))
    with pytest.raises(InputError, match="cameras 0 to 1"):
        vio.push_image(CameraImage(2, "cam2", 1, np.zeros((480, 752), np.uint8)))
    with pytest.raises(InputError, match="752x480 pixels, as calibrated"):
        vio.push_image(CameraImage(0, "cam0", 1, np.zeros((240, 376), np.uint8)))
    vio.push_imu(
        flight.time_ns[[0, 2, 1, 3]], flight.gyro[:4], np.array([[0, 0, 9.8], [0, 0, 9.8], [0, 0, 9.8], [np.nan, 0, 9.8]])
    )
    assert vio.counters == {"IMU sample not finite": 1, "IMU sample out of order": 1}


@pytest.mark.parametrize("block", [1, 60])
def test_samples_that_are_no_measurements_are_counted_by_reason(block: int) -> None:
    flight = Flight(1, 1.0)
    vio = VisualInertialOdometry(CONFIG, rig(), SimulatedTracker(flight, rig()))
    gyro, accel = flight.gyro[:60].copy(), flight.accel[:60].copy()
    gyro[30] += 40.0
    gyro[40] = accel[40] = 0.0
    accel[50, 1] = 1e6
    for k in range(0, 60, block):
        vio.push_imu(flight.time_ns[k : k + block], gyro[k : k + block], accel[k : k + block])
    assert vio.counters == {
        "IMU sample unlike both of its neighbours": 1,
        "IMU sample of zeros": 1,
        "IMU sample beyond any sensor": 1,
    }


def test_what_waits_for_a_start_is_bounded_and_no_older_sample_is_weighed() -> None:
    flight, one = Flight(4, 9.0), rig(1)
    vio = VisualInertialOdometry(VioConfig(pixel_sigma=PIXEL_SIGMA, start_duration=0.5), one)
    blank = np.full((one.cameras[0].height, one.cameras[0].width), 90, np.uint8)
    kept = []
    for k in range(0, len(flight.time_ns), 40):  # nothing to see: it never starts
        vio.push_imu(flight.time_ns[k : k + 40], flight.gyro[k : k + 40], flight.accel[k : k + 40])
        estimates = vio.push_image(CameraImage(0, "cam0", int(flight.time_ns[k]), blank))
        assert all(e.status == "starting" for e in estimates)
        kept.append(len(vio._imu))
    rate_hz = 1e9 / np.diff(flight.time_ns).mean()
    assert vio.start is None and len(flight.time_ns) > 6.0 * rate_hz
    assert max(kept) < 3.0 * rate_hz  # four times the half second that a start takes, and what is spare
