"""Lines from segments: exact ones come back, noise stays noise, and what cannot be had is named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.formats.reconstructions.vgg_lines import VggLines
from boxplus.systems.bundle_adjustment.line_triangulation import LineTriangulation, triangulate_lines
from tests.systems.bundle_adjustment.line_scenes import house, looking, seen


def triangulated(data: VggLines, sigma_px: float = 0.2) -> LineTriangulation:
    count = len(data.end_points_world)
    return triangulate_lines(data.K, data.T_camera_world, data.segments, data.view_of, data.line_of, count, sigma_px)


def apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Largest distance (L,) of the ends of one from the lines through the ends of the other, both (L, 6)."""
    d = other[:, 3:] - other[:, :3]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    off = [np.linalg.norm(np.cross(one[:, k : k + 3] - other[:, :3], d), axis=1) for k in (0, 3)]
    return np.max(off, axis=0)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_exact_segments_give_exact_lines_and_their_ends(seed: int) -> None:
    data = house(seed, noise_px=0.0)
    found = triangulated(data, 1e-6)
    assert found.found.all() and not found.notes()
    assert apart(found.end_points_world, data.end_points_world).max() < 1e-8
    ends = np.sort(found.end_points_world.reshape(-1, 2, 3), axis=1) - np.sort(data.end_points_world.reshape(-1, 2, 3), axis=1)
    assert np.abs(ends).max() < 1e-7


def test_noise_makes_errors_of_its_own_size() -> None:
    """A pixel is 1/600 of the distance of 10 m; seven views and segments of a metre or more."""
    errors = []
    for seed in range(10):
        data = house(seed, noise_px=0.3)
        found = triangulated(data, 0.3)
        errors.append(apart(found.end_points_world[found.found], data.end_points_world[found.found]))
        assert found.found.mean() > 0.6
    assert 1e-4 < np.median(np.concatenate(errors)) < 0.03


@pytest.mark.parametrize("seed", range(5))
def test_cameras_that_move_along_a_line_do_not_determine_it(seed: int) -> None:
    random = np.random.default_rng(seed)
    places = np.column_stack([np.linspace(-2.0, 2.0, 6), np.full(6, -8.0), np.full(6, 1.0)])
    poses = looking(places, np.array([0.0, 0.0, 0.5]))
    level = np.array([-1.5, 0.5, 0.2, 1.5, 0.5, 0.2])  # along the motion, beside it
    aimed = np.array([0.5, 0.4, 1.0, 2.4, 3.0, 1.0])  # in the plane of the cameras' way
    upright = np.array([0.3, 0.2, -1.0, 0.3, 0.2, 1.4])
    data = seen(poses, np.stack([level, aimed, upright]), np.zeros((0, 3)), 0.3, seed)
    found = triangulated(data, 0.3)
    assert found.states == ("along the line", "along the line", "found")
    (note,) = found.notes()
    assert note.startswith("2 lines are not determined, seen from cameras that move along them") and note.endswith(": 0, 1")
    assert np.isnan(found.lines[:2]).all() and found.angle[0] < 3.0 * found.angle_std[0]
    # A camera above the way of the others determines them.
    above = looking(np.vstack([places, [random.uniform(-1, 1), -7.0, 3.5]]), np.array([0.0, 0.0, 0.5]))
    assert triangulated(seen(above, data.end_points_world, np.zeros((0, 3)), 0.3, seed), 0.3).found.all()


def test_other_reasons_are_named() -> None:
    data = house(3, noise_px=0.1)
    once = data.line_of == 2
    once &= data.view_of > 0
    kept = ~once
    mixed = data.segments.copy()
    mixed[(data.line_of == 5) & (data.view_of == 3)] = [100.0, 50.0, 120.0, 300.0]
    count = len(data.end_points_world)
    found = triangulate_lines(data.K, data.T_camera_world, mixed[kept], data.view_of[kept], data.line_of[kept], count + 1, 0.1)
    assert found.states[2] == "one view" and found.states[count] == "one view" and found.states[5] in ("disagrees", "behind")
    assert any("one view only" in note for note in found.notes())
    behind = data.T_camera_world.copy()
    behind[:, 4:] *= -1.0
    assert set(triangulate_lines(data.K, behind, data.segments, data.view_of, data.line_of, count, 0.1).states) == {"behind"}
    assert found.notes(("behind",)) == [note for note in found.notes() if "behind" in note]


def test_wrong_arrays_are_refused() -> None:
    data = house(0)
    with pytest.raises(InputError, match=r"K \(V, 3, 3\), T_camera_world \(V, 7\), segments \(N, 4\)"):
        triangulate_lines(data.K[:2], data.T_camera_world, data.segments, data.view_of, data.line_of, 15)
    with pytest.raises(InputError, match="views from 0 to 6 and lines from 0 to 9 – got an index beyond them"):
        triangulate_lines(data.K, data.T_camera_world, data.segments, data.view_of, data.line_of, 10)
