"""Whether the start of an adjustment was made with another lens than the one that is held."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.doubts.lens import lens_of_start
from boxplus.systems.bundle_adjustment.doubts.lens_advice import lens_advice
from boxplus.systems.bundle_adjustment.examination import Watch
from boxplus.systems.bundle_adjustment.sightings import Sightings
from tests.small_problems import in_camera
from tests.systems.bundle_adjustment.scenes import FOCAL, note_of, perturbed, reconstruction, turning


@pytest.mark.parametrize("format", ["gbp", "colmap"])
def test_a_start_that_was_made_with_another_lens_is_told(format):
    """Of two views, which do not tell it otherwise."""
    for seed in (100, 102, 104):
        start = turning(seed, 0.5, format, cameras=2, points=120)
        lens = np.array([500.0, 600.0, 0.0, 0.0])
        other = replace(start, intrinsics=lens) if format == "gbp" else replace(start, camera_params=(lens,))
        told = note_of(other, "were made with another lens than the one that is held")
        assert "is the lens wrong?" in told
        assert not any("another lens" in note for note in adjust_bundle(start).notes)


@pytest.mark.parametrize("format", ["gbp", "colmap"])
def test_a_start_that_no_lens_explains_is_not_refused_for_it(format):
    rng = np.random.default_rng(0)
    for seed in range(100, 110):
        start = turning(seed, 0.5, format, cameras=4)
        points = start.points.mean(axis=0) + rng.normal(size=start.points.shape) * [3.0, 3.0, 1.0]
        assert adjust_bundle(replace(start, points=points)).solution.cost >= 0.0


def _of_another_lens() -> Reconstruction:
    start = turning(100, 0.5, "colmap", cameras=2, points=120)
    return replace(start, camera_params=(np.array([500.0, 600.0, 0.0, 0.0]),))


def test_the_look_at_the_lens_of_the_start_is_seen_and_can_be_stopped():
    seen, purpose = [], "the lens of the start?"

    def stop(step):
        seen.append(step.purpose)
        return step.purpose == purpose

    result = adjust_bundle(_of_another_lens(), callback=stop)
    assert seen.count(purpose) == 1 and seen[-1] == purpose
    assert any(f"stopped while the result was examined ({purpose})" in note for note in result.notes)
    assert not any("were made with another lens" in note for note in result.notes)


def test_an_adjustment_that_was_stopped_does_not_look_at_the_lens_of_the_start():
    seen = []

    def stop(step):
        seen.append(step.purpose)
        return step.number >= 1

    result = adjust_bundle(_of_another_lens(), callback=stop)
    assert result.solution.status == "stopped" and not any(seen)
    assert not any("were made with another lens" in note for note in result.notes)


def test_a_start_all_behind_its_cameras_tells_no_lens_and_warns_of_nothing():
    start = _of_another_lens()
    seen = Sightings.of(start)
    behind = replace(start, points=2.0 * seen.centers.mean(axis=0) - start.points)
    errors = Sightings.of(behind).errors(np.arange(len(seen.pixels)), behind.points[seen.point_of])
    assert np.isnan(errors).all()
    solved, used = adjust_bundle(start).solution, np.ones(len(start.point_of), dtype=np.bool_)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert lens_of_start(behind, used, BundleAdjustmentConfig(), solved, Watch(None)) is None


def _distorted(seed: int, k1: float, cameras: int = 2, points: int = 100) -> Reconstruction:
    """Seen through a lens with radial distortion, and adjusted without: PINHOLE has none."""
    rng = np.random.default_rng([seed, 7])
    z = rng.uniform(4.0, 12.0, points)
    p = np.column_stack([rng.uniform(-0.5, 0.5, (points, 2)) * z[:, None], z])
    center = rng.normal(size=(cameras, 3)) * [1.0, 1.0, 0.3]
    center /= np.linalg.norm(center, axis=1, keepdims=True)
    R = so3.exp(rng.uniform(-0.15, 0.15, (cameras, 3)))
    T = np.hstack([quaternion.from_matrix(R), -np.einsum("nij,nj->ni", R, center)])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:cameras, :points])
    start = perturbed(rng, T, p, camera_of, point_of, "colmap", 0.005, 0.05)
    seen = in_camera(T[camera_of], p[point_of])
    x = seen[:, :2] / seen[:, 2:]
    return replace(start, pixels=start.pixels + FOCAL * k1 * (x * x).sum(axis=1)[:, None] * x)


@pytest.mark.parametrize("seed", range(1, 13, 2))
def test_two_views_tell_distortion_that_their_camera_model_does_not_have(seed):
    """They told it by focal length and principal point, which they hardly determine, or not at all."""
    said = adjust_bundle(_distorted(seed, -0.2))
    told = next(text for text in (said.doubt, *said.notes) if text and "other intrinsics than those held" in text)
    assert "k1 = -0." in told and re.search("with (SIMPLE_)?RADIAL in place of the camera model, which has no k1", told)
    sound = adjust_bundle(_distorted(seed, 0.0))
    assert sound.doubt is None and not any("other intrinsics" in note for note in sound.notes)


def _told(result) -> str:
    (told,) = (text for text in (result.doubt or "", *result.notes) if "other intrinsics than those held" in text)
    return told


@pytest.mark.parametrize("seed", range(1, 8, 2))
@pytest.mark.parametrize(
    ("lens", "advice"),
    [
        ((1.1, 1.0, 0.0, 0.0), "(--refine-intrinsics)"),
        ((1.0, 0.92, 0.0, 0.0), "(--refine-intrinsics)"),
        ((1.08, 1.08, 0.0, 0.0), "(--refine-intrinsics)"),
    ],
)
def test_what_is_advised_is_what_is_off(lens, advice, seed):
    """A focal length asks for no distortion, nor for a principal point that few images tell."""
    start = reconstruction(seed, "colmap")
    told = _told(adjust_bundle(replace(start, camera_params=(np.array(lens) * [FOCAL, FOCAL, 1.0, 1.0],))))
    assert advice in told and not re.search("[kp][12] =|c[xy] =", told)


def test_a_principal_point_asks_for_its_option_and_a_file_without_distortion_for_another_format():
    start = reconstruction(3, "colmap")
    told = _told(adjust_bundle(replace(start, camera_params=(np.array([FOCAL, FOCAL, 25.0, -20.0]),))))
    assert "(--refine-intrinsics --refine-principal-point)" in told
    colmap = _distorted(3, -0.2, cameras=6)
    intrinsics = np.array([FOCAL, FOCAL, 0.0, 0.0])
    gbp = GbpProblem(intrinsics, colmap.T_camera_world, colmap.points, colmap.image_of, colmap.point_of, colmap.pixels)
    assert "knows no distortion: take it out of the pixels" in _told(adjust_bundle(gbp))
    wrong = replace(reconstruction(3, "gbp"), intrinsics=np.array([1.1 * FOCAL, FOCAL, 0.0, 0.0]))
    assert "(correct the second line of the file)" in _told(adjust_bundle(wrong))


def test_a_stop_during_the_second_look_at_the_lens_keeps_what_the_first_found():
    looks = []

    def stop(step):
        looks.append(step.purpose == "another lens?" and step.number == 0)
        return sum(looks) == 2

    result = adjust_bundle(_distorted(1, -0.2), callback=stop)
    assert sum(looks) == 2 and "k1 = -0." in _told(result)
    assert any("stopped while the result was examined (another lens?)" in note for note in result.notes)


def test_of_several_camera_models_only_those_that_lack_something_are_to_be_replaced():
    """What the others say already stays."""
    one = _of_another_lens()
    params = {"OPENCV": np.array([500.0, 600.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0]), "PINHOLE": np.array([500.0, 600.0, 0.0, 0.0])}
    params["RADIAL"] = np.array([500.0, 0.0, 0.0, 0.1, 0.0])

    def of(*models: str) -> ColmapModel:
        given = tuple(params[model] for model in models)
        return replace(
            one,
            camera_ids=np.array([1, 2]),
            camera_models=models,
            camera_params=given,
            camera_sizes=np.repeat(one.camera_sizes, 2, axis=0),
        )

    start = of("OPENCV", "PINHOLE")
    assert lens_advice(start, {"k1"}, start, start) == (
        "--refine-intrinsics, with richer camera models in place of PINHOLE, which has no k1"
    )
    start = of("OPENCV", "RADIAL")
    assert lens_advice(start, {"k1", "cx, cy"}, start, start) == "--refine-intrinsics --refine-principal-point"


@pytest.mark.parametrize("seed", [61, 65, 69])
def test_a_principal_point_that_is_held_beside_refined_intrinsics_is_told(seed):
    refined = BundleAdjustmentConfig(intrinsics="refined")
    start = reconstruction(seed, "colmap")
    told = adjust_bundle(replace(start, pixels=start.pixels + np.array([50.0, 30.0])), refined).doubt
    assert "other intrinsics than those held" in told and "--refine-principal-point" in told
    assert re.search(r"cx = (49|50|51)\.\d+ instead of 0", told)
    sound = adjust_bundle(start, refined)
    assert sound.doubt is None and not any("intrinsics" in note for note in sound.notes)


@pytest.mark.parametrize("seed", [61, 65, 69])
def test_pixels_of_bal_that_are_not_square_are_told(seed):
    start = reconstruction(seed, "bal")
    told = adjust_bundle(replace(start, pixels=start.pixels * [1.0, 1.1])).doubt
    assert re.search(r"y stretched 1\.(09|1|11) times", told) and "correct the pixels" in told
    sound = adjust_bundle(start)
    assert sound.doubt is None and not any("lens" in note for note in sound.notes)


def test_pixels_of_bal_that_are_counted_from_another_place_are_told():
    """By cameras all around a cloud, which no turn of theirs explains away."""
    rng = np.random.default_rng(5)
    angle = np.linspace(0.0, 6.0, 12)
    centers = np.column_stack([6.0 * np.cos(angle), 6.0 * np.sin(angle), rng.normal(0.0, 0.7, 12)])
    z = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    T = np.hstack([quaternion.from_matrix(R), -np.einsum("nij,nj->ni", R, centers)])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:12, :200])
    start = perturbed(rng, T, rng.uniform(-2.0, 2.0, (200, 3)), camera_of, point_of, "bal", 0.01, 0.05)
    told = adjust_bundle(replace(start, pixels=start.pixels + np.array([-50.0, 0.0]))).doubt
    shift = float(re.search(r"principal point at \((\S+), ", told)[1])
    assert -60.0 < shift < -35.0
    assert adjust_bundle(start).doubt is None
