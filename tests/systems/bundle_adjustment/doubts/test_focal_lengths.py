"""Focal lengths that were to be found: told where the images do not tell them, in every format, and left alone where they do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import boxplus as bp
from boxplus.cli import app
from boxplus.formats.reconstructions.bal import write_bal
from boxplus.manifolds import quaternion, so3
from boxplus.optimization.losses import Huber
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.doubts.focal_lengths import focal_lengths
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction
from tests.systems.bundle_adjustment.scenes import FOCAL, perturbed, reconstruction

TOLD = "the images do not tell the focal length"
REFINED = BundleAdjustmentConfig(intrinsics="refined")


def strip(seed: int, format: str, sigma: float = 0.5, relief_m: float = 0.02, wander: float = 1.0):
    """Eight images from 8 m above ground that is level to 2 cm: a longer lens from higher up sees the same.

    Without `wander` they look straight down, all from one height.
    """
    rng = np.random.default_rng([seed, 40])
    p = np.column_stack([rng.uniform(-3.0, 11.0, 200), rng.uniform(-3.0, 3.0, 200), relief_m * rng.standard_normal(200)])
    center = np.column_stack([np.arange(8.0), 0.1 * rng.standard_normal(8), 8.0 + 0.1 * wander * rng.standard_normal(8)])
    R = so3.exp(0.03 * wander * rng.standard_normal((8, 3))) * np.array([1.0, -1.0, -1.0])
    T = np.hstack([quaternion.from_matrix(R), -np.einsum("nij,nj->ni", R, center)])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:8, :200])
    near = np.abs(p[point_of, 0] - center[camera_of, 0]) < 4.0
    return perturbed(rng, T, p, camera_of[near], point_of[near], format, 0.01, 0.05, sigma)


@pytest.mark.parametrize("seed", [3, 5, 9])
def test_a_strip_over_level_ground_with_own_lenses_is_not_to_be_trusted(seed):
    result = adjust_bundle(strip(seed, "bal", sigma=1.5))
    assert result.solution.status == "converged"
    assert np.abs(result.reconstruction.cameras[:, 6] / FOCAL - 1.0).max() > 0.05  # though errors are those of the noise
    assert result.doubt.startswith(f"{TOLD}s of 8 of 8 cameras (") and "a file with one line fx fy cx cy" in result.doubt


def test_it_is_trusted_with_lenses_that_are_held():
    for format in ("gbp", "colmap"):
        result = adjust_bundle(strip(1, format))
        assert result.doubt is None and not any(TOLD in note for note in result.notes)


def test_a_refined_lens_of_colmap_is_asked_as_well():
    result = adjust_bundle(strip(1, "colmap", sigma=3.0), REFINED)
    assert (
        result.doubt.startswith(f"{TOLD} of 1 of 1 camera (3): standard deviations of") and "--refine-intrinsics" in result.doubt
    )
    assert "share one" not in result.doubt


@pytest.mark.parametrize("format", ["bal", "colmap"])
@pytest.mark.parametrize("sigma", [0.0, 1e-4, 1e-2])
def test_exact_images_of_a_plane_do_not_tell_them_either(format, sigma):
    """What nothing tells is not known the better for small errors: the start decides."""
    result = adjust_bundle(strip(1, format, sigma, relief_m=0.0, wander=0.0), REFINED)
    assert result.doubt is not None and result.doubt.startswith(TOLD)


@pytest.mark.parametrize("sigma", [0.0, 1e-4, 1e-2])
def test_exact_images_from_all_around_do(sigma):
    for format in ("bal", "colmap"):
        start = reconstruction(3, format, sigma=sigma)
        result = adjust_bundle(start, REFINED)
        assert result.doubt is None and not any("focal" in note for note in result.notes)


@pytest.mark.parametrize("format", ["bal", "colmap"])
@pytest.mark.parametrize("seed", [1, 3])
def test_images_from_all_around_tell_them(format, seed):
    for loss in (None, Huber(1.345)):
        result = adjust_bundle(reconstruction(seed, format), REFINED, loss=loss)
        assert result.doubt is None and not any(TOLD in note for note in result.notes)


def test_one_camera_that_sees_little_is_named_in_a_note():
    start = reconstruction(5, "bal")
    rng = np.random.default_rng(6)
    few = rng.permutation(np.flatnonzero(start.camera_of == 3))[6:]
    keep = np.setdiff1d(np.arange(len(start.pixels)), few)
    part = replace(start, camera_of=start.camera_of[keep], point_of=start.point_of[keep], pixels=start.pixels[keep])
    result = adjust_bundle(part)
    told = [note for note in result.notes if TOLD in note]
    assert result.doubt is None and len(told) == 1 and " of 1 of 8 cameras (3): " in told[0]


def deviations(start, noise: float) -> np.ndarray:
    """Of the focal lengths, with errors of so much noise at the start, as if it were the solution."""
    problem = bp.Problem()
    used = np.ones(len(start.pixels), dtype=np.bool_)
    add_reconstruction(problem, start, used, BundleAdjustmentConfig(), None)
    solution = problem.solve(max_iterations=0)
    errors = np.full(len(start.pixels), 1.1774 * noise)
    known = focal_lengths(start, used, np.zeros(0, np.int64), BundleAdjustmentConfig(), None, errors, solution, 2 * len(errors))
    return known.deviations


def test_they_are_those_of_all_cameras_and_points_together():
    """The pseudo-inverse of the dense normal matrix, in which what no image tells is left out."""
    start = strip(7, "bal")
    problem = bp.Problem()
    cameras, points = add_reconstruction(problem, start, np.ones(len(start.pixels), np.bool_), BundleAdjustmentConfig(), None)
    group = problem.groups[0]
    group.linearize([block.values for block in problem.blocks], 1)
    (Jc, Jp), m = group.jacobians, len(cameras)
    J = np.zeros((len(Jc), 2, 9 * m + 3 * len(points)))
    for n, (camera, point) in enumerate(zip(start.camera_of, start.point_of, strict=True)):
        J[n, :, 9 * camera : 9 * camera + 9] = Jc[n]
        J[n, :, 9 * m + 3 * point : 9 * m + 3 * point + 3] = Jp[n]
    J = J.reshape(-1, J.shape[2])
    J = J[:, (J != 0.0).any(axis=0)]  # points that no image sees
    size = np.linalg.norm(J, axis=0)
    _, s, Vt = np.linalg.svd(J / size, full_matrices=False)
    told = s > 1e-9 * s[0]  # but for the whole scene, and the depth of points that one image sees
    P = (Vt[told].T / s[told] ** 2) @ Vt[told] / np.outer(size, size)
    f = 9 * np.arange(m) + 6
    np.testing.assert_allclose(deviations(start, 0.5), 0.5 * np.sqrt(P[f, f]) / start.cameras[:, 6], rtol=3e-2)


def test_neither_unit_nor_place_of_the_scene_matters():
    start = strip(9, "bal")
    usual = deviations(start, 0.5)
    for unit, place in ((1e3, 0.0), (1e-3, 0.0), (1.0, 1e4)):
        cameras = start.cameras.copy()
        cameras[:, 3:6] = unit * cameras[:, 3:6] - so3.exp(cameras[:, :3]) @ np.full(3, place)
        other = replace(start, cameras=cameras, points=unit * start.points + place)
        np.testing.assert_allclose(deviations(other, 0.5), usual, rtol=1e-2)


def test_the_exit_code_says_so(tmp_path):
    write_bal(tmp_path / "strip.txt", strip(3, "bal", sigma=1.5))
    run = CliRunner().invoke(app, ["ba", str(tmp_path / "strip.txt"), "-o", str(tmp_path / "out"), "--no-report"])
    assert run.exit_code == 3, run.output
