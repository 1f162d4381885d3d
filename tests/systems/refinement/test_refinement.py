"""Refinement of a simulated run: nearer to the truth, as sure as it says, and refused where the map does not become sharper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from boxplus.errors import InputError
from boxplus.evaluation.nees import nees
from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.plane_voxels.thickness import Sharpness
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.refinement.collecting import OdometryRows, collect
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.keyframes import choose_keyframes
from boxplus.systems.refinement.planes.sightings import weights_of_slices
from boxplus.systems.refinement.refinement import refine
from boxplus.systems.refinement.unshown import kept_steps
from tests.systems.refinement.cases import Case
from tests.systems.slam.drives import ate


def test_scans_are_cut_into_slices_that_keep_every_point_but_of_the_first_scan(case: Case) -> None:
    run = case.run
    assert run.is_end.sum() == len(case.rows.time_ns)
    np.testing.assert_array_equal(run.time_ns[run.is_end], case.rows.time_ns)
    assert 3 * len(case.rows.time_ns) < len(run) <= 4 * len(case.rows.time_ns)
    assert (np.diff(run.time_ns) > 0).all()
    ends = np.flatnonzero(run.is_end)
    expected = np.stack([np.append(quaternion.from_matrix(s.R_world_imu[None])[0], s.p_world_imu) for s in case.rows.states])
    np.testing.assert_allclose(np.abs(run.T_world_imu[ends]), np.abs(expected), atol=1e-12)
    scans = [event for event in case.events if isinstance(event, Scan) and event.end_ns in set(case.rows.time_ns.tolist())]
    first = scans[0]
    late = int((first.time_ns >= first.end_ns - (first.end_ns - first.start_ns) // 8).sum())
    assert abs(sum(map(len, run.points)) - sum(map(len, scans[1:])) - late) <= 0.01 * len(first)


def test_points_lie_around_the_pose_of_their_slice(case: Case) -> None:
    """Seen from where the LiDAR truly was then, each is where it truly was, but for noise and what the IMU bent."""
    run, truth = case.run, case.simulation.ground_truth(case.run.time_ns)
    scans = [event for event in case.events if isinstance(event, Scan)]
    p, t = np.concatenate([scan.p_lidar for scan in scans]).astype(np.float64), np.concatenate([s.time_ns for s in scans])
    own = np.searchsorted((run.time_ns[1:] + run.time_ns[:-1]) // 2, t, side="left")
    R_lidar, p_lidar = case.simulation.T_imu_lidar[:3, :3], case.simulation.T_imu_lidar[:3, 3]
    for k in (1, 6, len(run) // 2, len(run) - 2):
        there = case.simulation.ground_truth(t[own == k])
        world = np.einsum("nij,nj->ni", there.R_world_imu, p[own == k] @ R_lidar.T + p_lidar) + there.p_world_imu
        expected = ((world - truth.p_world_imu[k]) @ truth.R_world_imu[k] - p_lidar) @ R_lidar
        assert len(expected) == len(run.points[k])
        far, _ = cKDTree(expected).query(run.points[k])
        assert np.median(far) < 0.002 and far.max() < 0.02


def test_standing_still_weighs_as_a_moment_does(case: Case) -> None:
    """A body in motion counts in full; one that stays for seconds as 0.2 s, however long."""
    assert np.median(weights_of_slices(case.run)) == 1.0
    still = replace(case.run, T_world_imu=np.tile(case.run.T_world_imu[:1], (len(case.run), 1)))
    seconds = (case.run.time_ns[-1] - case.run.time_ns[0]) * 1e-9
    np.testing.assert_allclose(weights_of_slices(still), 0.2 / seconds)


def test_slices_lie_on_the_way_between_the_scans(case: Case) -> None:
    """Between two scans the IMU carries the pose: no slice jumps."""
    run = case.run
    step = np.linalg.norm(np.diff(run.T_world_imu[:, 4:], axis=0), axis=1) / (np.diff(run.time_ns) * 1e-9)
    assert step.max() < 1.3 * np.linalg.norm(run.velocity_bias[:, :3], axis=1).max() + 0.1


def test_it_comes_nearer_to_the_truth_and_says_so(case: Case) -> None:
    refined = case.refined
    before, after = case.error(case.run.T_world_imu), case.error(refined.after.T_world_imu)
    assert after < before
    assert refined.refusal is None
    assert refined.sharpness[1].thickness < refined.sharpness[0].thickness
    np.testing.assert_allclose(refined.after.T_world_imu[0], case.run.T_world_imu[0], atol=1e-9)


def test_covariance_is_that_of_the_error(case: Case) -> None:
    """Relative to the first pose. Errors of one run are one draw, so the band is wide: within four times of what was said."""
    ends = np.flatnonzero(case.run.is_end)
    T, covariance = case.refined.after.T_world_imu[ends], case.refined.pose_covariance[ends]
    truth = se3.compose(np.broadcast_to(se3.compose(T[0], se3.inverse(case.T_true[0])), T.shape), case.T_true)
    turn = so3.log(np.swapaxes(quaternion.to_matrix(truth[:, :4]), 1, 2) @ quaternion.to_matrix(T[:, :4]))
    found = nees(np.hstack([turn, T[:, 4:] - truth[:, 4:]])[1:], covariance[1:]).mean() / 6.0
    assert 0.05 < found < 4.0


def test_threads_do_not_change_a_bit(case: Case) -> None:
    settings = RefinementConfig(rounds=1, threads=2)  # type: ignore[call-arg]
    one, two = (refine(case.run, settings.model_copy(update={"threads": n})) for n in (1, 2))
    np.testing.assert_array_equal(one.after.T_world_imu, two.after.T_world_imu)


def test_what_does_not_sharpen_the_map_is_refused(case: Case) -> None:
    sharp, blurred = Sharpness(0.010, 1.0, 1000, 9), Sharpness(0.011, 1.0, 1000, 9)
    assert replace(case.refined, sharpness=(blurred, sharp)).refusal is None
    for pair in ((sharp, blurred), (sharp, sharp)):
        refusal = replace(case.refined, sharpness=pair).refusal
        assert refusal == "the points that took no part lie farther from their planes than before"
    nothing = Sharpness(float("nan"), float("nan"), 0, 0)
    assert "no plane" in str(replace(case.refined, sharpness=(nothing, nothing)).refusal)


def test_a_run_at_the_truth_is_left_there(case: Case) -> None:
    """Refining does not drift away, however often planes are found anew."""
    ends = np.flatnonzero(case.run.is_end)
    moved = refine(case.run, RefinementConfig(rounds=6)).after.T_world_imu[ends]  # type: ignore[call-arg]
    assert ate(moved[:, 4:], case.refined.after.T_world_imu[ends][:, 4:]) < 0.5e-3


def test_another_recording_is_refused(case: Case) -> None:
    later = OdometryRows(case.rows.time_ns + 7, case.rows.states, case.rows.status)
    with pytest.raises(InputError, match=r"expected the recording that the odometry went over, with \d+ scans – got 0 of them"):
        collect(case.events, later, case.config, RefinementConfig())  # type: ignore[call-arg]
    assert case.rows.points is not None
    other = replace(case.rows, points=case.rows.points + 1)  # a simulation of another world begins at the same time
    with pytest.raises(InputError, match=r"that the odometry went over – got another number of points in (\d+) of the \1 scans"):
        collect(case.events, other, case.config, RefinementConfig())  # type: ignore[call-arg]


def test_without_planes_nothing_is_refined(case: Case) -> None:
    blind = replace(case.run, points=[points[:3] for points in case.run.points])
    with pytest.raises(InputError, match=r"expected 6 planes at least that two keyframes see – got \d"):
        refine(blind)


def test_keyframes_begin_after_a_way_a_turn_or_a_time() -> None:
    time_ns = np.arange(100) * 100_000_000
    still = np.tile([1.0, 0, 0, 0, 0, 0, 0], (100, 1))
    config = RefinementConfig()  # type: ignore[call-arg]
    assert len(choose_keyframes(time_ns, still, config)) == 10  # 11 scans each, the last with what is left
    walking, turning = still.copy(), still.copy()
    walking[:, 4] = 0.2 * np.arange(100)
    turning[:, :4] = quaternion.from_matrix(so3.exp(np.deg2rad(6.0) * np.arange(100)[:, None] * [0.0, 0.0, 1.0]))
    for poses, length in ((walking, 4), (turning, 2)):
        keyframes = choose_keyframes(time_ns, poses, config)
        assert np.bincount(keyframes.of_scan)[:-1].tolist() == [length] * (len(keyframes) - 1)
        assert keyframes.scan[0] == 0 and (keyframes.of_scan[keyframes.scan] == np.arange(len(keyframes))).all()


def test_steps_along_what_is_open_are_those_of_the_run_and_others_are_refined(case: Case) -> None:
    open_steps = np.zeros((len(case.run), 3, 3))
    open_steps[len(case.run) // 2 :, 0, 0] = 1.0
    is_unshown = open_steps[:, 0, 0] > 0.0
    run = replace(case.run, open_steps=open_steps, is_unshown=is_unshown)
    found = refine(run, RefinementConfig(rounds=1))  # type: ignore[call-arg]
    later = np.flatnonzero(open_steps[:, 0, 0])

    def off(T: np.ndarray, axis: int) -> float:
        """By which the steps moved along an axis of the world, at most [m]."""
        along = np.zeros((len(later), 3, 3))
        along[:, axis, axis] = 1.0
        step = kept_steps(run.T_world_imu, later - 1, later, along)
        white = step.whitening.factors @ step.evaluate(T[later - 1], T[later])[:, :, None]
        return float(1e-5 * np.linalg.norm(white[:, :, 0], axis=1).max())

    held, free = found.after.T_world_imu, case.refined.after.T_world_imu
    assert 5.0 * off(held, 0) < min(off(free, 0), off(held, 1), off(free, 1))
    assert found.refusal is None and case.error(held) < case.error(run.T_world_imu)
    # A step that is held is as good as that of the run, and not known to the ten micrometres it is held by.
    assert run.covariance is not None
    np.testing.assert_array_equal(found.pose_covariance[is_unshown], run.covariance[is_unshown])
    assert (found.pose_covariance[~is_unshown][1:, 3, 3] < run.covariance[~is_unshown][1:, 3, 3]).mean() > 0.5
