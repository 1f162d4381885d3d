"""Files that mean something else than their format says: refused or named by what their start explains."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import boxplus as bp
from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, se3, so3
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.doubts.readings import reading_doubt
from tests.small_problems import scene
from tests.systems.bundle_adjustment.scenes import FOCAL, FORMATS, perturbed, reconstruction, turning


def inverted(start: Reconstruction) -> Reconstruction:
    """Poses from camera to world, where the format has them from world to camera."""
    if not isinstance(start, BalProblem):
        return replace(start, T_camera_world=se3.inverse(start.T_camera_world))
    cameras = start.cameras.copy()
    cameras[:, :3] *= -1.0
    cameras[:, 3:6] = -np.einsum("nij,nj->ni", so3.exp(cameras[:, :3]), start.cameras[:, 3:6])
    return replace(start, cameras=cameras)


@pytest.mark.parametrize("format", FORMATS)
def test_inverted_poses_are_refused_by_name(format):
    for seed in range(100, 108):
        start = reconstruction(seed, format)
        with pytest.raises(InputError, match=r"if the poses are inverted.*give poses from world to camera, R → Rᵀ"):
            adjust_bundle(inverted(start))
        assert adjust_bundle(start).doubt is None


@pytest.mark.parametrize("name", ["trafalgar-21-11315-pre", "dubrovnik-16-22106-pre", "ladybug-49-7776-pre"])
def test_published_sets_with_inverted_poses_are_refused(name, shared_data):
    start = bp.formats.read_bal(shared_data / "bal" / f"{name}.txt.bz2")
    with pytest.raises(InputError, match="if the poses are inverted"):
        adjust_bundle(inverted(start))


@pytest.mark.parametrize("format", ["gbp", "colmap"])
def test_quaternions_in_another_order_are_refused_by_name(format):
    start = reconstruction(100, format)
    T = start.T_camera_world.copy()
    T[:, :4] = T[:, [1, 2, 3, 0]]
    with pytest.raises(InputError, match="if the quaternions have another order"):
        adjust_bundle(replace(start, T_camera_world=T))


def test_rotations_in_degrees_and_points_in_millimetres_are_refused_by_name():
    start = reconstruction(100, "bal")
    cameras = start.cameras.copy()
    cameras[:, :3] = np.degrees(cameras[:, :3])
    with pytest.raises(InputError, match=r"if the rotations are in degrees.*give them in radians"):
        adjust_bundle(replace(start, cameras=cameras))
    with pytest.raises(InputError, match=r"if the points are 0\.001 times as large.*in the same unit"):
        adjust_bundle(replace(start, points=1000.0 * start.points))


@pytest.mark.parametrize("format", ["gbp", "colmap"])
@pytest.mark.parametrize("wrong", [0.6, 1.6])
def test_a_focal_length_that_contradicts_the_start_of_two_views_is_not_trusted(format, wrong):
    """Two images hardly tell a focal length; a start that was made with the right one does."""
    for seed in (100, 102):
        start = turning(seed, 0.5, format, cameras=2, points=120)
        lens = np.array([wrong, wrong, 1.0, 1.0]) * 500.0 * [1.0, 1.0, 0.0, 0.0]
        other = replace(start, intrinsics=lens) if format == "gbp" else replace(start, camera_params=(lens,))
        told = adjust_bundle(other).doubt
        found = re.search(r"with a focal length (\S+) times as large", told)
        assert float(found[1]) == pytest.approx(1.0 / wrong, rel=0.03)
        assert adjust_bundle(start).doubt is None


@pytest.mark.parametrize("format", ["gbp", "colmap"])
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_pixels_in_units_of_the_focal_length_are_not_trusted(format, seed):
    """Errors of a five-hundredth of a pixel are as large, for such pixels, as they would be without any start."""
    start = reconstruction(seed, format)
    told = adjust_bundle(replace(start, pixels=start.pixels / FOCAL)).doubt or ""
    if seed == 3:  # cameras and points of the start are too rough to tell
        assert "as those of no image do at a focal length of 500 px: give both in pixels" in told
        return
    assert float(re.search(r"with a focal length (\S+) times as large", told)[1]) == pytest.approx(1.0 / FOCAL, rel=0.05)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_a_narrow_view_in_normalised_coordinates_is_in_one_unit(seed):
    """Eight cameras around something 20 m wide, 1 km away: a hundredth of their focal length of one."""
    rng = np.random.default_rng(seed)
    p, angle = rng.uniform(-10.0, 10.0, (100, 3)), np.linspace(-0.4, 0.4, 8)
    R = so3.exp(np.column_stack([np.zeros(8), angle, np.zeros(8)]))
    T = np.hstack([quaternion.from_matrix(R), np.tile([0.0, 0.0, 1000.0], (8, 1))])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:8, :100])
    start = perturbed(rng, T, p, camera_of, point_of, "gbp", 1e-4, 0.05, sigma := 0.01)
    start = replace(start, intrinsics=np.array([1.0, 1.0, 0.0, 0.0]), pixels=start.pixels / FOCAL)
    result = adjust_bundle(start, BundleAdjustmentConfig(sigma_px=sigma / FOCAL))
    assert result.solution.status == "converged" and result.doubt is None


def test_swapped_pixels_of_either_direction_of_y_are_named():
    start = reconstruction(100, "bal")
    for sign in ([1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]):
        told = adjust_bundle(replace(start, pixels=start.pixels[:, ::-1] * sign)).doubt
        assert ("are x and y of the pixels swapped?" in told) == (sign[0] * sign[1] > 0.0)


@pytest.mark.parametrize("format", FORMATS)
def test_other_readings_of_many_observations_are_tried_on_few(format):
    """Of all of them there is at most one copy, that of pixels counted downwards."""
    start = reconstruction(100, format)
    times, of = 400_000 // len(start.pixels), "image_of" if format == "colmap" else "camera_of"
    many = replace(
        start,
        point_of=np.repeat(start.point_of, times),
        pixels=np.repeat(start.pixels[:, ::-1], times, axis=0),
        **{of: np.repeat(getattr(start, of), times)},
    )
    tracemalloc.start()
    told = reading_doubt(many, is_lens_held=format != "bal")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "are x and y of the pixels swapped?" in told
    assert peak < 3 * many.pixels.nbytes


def test_rotations_that_are_noise_about_none_are_not_taken_for_degrees():
    """In degrees they are next to none, and fit as well as none do."""
    rng = np.random.default_rng(0)
    cameras = np.hstack([0.05 * rng.standard_normal((20, 6)), np.tile([500.0, 0.0, 0.0], (20, 1))])
    points = rng.uniform([-1.0, -1.0, -6.0], [1.0, 1.0, -4.0], (100, 3))
    camera_of, point_of = (index.reshape(-1) for index in np.indices((20, 100)))
    pixels = -500.0 * points[point_of, :2] / points[point_of, 2:]
    assert reading_doubt(BalProblem(cameras, points, camera_of, point_of, pixels), is_lens_held=False) is None


COLUMNS = {  # where the numbers of a camera stand in the format
    "rotation, translation, k1, f, k2": [0, 1, 2, 3, 4, 5, 7, 6, 8],
    "rotation, translation, k1, k2, f": [0, 1, 2, 3, 4, 5, 7, 8, 6],
    "rotation, translation, k2, k1, f": [0, 1, 2, 3, 4, 5, 8, 7, 6],
    "translation, rotation, f, k1, k2": [3, 4, 5, 0, 1, 2, 6, 7, 8],
    "f, k1, k2, rotation, translation": [6, 7, 8, 0, 1, 2, 3, 4, 5],
    "f, k1, k2, translation, rotation": [6, 7, 8, 3, 4, 5, 0, 1, 2],
}


def with_distortion(seed: int) -> BalProblem:
    """Seen through a lens with k1 = −0.2 and k2 = 0.05."""
    rng = np.random.default_rng([seed, 3])
    start = perturbed(rng, *scene(seed, 8, 150), "bal", 0.004, 0.02)
    squared = ((start.pixels / FOCAL) ** 2).sum(axis=1, keepdims=True)
    cameras = start.cameras.copy()
    cameras[:, 7:] = [-0.2, 0.05]
    return replace(start, cameras=cameras, pixels=start.pixels * (1.0 - 0.2 * squared + 0.05 * squared**2))


@pytest.mark.parametrize("order", COLUMNS)
def test_the_numbers_of_a_camera_in_another_order_are_refused_by_name(order):
    for seed in range(1, 8, 2):
        start = with_distortion(seed)
        with pytest.raises(InputError, match=f"if the numbers of a camera are {order}.*BAL has rotation"):
            adjust_bundle(replace(start, cameras=start.cameras[:, COLUMNS[order]]))
        assert adjust_bundle(start).doubt is None


def test_focal_lengths_in_image_widths_are_refused_and_rough_ones_adjusted():
    for seed in range(1, 8, 2):
        start = with_distortion(seed)
        cameras = start.cameras.copy()
        cameras[:, 6] = FOCAL / 640.0
        with pytest.raises(InputError, match=r"with focal lengths \S+ times as large.*f \[px\]"):
            adjust_bundle(replace(start, cameras=cameras))
        best = adjust_bundle(start)
        for rough in (0.1, 0.25, 0.7):  # degrees, 65 here, are no rougher
            cameras[:, 6] = rough * FOCAL
            found = adjust_bundle(replace(start, cameras=cameras))
            assert found.doubt is None
            assert found.solution.cost == pytest.approx(best.solution.cost, rel=1e-6)


def test_focal_lengths_that_are_not_positive_are_refused_as_such_where_no_order_explains_them():
    start = reconstruction(1, "bal")
    cameras = start.cameras.copy()
    cameras[3, 6] *= -1.0
    with pytest.raises(InputError, match="expected positive focal lengths"):
        adjust_bundle(replace(start, cameras=cameras))
