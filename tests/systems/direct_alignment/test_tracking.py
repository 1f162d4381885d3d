"""Keyframes and what is tracked against them: derivatives, the kernel against NumPy, brightness, and verdicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.cameras.distortion import RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.optimization.losses import Huber
from boxplus.residuals.camera.photometric_sampling import sample
from boxplus.systems.direct_alignment.alignment_kernel import linearize
from boxplus.systems.direct_alignment.keyframe import Keyframe, Level
from boxplus.systems.direct_alignment.tracking import Alignment, track
from tests.systems.direct_alignment.test_direct_alignment import CAMERA, degrees_and_metres, read_png, textured_plane

MOTION = se3.exp(np.array([0.02, -0.02, 0.01, 0.05, -0.03, 0.04]))
LENS = RadialTangential(0.2, -0.3, 0.002, -0.003, 0.1)


def level_at(seed: int, camera: Pinhole = CAMERA) -> tuple[NDArray[np.float32], Level]:
    """Image 1 and its finest level."""
    first, depth, _ = textured_plane(seed, MOTION)
    return first, Keyframe.prepare(first, depth, camera, levels=2, points=400).levels[-1]


def points_of(level: Level) -> NDArray[np.float64]:
    return np.column_stack([level.rays, np.ones(len(level.rays))]) / level.inverse_depth[:, None]


@pytest.mark.parametrize("camera", [CAMERA, Pinhole(100.0, 104.0, 79.5, 59.5, LENS)], ids=["pinhole", "distorted"])
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5, deadline=None)
def test_jacobians_are_central_differences(camera: Pinhole, seed: int) -> None:
    """Of image 1 made linear around each pixel by its own central differences, as the keyframe is moved."""
    first, level = level_at(seed % 7, camera)
    u, v = level.pixels.astype(int).T
    left, right = np.maximum(u - 1, 0), np.minimum(u + 1, first.shape[1] - 1)
    above, below = np.maximum(v - 1, 0), np.minimum(v + 1, first.shape[0] - 1)
    slope = np.column_stack(
        [(first[v, right] - first[v, left]) / (right - left), (first[below, u] - first[above, u]) / (below - above)]
    ).astype(np.float64)

    def grey(xi: NDArray[np.float64]) -> NDArray[np.float64]:
        moved, _ = camera.project(se3.act(se3.exp(xi), points_of(level)))
        return ((moved - level.pixels) * slope).sum(axis=1)

    direction = np.random.default_rng(seed).normal(size=6)
    h = 1e-5
    numeric = (grey(h * direction) - grey(-h * direction)) / (2.0 * h)
    np.testing.assert_allclose(level.J @ direction, numeric, atol=1e-6 * np.abs(numeric).max())


def test_kernel_is_the_weighted_sum_it_should_be() -> None:
    """Against NumPy: residuals, H and g of Huber's weights, at a pose where some pixels leave the image."""
    _, level = level_at(1)
    _, _, second = textured_plane(1, MOTION)
    T_21 = se3.exp(np.array([0.1, 0.2, -0.1, 0.3, 0.0, 0.1]))
    gain, offset, sigma, loss = 1.1, -3.0, 20.0, Huber(1.345)
    e, H, g = np.empty(len(level.grey)), np.empty((8, 8)), np.empty(8)
    count, cost, total, weights = linearize(
        T_21, gain, offset, level.rays, level.inverse_depth, level.grey, level.J, level.share, second,
        level.intrinsics, 0.0, loss.code, loss.scale, sigma, e, H, g,
    )  # fmt: skip
    pixels, _ = CAMERA.project(se3.act(T_21, points_of(level)))
    value, _, seen = sample(second, pixels)
    assert 0.5 * len(seen) < count == np.count_nonzero(seen) < len(seen)
    r = level.grey[seen] - gain * value[seen] - offset
    np.testing.assert_allclose(e[:count], r, atol=1e-9)
    w = np.minimum(1.0, loss.scale * sigma / np.abs(r))
    assert 0.1 < (w < 1.0).mean() < 0.9
    w *= level.share[seen]
    rows = np.column_stack([level.J, level.grey, np.ones(len(level.grey))])[seen]
    np.testing.assert_allclose(H, rows.T @ (w[:, None] * rows) / sigma**2, rtol=1e-9, atol=1e-9 * H.max())
    np.testing.assert_allclose(g, rows.T @ (w * r) / sigma**2, rtol=1e-9, atol=1e-9 * np.abs(g).max())
    assert total == pytest.approx(np.abs(r).sum()) and weights == pytest.approx(w.sum()) and cost > 0.0


def test_steep_pixels_count_less() -> None:
    first, level = level_at(3)
    steepness = np.hypot(*np.gradient(first.astype(np.float64)))
    u, v = level.pixels.astype(int).T
    square = steepness[v, u] ** 2
    np.testing.assert_allclose(level.share, square.mean() / (square.mean() + square), rtol=1e-4)
    assert (level.share * square).max() < square.mean()  # what a pixel can outweigh


def test_selected_pixels_are_spread_and_steep() -> None:
    first, depth, _ = textured_plane(2, MOTION)
    depth[:, 100:] *= 1.5  # a step
    depth[:40, :40] = 0.0
    level = Keyframe.prepare(first, depth, CAMERA, levels=1, points=300).levels[0]
    u, v = level.pixels.astype(int).T
    assert 200 < len(u) <= 330 and (depth[v, u] > 0.0).all() and not np.isin(u, (99, 100)).any()
    cell = int(np.ceil(np.sqrt(np.count_nonzero(depth) / 300)))
    assert len(np.unique(v // cell * 1000 + u // cell)) == len(u)  # one a cell
    steepness = np.hypot(*np.gradient(first))
    assert steepness[v, u].mean() > 1.3 * steepness[depth > 0.0].mean()


@given(st.floats(0.7, 1.3), st.floats(-20.0, 20.0), st.integers(0, 4))
@settings(max_examples=6, deadline=None)
def test_brightness_does_not_move_the_pose(gain: float, offset: float, seed: int) -> None:
    first, depth, second = textured_plane(seed, MOTION)
    keyframe = Keyframe.prepare(first, depth, CAMERA, levels=4)
    plain, found = track(keyframe, second), track(keyframe, gain * second + np.float32(offset))
    degrees, metres = degrees_and_metres(found.T_21, MOTION)
    assert found.status == "converged" and found.reason == "" and degrees < 0.02 and metres < 1e-3
    # I₁ = eᵃ (gain I₂ + offset) + b
    (a, b), (a_plain, b_plain) = found.brightness, plain.brightness
    assert gain * np.exp(a) == pytest.approx(np.exp(a_plain), rel=2e-3)
    assert b + np.exp(a) * offset == pytest.approx(b_plain, abs=0.2)
    assert np.exp(a_plain) == pytest.approx(1.0, abs=0.03)  # not exactly: the two are sampled differently


def test_a_keyframe_is_used_again_and_left_as_it_was() -> None:
    first, depth, second = textured_plane(3, MOTION)
    keyframe = Keyframe.prepare(first, depth, CAMERA, levels=3)
    one = track(keyframe, second)
    track(keyframe, first)
    start = MOTION.copy()
    again = track(keyframe, second, T_21=start)
    assert np.array_equal(track(keyframe, second).T_21, one.T_21) and np.array_equal(start, MOTION)
    assert degrees_and_metres(again.T_21, one.T_21)[0] < 5e-3


def told(found: Alignment, status: str, words: str) -> bool:
    return found.status == status and words in found.reason and np.isnan(found.covariance).all()


@pytest.mark.parametrize("seed", range(5))
def test_what_cannot_be_trusted_is_flagged(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, depth, _ = textured_plane(seed, MOTION)
    keyframe = Keyframe.prepare(first, depth, CAMERA, levels=3)
    elsewhere, _, _ = textured_plane(seed + 100, MOTION)
    assert told(track(keyframe, elsewhere), "large residual", "something else")
    assert track(keyframe, elsewhere).shift_px > 1.0 > 0.5 > track(keyframe, first).shift_px
    assert told(track(keyframe, np.full_like(first, 90.0) + rng.normal(size=first.shape)), "large residual", "differ by")
    away = track(keyframe, first, T_21=[1.0, 0.0, 0.0, 0.0, 8.0, 0.0, 0.0])
    assert told(away, "little overlap", "of the keyframe land in the image") and away.overlap < 0.2
    # Noisy stripes: sliding along them changes grey values by noise only.
    phase = 0.2 * np.arange(160) + rng.uniform(0.0, 6.0)
    one, other = (100.0 + 40.0 * np.sin(phase) + rng.normal(size=(120, 160)) * 2.0 for _ in range(2))
    assert told(track(Keyframe.prepare(one, depth, CAMERA, levels=1, points=None), other), "unobservable", "along one direction")


def test_refusals() -> None:
    first, depth, _ = textured_plane(6, MOTION)
    keyframe = Keyframe.prepare(first, depth, CAMERA, levels=2)
    with pytest.raises(InputError, match="two images of the same shape"):
        track(keyframe, first[1:])
    with pytest.raises(InputError, match="max_iterations at least 1"):
        track(keyframe, first, max_iterations=0)
    with pytest.raises(InputError, match="at least 100 points a level – got 99"):
        Keyframe.prepare(first, depth, CAMERA, points=99)
    with pytest.raises(InputError, match="image finite"):
        track(keyframe, np.full_like(first, np.nan))
    rough = np.where(np.add.outer(np.arange(120), np.arange(160)) % 2 == 0, 1.0, 2.0)
    with pytest.raises(InputError, match="not at steps of the depth"):
        Keyframe.prepare(first, rough, CAMERA, levels=1)


def test_recorded_neighbours_agree_with_their_composition(shared_data: Path) -> None:
    """Three frames of a recorded sweep: 10 → 12 → 14 leads where 10 → 14 does, which is near the pose given."""
    folder = shared_data / "rgbd" / "7scenes_60"

    def frame(i: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
        depth = read_png(folder / f"frame-{i:06d}.depth.png") / np.float32(1000.0)
        depth[depth > 10.0] = 0.0  # 65.535 m: none
        T = np.loadtxt(folder / f"frame-{i:06d}.pose.txt")
        return read_png(folder / f"frame-{i:06d}.color.jpg"), depth, np.concatenate([quaternion.from_matrix(T[:3, :3]), T[:3, 3]])

    frames, camera = {i: frame(i) for i in (10, 12, 14)}, Pinhole(585.0, 585.0, 320.0, 240.0)
    keyframes = {i: Keyframe.prepare(frames[i][0], frames[i][1], camera) for i in (10, 12)}
    found = {(i, j): track(keyframes[i], frames[j][0]) for i, j in ((10, 12), (12, 14), (10, 14))}
    assert all(alignment.status == "converged" for alignment in found.values())
    T_true = se3.compose(se3.inverse(frames[14][2]), frames[10][2])
    degrees, metres = degrees_and_metres(found[10, 14].T_21, T_true)
    assert degrees < 0.1 and metres < 0.005
    degrees, metres = degrees_and_metres(se3.compose(found[12, 14].T_21, found[10, 12].T_21), found[10, 14].T_21)
    assert degrees < 0.1 and metres < 0.005


def test_a_start_of_the_brightness_is_followed() -> None:
    """An image much darker than the keyframe, a part of which is bright and without texture."""
    first, depth, second = textured_plane(2, MOTION)
    keyframe = Keyframe.prepare(first, depth, CAMERA, levels=3)
    dark = 0.3 * second + 20.0
    dark[:20] = 250.0
    found = track(keyframe, dark, light=(float(-np.log(0.3)), -20.0 / 0.3))
    assert found.status == "converged"
    assert found.brightness[0] == pytest.approx(-np.log(0.3), abs=0.05)
    assert degrees_and_metres(found.T_21, MOTION)[0] < 0.3
