"""The window: derivatives, elimination, what marginalisation keeps, and what a prior must not claim."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.residuals.camera.photometric import DSO_PATTERN
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth
from boxplus.systems.direct_odometry.patches import choose_patches
from boxplus.systems.direct_odometry.window import Window
from boxplus.systems.direct_odometry.window_kernel import add_rows, eliminate
from boxplus.systems.direct_odometry.window_system import DOF, WindowKeyframe, linearize
from tests.systems.direct_odometry.scenes import CAMERA, Room, path

Matrix = NDArray[np.float64]
QUADRATIC = 150.0  # a σ in which all residuals are small


def keyframes(seed: int, count: int, step: int = 3) -> list[WindowKeyframe]:
    """Along a path, at true poses, with true depths."""
    room, T = Room(seed), path(seed, step * count)[::step]
    made = []
    for k in range(count):
        grey, depth = room.render(T[k])
        image, z = Image.from_array(grey), depth.astype(np.float32)
        patches = choose_patches(image.grey, SensedDepth(z, 0.01 * z, z > 0.0), CAMERA, 60)
        made.append(WindowKeyframe(k, k, image.grey, T[k], 0.0, Keyframe.prepare(image, z, CAMERA, levels=1), patches))
    return made


def disturbed(seed: int, count: int) -> Window:
    """A window whose first keyframe is the world, the others a little off."""
    rng = np.random.default_rng(seed)
    window = Window(CAMERA, count)
    for k, keyframe in enumerate(keyframes(seed, count)):
        if k:
            keyframe.T_world_camera = se3.compose(keyframe.T_world_camera, se3.exp(rng.normal(size=6) * 0.01))
            window.add(keyframe, np.eye(6) * 1e-4)
        else:
            window.begin(keyframe, np.eye(6) * 1e-10)
    return window


def test_gradient_is_that_of_the_cost() -> None:
    """By central differences over poses, gains and inverse depths, where all residuals count fully.

    Jacobians use differences of neighbours on both sides, the interpolant has kinks at pixels: that makes some percent.
    """
    frames = keyframes(3, 3)
    rng = np.random.default_rng(0)
    for k in frames:
        k.T_world_camera = se3.compose(k.T_world_camera, se3.exp(rng.normal(size=6) * 0.03))
        k.log_gain = float(0.1 * rng.normal())
        k.patches.rho = k.patches.rho * (1.0 + 0.05 * rng.normal(size=len(k.patches)))
    system = linearize(frames, CAMERA, QUADRATIC, 1.0)

    def cost(which: int, delta: Matrix, of_rho: Matrix | None = None) -> float:
        k = frames[which]
        saved = k.T_world_camera, k.log_gain, k.patches.rho
        k.T_world_camera, k.log_gain = se3.compose(saved[0], se3.exp(delta[:6])), saved[1] + float(delta[6])
        if of_rho is not None:
            k.patches.rho = saved[2] + of_rho
        value = linearize(frames, CAMERA, QUADRATIC, 1.0, with_jacobians=False).cost
        k.T_world_camera, k.log_gain, k.patches.rho = saved
        return value

    h = 1e-5
    for which in range(3):
        numeric = np.array([cost(which, h * e) - cost(which, -h * e) for e in np.eye(DOF)]) / (2.0 * h)
        analytic = system.g[frames[which].block(which)]
        assert np.linalg.norm(numeric - analytic) < 0.15 * np.linalg.norm(numeric)
        direction = rng.normal(size=len(frames[which].patches))
        none = np.zeros(DOF)
        slope = (cost(which, none, h * direction) - cost(which, none, -h * direction)) / (2.0 * h)
        assert system.hosts[which].g_rho @ direction == pytest.approx(slope, rel=0.15)


def test_elimination_is_the_schur_complement() -> None:
    rng = np.random.default_rng(1)
    W, h, f = rng.normal(size=(9, 14)), rng.uniform(0.5, 2.0, 9), rng.normal(size=9)
    h[3] = 0.0  # knows nothing
    A = rng.normal(size=(14, 14))
    H, g = A @ A.T + 100.0 * np.eye(14), rng.normal(size=14)
    reduced, gradient = H.copy(), g.copy()
    eliminate(W, h, f, reduced, gradient)
    known = h > 0.0
    np.testing.assert_allclose(reduced, H - W[known].T @ (W[known] / h[known, None]), rtol=1e-12)
    np.testing.assert_allclose(gradient, g - W[known].T @ (f[known] / h[known]), rtol=1e-12)


@pytest.mark.parametrize("seed", [0, 1])
def test_adjustment_brings_disturbed_keyframes_back(seed: int) -> None:
    window = disturbed(seed, 4)
    true = path(seed, 12)[::3]
    off = [
        np.linalg.norm(se3.log(se3.compose(se3.inverse(T), k.T_world_camera)))
        for T, k in zip(true, window.keyframes, strict=True)
    ]
    found = window.adjust(20, 1e-6)
    window.adjust(20, 1e-6)  # with the σ of where the first one came to
    left = [
        np.linalg.norm(se3.log(se3.compose(se3.inverse(T), k.T_world_camera)))
        for T, k in zip(true, window.keyframes, strict=True)
    ]
    assert found.cost < found.cost_before
    assert max(left) < 0.4 * max(off)
    for keyframe in window.keyframes:
        assert abs(keyframe.log_gain) < 0.02


def test_marginal_is_that_of_the_whole_quadratic() -> None:
    """At first estimates the prior's minimum and curvature are those of what left, minimised over it."""
    window = disturbed(2, 4)
    window.sigma = 20.0
    for keyframe in window.keyframes:
        keyframe.freeze()
    H, g = linearize(window.keyframes, CAMERA, window.sigma, window.spread, hosts=[0]).reduced()
    H, g = H + window.H_prior, g + window.g_prior
    window._marginalize(0)
    b = slice(DOF, None)
    whole = np.linalg.inv(H)
    np.testing.assert_allclose(
        np.linalg.pinv(window.H_prior, hermitian=True), whole[b, b], rtol=1e-5, atol=1e-5 * whole[b, b].max()
    )
    np.testing.assert_allclose(-np.linalg.lstsq(window.H_prior, window.g_prior)[0], -(whole @ g)[b], rtol=1e-4, atol=1e-8)
    assert len(window.keyframes) == 3


def test_prior_knows_nothing_of_where_the_world_is() -> None:
    """Without an anchor, after five marginalisations at poses that moved on: all poses moved alike cost nothing."""
    window = disturbed(4, 9)
    every, window.keyframes = window.keyframes, []
    window.size, window.H_prior, window.g_prior = 4, np.zeros((0, 0)), np.zeros(0)
    window._covariance = np.zeros((0, 0))
    for keyframe in every:
        keyframe.first = None
        window.add(keyframe, np.eye(6))
        window.H_prior[-1, -1] = 0.0
        if len(window.keyframes) > 1:
            window.sigma = 5.0
            system = window._linearize()
            window._step(system, 1.0)
    assert len(window.keyframes) == 4
    motions = np.vstack([np.vstack([se3.adjoint(se3.inverse(k.first_pose)), np.zeros((1, 6))]) for k in window.keyframes])
    known = window.H_prior[:-DOF, :-DOF] if window.keyframes[-1].first is None else window.H_prior
    moved = known @ motions[: len(known)]
    assert np.linalg.norm(known) > 1.0
    assert np.linalg.norm(moved) < 1e-6 * np.linalg.norm(known)


def test_the_keyframe_nobody_sees_leaves_first() -> None:
    window = disturbed(5, 4)
    window.adjust(2)
    window._visible[2] = 0.0
    window.size = 4
    coming = keyframes(5, 5)[-1]
    window.add(coming, np.eye(6) * 1e-4)
    assert [k.number for k in window.keyframes] == [0, 1, 3, 4]
    assert window.covariance(coming) == pytest.approx(np.eye(6) * 1e-4)


def test_pixels_of_a_patch_lie_on_its_plane() -> None:
    grey, depth = Room(6).render(path(6, 30)[-1])
    z = depth.astype(np.float32)
    patches = choose_patches(grey.astype(np.float32), SensedDepth(z, 0.01 * z, z > 0.0), CAMERA, 100)
    u, v = patches.pixels.astype(int).T
    of_pattern = patches.pixels[:, None, :].astype(int) + np.array(DSO_PATTERN)
    true = depth[v, u][:, None] / depth[of_pattern[..., 1], of_pattern[..., 0]]
    assert np.abs(true - 1.0).max() > 1e-3  # walls are seen at an angle
    assert np.median(np.abs(patches.tilt - true).max(axis=1)) < 1e-5


def test_rows_of_a_pair_are_those_of_its_two_keyframes() -> None:
    rng = np.random.default_rng(4)
    rows, adjoint, total = rng.normal(size=(9, 7)), rng.normal(size=(6, 6)), rng.normal(size=(9, 21))
    expected = total.copy()
    expected[:, 14:20] += 0.3 * rows[:, :6] @ adjoint
    expected[:, 20] -= 0.3 * rows[:, 6]
    expected[:, 0:6] -= 0.3 * rows[:, :6]
    expected[:, 6] += 0.3 * rows[:, 6]
    add_rows(rows, adjoint, 0.3, 14, 0, total)
    np.testing.assert_allclose(total, expected, atol=1e-14)
