"""What a run knows beside scans and IMU: loops, positions by satellite, clocks and mountings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.se3 import SE3
from boxplus.maps.plane_voxels.plane_map import PlaneMap
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.keyframes import Keyframes
from boxplus.systems.refinement.outside.evidence import Receiver, RunFixes, RunLoops
from boxplus.systems.refinement.outside.loops import between_keyframes, contradicted
from boxplus.systems.refinement.planes.sightings import KeyframeClusters
from boxplus.systems.refinement.refinement import refine
from tests.systems.refinement.cases import Case
from tests.systems.slam.drives import ate

Floats = NDArray[np.float64]


def _poses(random: np.random.Generator, count: int, metres: float = 5.0) -> Floats:
    turns = quaternion.from_matrix(so3.exp(random.normal(size=(count, 3))))
    return np.hstack([turns, metres * random.normal(size=(count, 3))])


def _planes(normals: Floats) -> PlaneMap:
    count = len(normals)
    planes, nowhere = np.hstack([normals, np.zeros((count, 1))]), np.zeros(0, dtype=np.int64)
    return PlaneMap(planes, np.zeros((count, 3)), np.zeros(count), 0.5, nowhere, nowhere.astype(np.int32))


def _seen(keyframes: list[int], weight: float) -> KeyframeClusters:
    """Each keyframe sees a wall along every axis, which it stands six metres away from on either side."""
    keyframe, plane, clusters = [], [], []
    for key in keyframes:
        for axis in range(3):
            for side in (-6.0, 6.0):
                for across, along in ((-5.0, -5.0), (-5.0, 5.0), (5.0, -5.0), (5.0, 5.0)):
                    p = np.insert([across, along], axis, side)
                    homogeneous = np.append(p, 1.0)
                    keyframe.append(key)
                    plane.append(axis)
                    clusters.append(weight * np.outer(homogeneous, homogeneous))
    return KeyframeClusters(np.array(keyframe), np.array(plane), np.array(clusters), np.ones(len(plane)))


@pytest.mark.parametrize("seed", range(5))
def test_a_loop_says_of_keyframes_what_it_says_of_its_local_maps(seed: int) -> None:
    """Square of the whitened error, wherever everything is: between keyframes what it is between the frames of local maps."""
    random = np.random.default_rng(seed)
    time_ns, T = np.arange(40) * 50_000_000, _poses(random, 40)
    keyframes = Keyframes(np.arange(2, 40, 5), np.repeat(np.arange(8), 5))
    root = random.normal(size=(2, 6, 6))
    loops = RunLoops(
        time_ns[[3, 17, 36]],
        _poses(random, 3),
        np.array([0, 0]),
        np.array([1, 2]),
        _poses(random, 2),
        root @ np.swapaxes(root, 1, 2),
    )
    none = KeyframeClusters(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4)), np.zeros(0))
    found = between_keyframes(loops, time_ns, T, keyframes, _planes(np.eye(3)), none, SE3.identity())
    assert found.place.tolist() == [0, 0] and found.query.tolist() == [3, 7] and not found.is_told.any()
    T_key = T[keyframes.scan]
    white = found.residual.whitening.factors @ found.residual.evaluate(T_key[found.place], T_key[found.query])[:, :, None]
    T_map = se3.compose(T[[3, 17, 36]], loops.T_imu_map)
    e = se3.log(se3.compose(se3.inverse(loops.T_place_query), se3.compose(se3.inverse(T_map[[0, 0]]), T_map[[1, 2]])))
    np.testing.assert_allclose((white[..., 0] ** 2).sum(axis=1), np.einsum("ni,nij,nj->n", e, loops.information, e), rtol=1e-6)


def test_planes_that_both_visits_see_take_the_place_of_a_loop() -> None:
    time_ns, T = np.arange(4) * 10**9, np.tile(SE3.identity(), (4, 1))
    keyframes = Keyframes(np.arange(4), np.arange(4))
    loops = RunLoops(
        time_ns[[0, 3]], T[:2], np.array([0]), np.array([1]), T[:1], np.diag([1e4] * 3 + [1e3] * 3)[None].astype(np.float64)
    )

    def told(seen: KeyframeClusters) -> bool:
        return bool(between_keyframes(loops, time_ns, T, keyframes, _planes(np.eye(3)), seen, SE3.identity()).is_told[0])

    assert told(_seen([0, 1, 2, 3], 1e4))
    assert not told(_seen([0, 1, 2, 3], 10.0)), "the planes know less than the loop"
    assert not told(_seen([0, 1], 1e4)), "the later visit does not see them"
    one_wall = _seen([0, 1, 2, 3], 1e4)
    chosen = one_wall.plane == 0
    partly = KeyframeClusters(
        one_wall.keyframe[chosen], one_wall.plane[chosen], one_wall.clusters[chosen], one_wall.counted[chosen]
    )
    assert not told(partly), "a wall leaves open what the loop knows"


def test_many_sound_loops_are_not_doubted_by_chance_and_a_false_one_is() -> None:
    random = np.random.default_rng(0)
    named = 0
    for _ in range(300):
        errors = np.linalg.norm(random.normal(size=(1000, 6)), axis=1)
        named += bool(contradicted(errors).any())
        errors[500] = 12.0
        assert contradicted(errors)[500]
    assert named <= 1  # of 300; with the bound of a single loop one in ten
    assert not len(contradicted(np.zeros(0)))
    assert contradicted(np.array([5.4])).all() and not contradicted(np.array([5.2])).any()


def _loops_of(case: Case, shift: float) -> RunLoops:
    """Three local maps, the last one of which is the first place again, `shift` metres beside where it is."""
    run, ends = case.run, np.flatnonzero(case.run.is_end)
    scans = ends[[4, len(ends) // 2, -5]]
    T_true = case.T_true[[4, len(ends) // 2, -5]]
    Z = se3.compose(se3.inverse(T_true[0]), T_true[2])
    Z[4:] += [shift, 0.0, 0.0]
    none = np.tile(SE3.identity(), (3, 1))
    information = np.diag([2e-3**-2] * 3 + [0.02**-2] * 3)[None]
    return RunLoops(run.time_ns[scans], none, np.array([0]), np.array([2]), Z[None], information)


@pytest.mark.slow
def test_a_false_loop_where_planes_are_shared_moves_nothing_and_is_told(case: Case) -> None:
    ends = np.flatnonzero(case.run.is_end)
    for shift, is_false in ((0.0, False), (0.5, True)):
        found = refine(replace(case.run, loops=_loops_of(case, shift)), RefinementConfig(rounds=2))  # type: ignore[call-arg]
        assert found.loop_is_told.all()
        assert (found.loop_errors[0] > 10.0) == is_false
        assert (found.loop_errors[0] < 4.0) == (not is_false)
        assert case.error(found.after.T_world_imu) < 1.5 * case.error(case.refined.after.T_world_imu)
        assert ate(found.after.T_world_imu[ends][:, 4:], case.refined.after.T_world_imu[ends][:, 4:]) < 1e-3


def test_positions_by_satellite_lay_a_run_onto_the_earth(case: Case) -> None:
    """A run that lies 3 cm and 0.5° beside comes to where the fixes put it, with a lever arm that nobody gave."""
    random, lever = np.random.default_rng(3), np.array([0.3, -0.1, 0.6])
    beside = np.append(quaternion.from_matrix(so3.exp([0.0, 0.0, np.deg2rad(0.5)])), [0.03, 0.0, 0.0])
    at = case.run.time_ns[0] + np.arange(30) * 250_000_000
    motion = case.simulation.ground_truth(at)
    antenna = motion.p_world_imu + np.einsum("nij,j->ni", motion.R_world_imu, lever) + 0.005 * random.normal(size=(30, 3))
    start = Receiver(SE3.identity(), np.zeros(3), 0.0, np.full(10, np.nan))
    run = replace(
        case.run,
        T_world_imu=se3.compose(np.tile(beside, (len(case.run), 1)), case.run.T_world_imu),
        velocity_bias=np.hstack(
            [case.run.velocity_bias[:, :3] @ quaternion.to_matrix(beside[:4]).T, case.run.velocity_bias[:, 3:]]
        ),
        fixes=RunFixes(at, antenna, np.tile(0.005**2 * np.eye(3), (30, 1, 1)), start, 1.0, 0.1, 0.005),
    )
    found = refine(run, RefinementConfig(rounds=2))  # type: ignore[call-arg]
    off = found.after.T_world_imu[case.run.is_end][:, 4:] - case.T_true[:, 4:]
    assert np.linalg.norm(off.mean(axis=0)) < 0.01
    receiver = found.after.receiver
    assert receiver is not None
    np.testing.assert_allclose(receiver.T_enu_world[4:], 0.0, atol=1e-9)  # what is written lies on the Earth
    assert (receiver.sigma[6:9] > 0.0).all() and (receiver.sigma[6:9] < 0.02).all()
    assert (np.abs(receiver.lever - lever) < 4.0 * receiver.sigma[6:9]).all()
    assert abs(receiver.delay_s) < 4.0 * receiver.sigma[9]


def test_a_clock_that_is_late_is_found_and_one_that_nothing_tells_is_held(case: Case) -> None:
    imu = case.run.imu
    late = replace(case.run, imu=type(imu)(imu.time_ns + 4_000_000, imu.gyro, imu.accel))
    settings = RefinementConfig(rounds=2, time_offset_estimation="gated")  # type: ignore[call-arg]
    found = refine(late, settings)
    sigma = found.calibration.time_offset_sigma
    assert 0.0 < sigma < 1e-3
    assert abs(found.after.time_offset_s - 0.004) < max(4.0 * sigma, 3e-4)
    assert "refined to +" in found.calibration.time_offset and f"± {1e3 * sigma:.2f} ms" in found.calibration.time_offset
    sure = settings.model_copy(update={"time_offset_sigma": 1e-5})  # nothing tells it better than it is known
    held = refine(late, sure)
    assert held.after.time_offset_s == 0.0 and held.calibration.time_offset_sigma == 0.0
    assert "held: the motion tells it to 0.0 ms only" in held.calibration.time_offset


def test_a_mounting_is_refined_with_its_standard_deviation(case: Case) -> None:
    wrong = case.run.T_imu_lidar.copy()
    wrong[4:] += [0.0, 0.012, 0.0]
    settings = RefinementConfig(rounds=2, extrinsic_estimation="on")  # type: ignore[call-arg]
    found = refine(replace(case.run, T_imu_lidar=wrong), settings)
    sigma = found.calibration.extrinsic_sigma
    assert (sigma > 0.0).all() and (sigma[3:] < 0.02).all()
    left = np.abs(found.after.T_imu_lidar[4:] - case.run.T_imu_lidar[4:])
    assert left[1] < 0.5 * 0.012
    assert "± " in found.calibration.extrinsic and found.calibration.extrinsic.startswith("refined by")
