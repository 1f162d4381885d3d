"""The alignment finds the transform, is never a reflection, and refuses positions that do not determine it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.evaluation.alignment import align
from tests.evaluation.smooth_paths import SmoothPath, moved


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100.0), flat=st.booleans())
def test_a_known_transform_is_found(seed: int, scale: float, flat: bool) -> None:
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(20, 3)) * ([5.0, 5.0, 0.0] if flat else 5.0)
    R, p = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 100
    for kind, s in (("se3", 1.0), ("sim3", scale)):
        x = (y - p) @ R / s  # y = s R x + p
        found = align(x, y, kind)
        np.testing.assert_allclose(found.R_world_estimate, R, atol=1e-9)
        np.testing.assert_allclose(found.p_world_estimate, p, atol=1e-7)
        assert found.scale == pytest.approx(s, rel=1e-9)
        assert not found.mirrored


@pytest.mark.parametrize("seed", range(5))
def test_no_other_transform_fits_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(15, 3)), rng.normal(size=(15, 3))  # nothing alike: the guard against reflections matters
    found = align(x, y, "sim3")
    assert np.linalg.det(found.R_world_estimate) == pytest.approx(1.0)

    def cost(parameters: np.ndarray) -> float:
        R = Rotation.from_rotvec(parameters[:3]).as_matrix()
        return float(np.sum((y - np.exp(parameters[6]) * x @ R.T - parameters[3:6]) ** 2))

    ours = float(np.sum((y - found.scale * x @ found.R_world_estimate.T - found.p_world_estimate) ** 2))
    best = min(minimize(cost, np.r_[Rotation.random(rng=rng).as_rotvec(), np.zeros(3), -1.0]).fun for _ in range(12))
    assert ours <= best + 1e-6


def test_a_mirror_image_is_noticed_and_not_used() -> None:
    y = np.random.default_rng(0).normal(size=(30, 3))
    found = align(y * [1, 1, -1], y)
    assert found.mirrored
    assert np.linalg.det(found.R_world_estimate) == pytest.approx(1.0)


def test_positions_on_a_line_or_in_one_place_are_refused() -> None:
    line = np.linspace(0, 70, 50)[:, None] * np.array([0.6, 0.8, 0.0])
    random = np.random.default_rng(0).normal(size=(50, 3))
    with pytest.raises(InputError, match=r"ground truth positions off one line, .* rotation about that line is undetermined"):
        align(random, line)
    with pytest.raises(InputError, match=r"estimate positions off one line"):
        align(line + 1e-3 * random, random)
    with pytest.raises(InputError, match=r"ground truth positions that differ, .* rotation undetermined – compare with"):
        align(random, np.ones((50, 3)))
    with pytest.raises(InputError, match="at least three matched positions"):
        align(random[:2], random[:2])
    with pytest.raises(InputError, match=r"matched positions of shape \(M, 3\)"):
        align(random, random[:3])
    assert align(random, line, "none").scale == 1.0


@given(seed=st.integers(0, 100))
@settings(max_examples=10, deadline=None)
def test_apply_moves_poses_as_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = SmoothPath(seed).sample(np.arange(0.0, 20.0, 0.5))
    other = moved(path, Rotation.random(rng=rng), rng.normal(size=3), 2.0)
    back = align(other.p, path.p, "sim3").apply(other)
    np.testing.assert_allclose(back.p, path.p, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(back.q_wxyz * path.q_wxyz, axis=1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_no_other_heading_and_shift_fit_better(seed: int) -> None:
    """Brute force over the heading; the best shift for each is the difference of the means."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(15, 3)) * [3.0, 2.0, 1.0], rng.normal(size=(15, 3)) + 4.0
    found = align(x, y, "yaw")
    ours = float(np.sum((y - x @ found.R_world_estimate.T - found.p_world_estimate) ** 2))
    turned = Rotation.from_rotvec(np.linspace(0.0, 2.0 * np.pi, 3600)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    centred = np.einsum("kij,nj->kni", turned, x - x.mean(axis=0))
    assert ours <= ((y - y.mean(axis=0) - centred) ** 2).sum(axis=(1, 2)).min() + 1e-9
    np.testing.assert_allclose(found.R_world_estimate[2], [0.0, 0.0, 1.0])


@settings(max_examples=30, deadline=None)
@given(angle=st.floats(-3.1, 3.1), seed=st.integers(0, 1000))
def test_a_known_heading_is_found_also_along_a_line(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    line = np.linspace(0.0, 5.0, 20)[:, None] * np.array([0.6, 0.7, 0.1]) + rng.normal(size=3)
    R = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    found = align(line, line @ R.T + [1.0, 2.0, 3.0], "yaw")
    np.testing.assert_allclose(found.R_world_estimate, R, atol=1e-9)
    np.testing.assert_allclose(found.p_world_estimate, [1.0, 2.0, 3.0], atol=1e-8)


def test_a_tilt_is_no_heading_and_a_vertical_has_none() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(20, 3))
    tilted = x @ Rotation.from_euler("x", 5.0, degrees=True).as_matrix().T
    found = align(x, tilted, "yaw")
    assert np.sqrt(np.mean(np.sum((tilted - x @ found.R_world_estimate.T - found.p_world_estimate) ** 2, axis=1))) > 0.05
    with pytest.raises(InputError, match="differ horizontally, to align the heading"):
        align(np.outer(np.arange(5.0), [0.0, 0.0, 1.0]), x[:5], "yaw")
