"""One problem for an IMU and a stereo camera: poses, velocities, biases, gravity, mountings, time offset, points and lines.

Without noise it converges to the truth; with noise its errors have the covariance that it states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

import boxplus as bp
from boxplus.evaluation.nees import nees, nees_band
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.lines import from_points
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals import (
    ImuNoise,
    ImuPreintegration,
    InverseDepthReprojection,
    LineReprojection,
    Preintegration,
    Prior,
    on_rig,
)

FRAMES, POINTS, LINES, DT_NS = 6, 40, 6, 5_000_000
G = 9.81
NOISE = ImuNoise(gyro=2e-3, accel=2e-2, gyro_walk=5e-4, accel_walk=5e-3)
CAMERAS = [bp.Pinhole(420.0, 425.0, 320.0, 240.0), bp.Pinhole(450.0, 445.0, 310.0, 250.0)]
FORWARD = np.array([0.5, -0.5, 0.5, -0.5])  # z of the camera along x of the body
PIXEL, TIME = 0.5, 0.005  # standard deviations [px], [s]
POSE = np.repeat([0.01, 0.01], 3)
MOUNTING = np.repeat([0.01, 0.02], 3)
BIAS = np.repeat([0.05, 0.01], 3)
# How far off the search starts, in standard deviations.
START_POSE, START_STATE = np.repeat([0.02, 0.05], 3), np.repeat([0.1, 0.02, 0.005], 3)
START_MOUNTING, START_GRAVITY = 0.01, 0.02


@dataclass
class Window:
    problem: bp.Problem
    imu: ImuPreintegration
    blocks: dict[str, Variables]
    truth: dict[str, NDArray[np.float64]]


def motion(rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Times of the samples, angular velocities, specific forces and times of the keyframes."""
    count = 50 * (FRAMES - 1) + 1
    time_ns = 10**18 + DT_NS * np.arange(count)
    s = 1e-9 * (time_ns - time_ns[0])[:, None]
    phase = rng.uniform(0.0, 6.0, (2, 3))
    w = np.array([0.3, 0.3, 0.4]) * np.sin(s * [2.0, 3.0, 2.5] + phase[0])
    R = np.eye(3)
    accel = np.zeros((count, 3))
    for k in range(count):
        accel[k] = R.T @ (np.array([1.5, 1.0, 0.8]) * np.sin(s[k] * [3.0, 4.0, 5.0] + phase[1]) + [0.0, 0.0, G])
        R = R @ so3.exp(w[k] * 1e-9 * DT_NS)
    return time_ns, w, accel, time_ns[::50]


def camera_poses(body: NDArray[np.float64], mounting: NDArray[np.float64]) -> NDArray[np.float64]:
    return se3.inverse(se3.compose(body, mounting))


def seen(
    p: NDArray[np.float64], body: NDArray[np.float64], mounting: NDArray[np.float64], camera: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Pixels (n, 2) of points (n, 3), NaN where a point is not seen."""
    p_camera = se3.act(camera_poses(body, mounting), p)
    return np.where(camera[:, None] == 0, CAMERAS[0].project(p_camera)[0], CAMERAS[1].project(p_camera)[0])


def window(seed: int, noisy: bool) -> Window:
    rng = np.random.default_rng(seed)
    level = 1.0 if noisy else 0.0
    time_ns, w, a, keyframes = motion(rng)
    intervals = np.column_stack([keyframes[:-1], keyframes[1:]])
    bias_start = rng.normal(size=6) * BIAS
    walk = np.repeat([NOISE.accel_walk, NOISE.gyro_walk], 3) * np.sqrt(1e-9 * DT_NS)
    bias = bias_start + level * np.cumsum(rng.normal(size=(len(time_ns), 6)) * walk, axis=0)
    white = level / np.sqrt(1e-9 * DT_NS) * rng.normal(size=(len(time_ns), 6)) * np.repeat([NOISE.gyro, NOISE.accel], 3)
    measured = w + bias[:, 3:] + white[:, :3], a + bias[:, :3] + white[:, 3:]
    bias_guess = bias_start + rng.normal(size=6) * BIAS if noisy else bias_start + np.repeat([0.01, -0.002], 3)

    def integrate(gyro: NDArray[np.float64], accel: NDArray[np.float64], guess: NDArray[np.float64]) -> Preintegration:
        return Preintegration.integrate(
            time_ns, gyro, accel, noise=NOISE, intervals_ns=intervals, bias_accel=guess[:3], bias_gyro=guess[3:]
        )

    p = integrate(*measured, bias_guess)
    # Without noise the truth is what the residual's own correction for the bias says, so that it is the minimum exactly.
    motion_of, offset = (integrate(w, a, np.zeros(6)), np.zeros(6)) if noisy else (p, bias_start)
    poses = [np.array([1.0, 0, 0, 0, 0, 0, 0])]
    states = [np.concatenate([rng.normal(size=3) * 0.5, offset])]
    for k in range(FRAMES - 1):
        pose, state = motion_of[k].predict(poses[-1], states[-1], [0.0, 0.0, -G])
        poses.append(pose[0])
        states.append(state[0])
    T, s = np.array(poses), np.array(states)
    s[:, 3:] = bias[::50]
    mountings = bp.BodyPose.boxplus(
        np.array([[*FORWARD, 0.1, 0.06, 0.02], [*FORWARD, 0.1, -0.06, 0.02]]), rng.normal(size=(2, 6)) * 0.02
    )
    t_d = rng.normal() * TIME
    anchor, anchor_camera = rng.integers(0, FRAMES, POINTS), rng.integers(0, 2, POINTS)
    rays = rng.uniform([-0.6, -0.45], [0.6, 0.45], (POINTS, 2))
    rho = 1.0 / rng.uniform(2.0, 15.0, POINTS)
    points = np.column_stack([rays, rho])
    in_anchor = np.column_stack([rays, np.ones(POINTS)]) / rho[:, None]
    p_world = se3.act(se3.compose(T[anchor], mountings[anchor_camera]), in_anchor)
    ends = np.stack([rng.uniform([4, -3, -2], [8, 0, 2], (LINES, 3)), rng.uniform([4, 0, -2], [8, 3, 2], (LINES, 3))])
    lines = from_points(ends[0], ends[1])

    # Every point and end point in every camera of every frame, with its velocity in the image.
    frame, camera, index = (i.ravel() for i in np.meshgrid(range(FRAMES), range(2), range(POINTS + 2 * LINES), indexing="ij"))
    every = np.vstack([p_world, ends[0], ends[1]])
    rate, h = w[::50], 1e-4

    def pixels(t: float) -> NDArray[np.float64]:
        later = np.column_stack(
            [quaternion.multiply(T[:, :4], quaternion.from_matrix(so3.exp(rate * t))), T[:, 4:] + s[:, :3] * t]
        )
        return seen(every[index], later[frame], mountings[camera], camera)

    velocity = (pixels(h) - pixels(-h)) / (2.0 * h)
    z = pixels(0.0) + t_d * velocity + level * PIXEL * rng.normal(size=velocity.shape)
    z, velocity = (array.reshape(FRAMES, 2, POINTS + 2 * LINES, 2) for array in (z, velocity))
    sharp = np.isfinite(z).all(axis=3) & (z > -100.0).all(axis=3) & (z < 800.0).all(axis=3)
    f, c, n = np.nonzero(sharp[:, :, :POINTS])

    def start(manifold: bp.Manifold, x: NDArray[np.float64], sigma: object) -> NDArray[np.float64]:
        return manifold.boxplus(x, rng.normal(size=(len(x), manifold.dof)) * np.asarray(sigma))

    gravity = np.array([[0.0, 0.0, -1.0]])
    truth = {"poses": T, "states": s, "mountings": mountings, "offset": np.array([[t_d]]), "gravity": gravity}
    truth |= {"points": points, "lines": lines}
    problem = bp.Problem()
    body = problem.add_variables(bp.BodyPose, start(bp.BodyPose, T, START_POSE), name="poses")
    state = problem.add_variables(bp.Euclidean(9), start(bp.Euclidean(9), s, START_STATE), name="states")
    mount = problem.add_variables(bp.BodyPose, start(bp.BodyPose, mountings, START_MOUNTING), name="mountings")
    offset_of = problem.add_variables(bp.Euclidean(1), [[0.0]], name="offset")
    down = problem.add_variables(bp.S2, start(bp.S2, gravity, START_GRAVITY), name="gravity")
    point = problem.add_variables(bp.Euclidean(3), points * (1.0 + 0.1 * rng.normal(size=points.shape)), name="points")
    line = problem.add_variables(bp.Line3D, start(bp.Line3D, lines, 0.02), name="lines")

    imu = ImuPreintegration(p, gravity=(0.0, 0.0, -G), gravity_direction=True)
    problem.add_residuals(imu, body[:-1], state[:-1], body[1:], state[1:], down)
    for group, k in on_rig(InverseDepthReprojection, CAMERAS, c, z[f, c, n], image_velocity=velocity[f, c, n], sigma=PIXEL):
        of = n[k]
        problem.add_residuals(group, body[anchor[of]], mount[anchor_camera[of]], body[f[k]], mount[c[k]], point[of], offset_of)
    first, second = slice(POINTS, POINTS + LINES), slice(POINTS + LINES, None)
    f, c, n = np.nonzero(sharp[:, :, first] & sharp[:, :, second])
    segments, moving = (np.concatenate([v[:, :, first][f, c, n], v[:, :, second][f, c, n]], axis=1) for v in (z, velocity))
    for group, k in on_rig(LineReprojection, CAMERAS, c, segments, image_velocity=moving, sigma=PIXEL):
        problem.add_residuals(group, body[f[k]], mount[c[k]], line[n[k]], offset_of)
    known = Prior(bp.BodyPose, bp.BodyPose.boxplus(T[:1], level * rng.normal(size=6) * POSE), sigma=POSE)
    problem.add_residuals(known, body[[0]])
    known = Prior(bp.BodyPose, bp.BodyPose.boxplus(mountings, level * rng.normal(size=(2, 6)) * MOUNTING), sigma=MOUNTING)
    problem.add_residuals(known, mount)
    sigma = np.concatenate([[100.0] * 3, BIAS])
    believed = np.concatenate([s[0, :3], bias_guess]) if noisy else s[0]
    problem.add_residuals(Prior(bp.Euclidean(9), believed, sigma=sigma), state[[0]])
    problem.add_residuals(Prior(bp.Euclidean(1), [0.0] if noisy else [t_d], sigma=TIME), offset_of)
    return Window(problem, imu, {block.name: block for block in problem.blocks}, truth)


def error(solution: Solution, made: Window, name: str) -> NDArray[np.float64]:
    """Truth ⊟ estimate (n, dof), in the tangent that the covariance is of."""
    block = made.blocks[name]
    return block.manifold.boxminus(made.truth[name], solution[block])


def solved(made: Window) -> Solution:
    solution = made.problem.solve()
    while made.imu.refresh(solution[made.blocks["states"]][:-1]):
        solution = made.problem.solve(start=solution)
    return solution


@pytest.mark.parametrize("seed", range(4))
def test_without_noise_the_truth_is_found(seed: int) -> None:
    made = window(seed, noisy=False)
    assert sum(group.residual.count for group in made.problem.groups) > 300
    before = {name: np.abs(block.manifold.boxminus(made.truth[name], block.values)).max() for name, block in made.blocks.items()}
    assert min(before.values()) > 1e-4
    solution = made.problem.solve()
    assert solution.status == "converged" and solution.cost < 1e-12, solution.summary()
    for name in made.blocks:
        assert np.abs(error(solution, made, name)).max() < 1e-8, name


@pytest.mark.slow
def test_with_noise_the_covariance_is_that_of_the_errors() -> None:
    """Groups of variables by themselves and all together; one of a thousand would be outside of its band by chance."""
    runs = 40
    motions = ("poses", "states", "mountings", "offset", "gravity")
    scores: dict[str, list[float]] = {name: [] for name in (*motions, "together")}
    dofs = {}
    for seed in range(runs):
        made = window(seed, noisy=True)
        solution = solved(made)
        assert solution.status == "converged", solution.summary()
        errors = {name: error(solution, made, name).ravel() for name in motions}
        for name, e in errors.items():
            covariance = solution.joint_covariance(made.blocks[name][:])
            scores[name].append(float(nees(e[None], covariance[None])[0]))
            dofs[name] = len(e)
        e = np.concatenate(list(errors.values()))
        covariance = solution.joint_covariance(*(made.blocks[name][:] for name in motions))
        scores["together"].append(float(nees(e[None], covariance[None])[0]))
        dofs["together"] = len(e)
    for name, found in scores.items():
        low, high = nees_band(dofs[name], runs, 0.999)
        assert low < np.mean(found) < high, f"{name}: {np.mean(found):.1f} of {dofs[name]}, band {low:.1f} to {high:.1f}"
