"""Lines in a window: founded, left out, and taken along by a prior that knows nothing of yaw and position."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import lines, quaternion, so3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.optimization.marginalization.leak import world_gauge
from boxplus.optimization.marginalization.marginalize import marginalize
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.prior import Prior
from boxplus.systems.visual_inertial_odometry.lines.landmarks import LineLandmarks
from boxplus.systems.visual_inertial_odometry.lines.tracks import LineTracks
from tests.systems.visual_inertial_odometry.simulated_rays import rig

RIG = rig()
FRAMES, LINES = 5, 12
SIGMA = 0.3


class Scene:
    """Lines before a rig that moves, and a window with true poses."""

    def __init__(self, seed: int, noise_px: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        middle = np.column_stack([rng.uniform(3.0, 6.0, LINES), rng.uniform(-1.5, 1.5, LINES), rng.uniform(-1.0, 1.0, LINES)])
        half = rng.normal(size=(LINES, 3)) * 0.2 + [0.0, 0.0, 0.6]
        self.ends = np.stack([middle - half, middle + half], axis=1)
        p = np.cumsum(rng.normal(size=(FRAMES, 3)) * 0.2, axis=0)
        q = quaternion.from_matrix(so3.exp(rng.normal(size=(FRAMES, 3)) * 0.05))
        self.poses = np.hstack([q, p])
        self.problem = Problem()
        self.bodies: Variables = self.problem.add_variables(BodyPose, self.poses, name="bodies")
        self.mountings: Variables = self.problem.add_variables(BodyPose, RIG.mountings, name="mountings")
        self.problem.fix(self.mountings)
        self.lines = LineLandmarks(self.problem, RIG, SIGMA)
        self.tracks = [self.seen(k, rng, noise_px) for k in range(FRAMES)]

    def seen(self, frame: int, rng: np.random.Generator, noise_px: float) -> LineTracks:
        segments = np.zeros((LINES, 2, 4))
        R, p = quaternion.to_matrix(self.poses[frame, :4]), self.poses[frame, 4:]
        for c, camera in enumerate(RIG.cameras):
            T = camera.T_imu_camera
            p_camera = ((self.ends - p) @ R - T[:3, 3]) @ T[:3, :3]
            segments[:, c] = (p_camera[..., :2] / p_camera[..., 2:]).reshape(-1, 4)
        segments += rng.normal(size=segments.shape) * noise_px / RIG.cameras[0].model.fx
        return LineTracks(np.arange(LINES) + 5, segments, {})

    def found(self, frames: int = FRAMES) -> None:
        known = [(k, self.tracks[k]) for k in range(frames)]
        self.lines.found(known, self.poses[:frames], self.mountings.values)
        assert 0.8 * LINES < len(self.lines) <= LINES

    def values(self) -> list[np.ndarray]:
        return [block.values for block in self.problem.blocks]


def test_lines_are_founded_where_they_are_and_their_ends_are_what_was_seen() -> None:
    scene = Scene(1)
    scene.found(3)
    scene.lines.add(3, scene.tracks[3])
    scene.lines.add(4, None)
    ids, ends = scene.lines.ends(scene.bodies, scene.mountings.values)
    own = ids - scene.tracks[0].ids[0]
    np.testing.assert_allclose(ends.reshape(-1, 2, 3), scene.ends[own], atol=1e-6)
    truth = lines.to_plucker(lines.from_points(scene.ends[own, 0], scene.ends[own, 1]))
    got = lines.to_plucker(scene.lines.block.values)
    np.testing.assert_allclose(got * np.sign((got * truth).sum(axis=1))[:, None], truth, atol=1e-7)
    scene.lines.connect(scene.bodies, scene.mountings)
    scene.problem.fix(scene.bodies)
    scene.problem.solve(max_iterations=1)
    fit = scene.lines.reject(scene.values(), 3, 4.0)
    assert (fit.agreed, fit.not_agreed, len(fit.given_up)) == (len(own), 0, 0)


def test_what_does_not_fit_is_left_out_and_a_line_that_nothing_shows_is_given_up() -> None:
    scene = Scene(2)
    scene.found(3)
    ids, _ = scene.lines.ends(scene.bodies, scene.mountings.values)
    moved = scene.tracks[3].segments.copy()
    moved[ids[4] - scene.tracks[3].ids[0]] += 0.05
    scene.lines.add(3, LineTracks(scene.tracks[3].ids, moved, {}))
    scene.lines.connect(scene.bodies, scene.mountings)
    scene.problem.fix(scene.bodies)
    scene.problem.solve(max_iterations=1)
    fit = scene.lines.reject(scene.values(), 3, 4.0)
    assert (fit.agreed, fit.not_agreed) == (len(ids) - 1, 1) and not len(fit.given_up)
    for frame in range(4):
        scene.lines.drop(frame)
    scene.lines.connect(scene.bodies, scene.mountings)
    fit = scene.lines.reject(scene.values(), 3, 4.0)
    assert sorted(fit.given_up.tolist()) == ids.tolist() and len(scene.lines) == 0


def test_views_along_a_line_found_none() -> None:
    scene = Scene(3)
    middle = scene.ends.mean(axis=1)
    # Upwards in the plane of the first camera and the direction of a fixed motion, which all cameras share.
    scene.poses[:, :4], scene.poses[:, 4:] = [1.0, 0.0, 0.0, 0.0], np.outer(np.arange(FRAMES), [0.0, 0.15, 0.0])
    scene.ends = middle[:, None] + [[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]]
    rng = np.random.default_rng(4)
    scene.tracks = [scene.seen(k, rng, 0.1) for k in range(FRAMES)]
    scene.lines.found(list(enumerate(scene.tracks)), scene.poses, scene.mountings.values)
    assert len(scene.lines) == 0


@pytest.mark.parametrize("seed", [5, 6])
def test_a_prior_from_lines_claims_nothing_of_yaw_and_position(seed: int) -> None:
    """Whatever the poses and lines became since: Jacobians of what is in a prior stay where they were."""
    scene, rng = Scene(seed, noise_px=0.3), np.random.default_rng(seed + 50)
    gauge = world_gauge({scene.bodies: "world_from_body"}, rotation="yaw")
    scene.found(FRAMES)
    for oldest in range(2):
        rows = list(range(oldest, FRAMES))
        line_rows = scene.lines.leave(scene.bodies, scene.mountings, rows, FRAMES - 1, scene.tracks[-1])
        assert len(line_rows)
        leak = marginalize(scene.problem, [scene.bodies[oldest], line_rows], at=None, gauge=gauge).leak
        scene.lines.forget(line_rows.ids)
        assert leak is not None and leak.worst < 1e-8
        moved = scene.bodies.values.copy()
        moved[:, 4:] += rng.normal(size=(len(moved), 3)) * 0.03
        scene.bodies.values[:] = moved
        known = [(k, scene.tracks[k]) for k in range(oldest + 1, FRAMES)]
        scene.lines._free_from.clear()
        scene.lines.found(known, moved, scene.mountings.values)


def test_a_line_still_followed_is_founded_anew_by_the_newest_frames_alone() -> None:
    scene = Scene(7)
    scene.found()
    leaving = scene.lines.leave(scene.bodies, scene.mountings, range(FRAMES), 3, scene.tracks[-1])
    assert len(leaving) == len(scene.lines)
    group = scene.problem.groups[-1]
    assert set(group.connections[0].block.ids[group.connections[0].rows].tolist()) == {0, 1, 2}  # 3 and 4 are spared
    prior = Prior(BodyPose, scene.poses[3], sigma=0.1)
    scene.problem.add_residuals(prior, scene.bodies[3], name="kept")
    marginalize(scene.problem, [scene.bodies[0], leaving], at=None)
    scene.lines.forget(leaving.ids)
    assert len(scene.lines) == 0
    scene.lines.found([(k, scene.tracks[k]) for k in range(1, FRAMES)], scene.poses[1:], scene.mountings.values)
    scene.lines.connect(scene.bodies, scene.mountings)
    group = scene.problem.groups[-1]
    used = group.connections[0].block.ids[group.connections[0].rows]
    assert len(scene.lines) and set(used.tolist()) <= {3, 4}
