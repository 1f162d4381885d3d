"""What people feed to bundle adjustment by mistake: each is right all the same, refused, or flagged."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import boxplus as bp
from boxplus.errors import BoxplusError, InputError, NotFiniteError
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.examination import examination_options
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction
from tests.small_problems import scene
from tests.systems.bundle_adjustment.scenes import FORMATS, SIGMA, note_of, perturbed, reconstruction


def chosen(start: Reconstruction, rows: np.ndarray) -> Reconstruction:
    """Of the observations only some."""
    return replace(start, camera_of=start.camera_of[rows], point_of=start.point_of[rows], pixels=start.pixels[rows])


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(("value", "error"), [(np.nan, InputError), (np.inf, InputError), (1e200, NotFiniteError)])
def test_pixels_that_are_no_numbers_are_refused(format, value, error):
    start = reconstruction(60, format)
    pixels = start.pixels.copy()
    pixels[3] = value
    with np.errstate(over="ignore"), pytest.raises(error):
        adjust_bundle(replace(start, pixels=pixels))


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("index", [-5, 10_000])
def test_dangling_indices_are_refused(format, index):
    start = reconstruction(61, format)
    name = "image_of" if format == "colmap" else "camera_of"
    for which in (name, "point_of"):
        of = getattr(start, which).copy()
        of[-1] = index
        with pytest.raises(InputError, match=r"indices|observations image by image"):
            adjust_bundle(replace(start, **{which: of}))


@pytest.mark.parametrize("focal", [-500.0, 0.0])
@pytest.mark.parametrize("format", FORMATS)
def test_focal_lengths_that_are_not_positive_are_refused(format, focal):
    start = reconstruction(62, format)
    if format == "bal":
        cameras = start.cameras.copy()
        cameras[2, 6] = focal
        with pytest.raises(InputError, match=r"expected positive focal lengths \[px\] – got -?[0-9]+, camera 2 "):
            adjust_bundle(replace(start, cameras=cameras))
        return
    intrinsics = np.array([focal, focal, 0.0, 0.0])
    wrong = replace(start, intrinsics=intrinsics) if format == "gbp" else replace(start, camera_params=(intrinsics,))
    with pytest.raises(InputError, match="expected fx positive and finite"):
        adjust_bundle(wrong)


def test_nothing_to_adjust_is_refused():
    for format in ("bal", "gbp"):
        with pytest.raises(InputError, match="not a single observation of a point"):
            adjust_bundle(chosen(reconstruction(63, format), np.zeros(0, dtype=int)))


def test_repeated_observations_are_counted():
    start = reconstruction(64)
    twice = chosen(start, np.concatenate([np.arange(len(start.pixels)), np.arange(30)]))
    assert note_of(twice, "that has it already").startswith("30 observations are of a point in a camera that has it already")
    assert not any("already" in note for note in adjust_bundle(start).notes)


def test_a_camera_with_one_point_and_one_with_none_are_told():
    start = reconstruction(65)
    few = chosen(start, np.flatnonzero((start.camera_of != 0) | (np.cumsum(start.camera_of == 0) <= 1)))
    assert note_of(few, "fewer than 4 points").startswith("1 camera sees fewer than 4 points: its pose")
    assert "cameras[0]" in note_of(chosen(start, np.flatnonzero(start.camera_of != 0)), "no residual touches")
    # The one observation is explained by the camera it is alone in, and nothing else moves for it.
    without = adjust_bundle(chosen(start, np.flatnonzero(start.camera_of != 0)))
    assert adjust_bundle(few).solution.cost == pytest.approx(without.solution.cost, rel=1e-6)


@pytest.mark.parametrize("format", FORMATS)
def test_points_in_a_plane_are_no_problem(format):
    rng = np.random.default_rng(66)
    T, p, camera_of, point_of = scene(66, 8, 60)
    start = perturbed(rng, T, p * [1.0, 1.0, 0.02], camera_of, point_of, format, 0.02, 0.05)
    result = adjust_bundle(start, BundleAdjustmentConfig(sigma_px=SIGMA))
    assert result.solution.status == "converged" and result.doubt is None
    assert np.sqrt(np.mean(result.errors**2)) < 2.0 * SIGMA


def test_two_scenes_in_one_file_are_told():
    start = reconstruction(67)
    half = start.camera_of < 4
    two = replace(start, point_of=np.where(half, start.point_of, start.point_of + 150), points=np.vstack([start.points] * 2))
    assert note_of(two, "pieces").startswith("the reconstruction falls into 2 pieces that share no point")


@pytest.mark.parametrize(
    ("sigma", "factor"),
    [(1e-9, "small by a factor of 5e+08"), (1e9, "large by a factor of 2e+09"), (20.0, "large by a factor of 40")],
)
def test_a_sigma_that_the_errors_contradict_is_told(sigma, factor):
    note = note_of(reconstruction(68), "the errors are those of sigma = 0.", config=BundleAdjustmentConfig(sigma_px=sigma))
    way, number = factor.split(" by a factor of ")
    assert f"px was given: standard deviations are too {way} by a factor of " in note
    assert float(note.split("by a factor of ")[1].split(",")[0]) == pytest.approx(float(number), rel=0.3)


def test_a_sigma_that_fits_and_one_near_it_are_not():
    for sigma in (0.3, 0.5, 0.9):
        result = adjust_bundle(reconstruction(69), BundleAdjustmentConfig(sigma_px=sigma))
        assert not any("the errors are those" in note for note in result.notes)


@pytest.mark.parametrize("format", ["bal", "gbp"])
def test_pixels_in_another_unit_are_asked_about(format):
    start = reconstruction(70, format)
    pixels = start.pixels.copy()
    pixels[start.camera_of == 3] /= 500.0
    one = replace(start, pixels=pixels)
    assert note_of(one, "are they in another unit?").startswith("the pixels of cameras 3 spread over 0.")
    assert "are both in the same unit?" in note_of(replace(start, pixels=start.pixels / 500.0), "at a focal length of 500 px")
    assert not any("unit?" in note for note in adjust_bundle(start).notes)


def test_a_camera_in_another_unit_of_length_comes_back():
    start = reconstruction(71)
    T = start.T_camera_world.copy()
    T[2, 4:] *= 1000.0
    result = adjust_bundle(replace(start, T_camera_world=T))
    assert result.solution.cost == pytest.approx(adjust_bundle(start).solution.cost, rel=1e-5)


def test_one_image_and_too_few_measurements_are_not_trusted():
    start = reconstruction(72)
    one = chosen(start, np.flatnonzero(start.camera_of == 0))
    result = adjust_bundle(replace(one, T_camera_world=start.T_camera_world[:1]))
    assert "unknowns more than measurements" in result.doubt and "the cameras do not move apart" in result.doubt
    few = chosen(start, np.flatnonzero((start.camera_of < 2) & (start.point_of < 8)))
    few = replace(few, T_camera_world=start.T_camera_world[:2])
    assert "unknowns more than measurements: small errors are no evidence" in adjust_bundle(few).doubt


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"sigma": 0.0}, "sigma positive and finite"),
        ({"sigma": -1.0}, "sigma positive and finite"),
        ({"sigma": np.inf}, "sigma positive and finite"),
        ({"sigma": np.nan}, "sigma positive and finite"),
        ({"covariance": np.zeros((2, 2))}, "covariance"),
        ({"covariance": np.array([[1.0, 2.0], [2.0, 1.0]])}, "covariance"),
        ({"information": np.array([[1.0, 0.5], [0.0, 1.0]])}, "information"),
        ({"sigma": 1.0, "information": np.eye(2)}, "one of sigma, covariance, information"),
    ],
)
def test_noise_that_is_none_is_refused_by_problems(settings, told):
    with pytest.raises(InputError, match=told):
        bp.residuals.Reprojection(bp.Pinhole(500.0, 500.0, 0.0, 0.0), np.zeros((3, 2)), **settings)


@pytest.mark.parametrize("sigma", [1e-100, 1e-9, 1e9, 1e100])
def test_any_sigma_gives_the_same_values(sigma):
    """And covariances that go with its square."""
    solutions = []
    for s in (1.0, sigma):
        start = reconstruction(73, points=20, share=1.0)
        problem = bp.Problem()
        T = problem.add_variables(bp.SE3Left, start.T_camera_world)
        p = problem.add_variables(bp.Euclidean(3), start.points)
        residual = bp.residuals.Reprojection(bp.Pinhole(500.0, 500.0, 0.0, 0.0), start.pixels, sigma=s)
        problem.add_residuals(residual, T[start.camera_of], p[start.point_of])
        problem.fix(T[:2])
        solutions.append((problem.solve(), p))
    (one, p), (other, q) = solutions
    assert one.status == other.status == "converged"
    np.testing.assert_allclose(other[q], one[p], atol=1e-5)
    np.testing.assert_allclose(other.covariance(q[[3]]) / sigma**2, one.covariance(p[[3]]), rtol=1e-3)


def test_every_refusal_is_of_one_family():
    assert issubclass(InputError, BoxplusError) and issubclass(NotFiniteError, BoxplusError)


def test_a_sigma_that_was_meant_is_held_to_more():
    start = reconstruction(66, "gbp")
    assert not [note for note in adjust_bundle(start).notes if "sigma" in note]
    note_of(start, "the errors are those of sigma", config=BundleAdjustmentConfig(sigma_px=SIGMA / 3.0))
    assert "times what sigma" in adjust_bundle(start, BundleAdjustmentConfig(sigma_px=SIGMA / 10.0)).doubt
    assert adjust_bundle(start, BundleAdjustmentConfig(sigma_px=SIGMA)).doubt is None


@pytest.mark.parametrize("flip", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(67, 71))
def test_pixels_counted_from_a_corner_are_not_trusted(seed, flip):
    start = reconstruction(seed, "bal")
    spread = np.abs(start.pixels).max(axis=0)
    told = adjust_bundle(replace(start, pixels=start.pixels * [1.0, flip] + spread)).doubt
    assert "the pixels are counted from a corner of the image" in told or "mirror image" in told or "bend all" in told
    if flip > 0.0:
        middle = re.search(r"from the middle of their range, \((\S+), (\S+)\) px, the cost is", told)
        assert [float(middle[k]) for k in (1, 2)] == pytest.approx(spread, abs=20.0)
    sound = adjust_bundle(start)
    assert sound.doubt is None and not [note for note in sound.notes if "principal point" in note]


def test_pixels_on_one_side_of_the_middle_are_asked_about_and_trusted_where_they_fit():
    asked = 0
    for seed in range(100, 106):
        start = reconstruction(seed, "bal", cameras=12, points=300)
        inside = (start.pixels > -3.0).all(axis=1)
        inside &= np.bincount(start.point_of[inside], minlength=300)[start.point_of] >= 2
        result = adjust_bundle(chosen(start, np.flatnonzero(inside)))
        assert result.doubt is None
        asked += any("on one side of the principal point" in note for note in result.notes)
    assert asked


def test_pixels_with_a_flipped_axis_give_a_mirror_image_which_is_told():
    start = reconstruction(70, "bal", cameras=10)
    told = adjust_bundle(replace(start, pixels=start.pixels * [1.0, -1.0])).doubt
    assert "the result is a mirror image of the input: is one axis of the pixels flipped" in told
    assert adjust_bundle(start).doubt is None


@pytest.mark.parametrize("format", ["gbp", "colmap"])
def test_pixels_with_swapped_axes_are_not_trusted(format):
    start = reconstruction(71, format)
    assert "or are the two swapped" in adjust_bundle(replace(start, pixels=np.ascontiguousarray(start.pixels[:, ::-1]))).doubt


@pytest.mark.parametrize("loss", [None, bp.losses.Huber(1.345)])
@pytest.mark.parametrize("format", ["gbp", "colmap"])
@pytest.mark.parametrize(
    ("factors", "shift"), [([1.1, 1.1, 1.0, 1.0], 0.0), ([1.1, 1.0, 1.0, 1.0], 0.0), ([1.0] * 4, [0.0, 0.0, 320.0, 240.0])]
)
def test_a_lens_that_bends_the_scene_is_not_trusted(format, factors, shift, loss):
    """A focal length, an aspect ratio, and pixels counted from the other place, without a sigma that anybody gave."""
    start = reconstruction(68, format)
    lens = np.array([500.0, 500.0, 0.0, 0.0]) * factors + shift
    wrong = replace(start, intrinsics=lens) if format == "gbp" else replace(start, camera_params=(lens,))
    told = adjust_bundle(wrong, loss=loss).doubt
    assert told is not None and ("other intrinsics than those held" in told or "of the focal length" in told)
    assert adjust_bundle(start, loss=loss).doubt is None


def test_errors_that_no_camera_has_are_not_trusted():
    start = reconstruction(72, "gbp")
    rng = np.random.default_rng(0)
    anywhere = rng.random(len(start.pixels)) < 0.2
    pixels = np.where(anywhere[:, None], rng.uniform(-320.0, 320.0, start.pixels.shape), start.pixels)
    assert "of the focal length: no image is measured so coarsely" in adjust_bundle(replace(start, pixels=pixels)).doubt
    flipped = replace(start, pixels=start.pixels * [-1.0, 1.0])
    told = adjust_bundle(flipped, BundleAdjustmentConfig(sigma_px=SIGMA), loss=bp.losses.Huber(1.345)).doubt
    assert "times the 0.5 px that were given" in told or "no image is measured so coarsely" in told


def test_focal_lengths_of_bal_that_turn_negative_are_named():
    start = reconstruction(73, "bal")
    with pytest.raises(InputError, match=r"8 of 8 that came out negative.*turned by half a turn"):
        adjust_bundle(replace(start, pixels=-start.pixels))


def test_refined_focal_lengths_of_colmap_that_turn_negative_are_named_with_the_axes_that_the_start_tells():
    refined = BundleAdjustmentConfig(intrinsics="refined")
    start = reconstruction(73, "colmap")
    with pytest.raises(InputError, match=r"1 of 1 that came out negative, that of camera 3.*flipped or swapped"):
        adjust_bundle(replace(start, pixels=-start.pixels), refined)
    with pytest.raises(InputError, match=r"that of camera 3.*is y of the pixels flipped"):
        adjust_bundle(replace(start, pixels=start.pixels * [1.0, -1.0]), refined)


@pytest.mark.parametrize("wrong", [0.8, 1.15])
def test_a_wrong_focal_length_that_is_held_is_told(wrong):
    start = reconstruction(68, "colmap")
    intrinsics = start.camera_params[0] * [wrong, wrong, 1.0, 1.0]
    told = adjust_bundle(replace(start, camera_params=(intrinsics,))).doubt
    found = re.search(r"for camera 3 fx = (\S+) instead of (\S+), fy = (\S+) instead of", told)
    assert [float(found[k]) for k in (1, 2, 3)] == pytest.approx([500.0, intrinsics[0], 500.0], rel=0.02)
    assert "--refine-intrinsics" in told
    for seed in range(68, 71):
        sound = adjust_bundle(reconstruction(seed, "colmap"))
        assert sound.doubt is None and not [note for note in sound.notes if "intrinsics" in note]


def test_an_adjustment_that_was_stopped_is_not_examined_further():
    """No second solve after Ctrl-C or a time limit; what it would tell of a focal length waits for the minimum."""
    start = reconstruction(68, "colmap")
    start = replace(start, camera_params=(start.camera_params[0] * [0.8, 0.8, 1.0, 1.0],))
    stopped = adjust_bundle(start, callback=lambda iteration: iteration.number >= 4)
    assert stopped.solution.status == "stopped"
    assert not [text for text in (*stopped.notes, stopped.doubt or "") if "other intrinsics" in text]


def test_few_wrong_matches_without_a_robust_loss_are_told():
    start = reconstruction(69, "gbp")
    pixels = start.pixels.copy()
    pixels[::40] += 60.0
    told = note_of(replace(start, pixels=pixels), "times the typical error")
    assert "wrong matches" in told


def test_an_examination_is_bounded_by_work_and_not_by_the_clock():
    start = reconstruction(68, "bal")
    problem = bp.Problem()
    config = BundleAdjustmentConfig()
    cameras, _ = add_reconstruction(problem, start, np.ones(len(start.pixels), dtype=bool), config, None)
    solved = problem.solve(max_iterations=3)
    options = examination_options(problem, len(cameras), solved, config)
    assert options.time_limit_s is None and options.max_iterations == 25
    assert examination_options(problem, 1000, solved, config).max_iterations == 3
    limited = config.model_copy(update={"solver": config.solver.model_copy(update={"time_limit_s": 1e-9})})
    assert examination_options(problem, len(cameras), solved, limited) is None
    stopped = problem.solve(callback=lambda iteration: True)
    assert examination_options(problem, len(cameras), stopped, config) is None


@pytest.mark.parametrize("place", [0.0, 1.0])
def test_points_that_all_start_in_one_place_are_no_mirror_image(place):
    start = reconstruction(69, "bal", cameras=10)
    with np.errstate(all="raise", under="ignore"):
        result = adjust_bundle(replace(start, points=np.full_like(start.points, place)))
    assert "mirror" not in (result.doubt or "")


def test_wrong_matches_are_triangulated_without_a_warning_of_numpy():
    start = reconstruction(69, "bal", cameras=10, points=200)
    rng = np.random.default_rng(0)
    wrong = rng.random(len(start.point_of)) < 0.3
    of = start.point_of.copy()
    of[wrong] = rng.permutation(of[wrong])
    with np.errstate(divide="raise"):
        assert adjust_bundle(replace(start, point_of=of)).doubt is not None


def test_a_wild_pixel_does_not_move_the_middle_that_pixels_are_counted_from():
    start = reconstruction(100, "bal")
    pixels = start.pixels + np.abs(start.pixels).max(axis=0)
    pixels[7] = [90_000.0, 70_000.0]
    told = adjust_bundle(replace(start, pixels=pixels), loss=bp.losses.Huber(1.345)).doubt
    middle = re.search(r"from the middle of their range, \((\S+), (\S+)\) px, the cost is", told)
    assert [float(middle[k]) for k in (1, 2)] == pytest.approx(np.abs(start.pixels).max(axis=0), abs=40.0)


@pytest.mark.parametrize(
    ("purpose", "format", "change"),
    [
        ("another lens?", "colmap", lambda start: replace(start, camera_params=(0.8 * start.camera_params[0],))),
        ("pixels from a corner?", "bal", lambda start: replace(start, pixels=start.pixels + np.abs(start.pixels).max(axis=0))),
        ("bent by wrong matches?", "gbp", lambda start: replace(start, pixels=start.pixels + _wrong_matches(start))),
    ],
)
def test_examinations_are_seen_and_can_be_stopped(purpose, format, change):
    start, seen = change(reconstruction(100, format)), []

    def stop(step):
        seen.append(step.purpose)
        return step.purpose == purpose

    result = adjust_bundle(start, callback=stop)
    assert seen.count(purpose) == 1 and seen[-1] == purpose
    (told,) = (note for note in result.notes if "stopped while the result was examined" in note)
    assert purpose in told
    assert result.solution.status == "converged"


def _wrong_matches(start: Reconstruction) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.where(rng.random((len(start.pixels), 1)) < 0.05, rng.uniform(-60.0, 60.0, start.pixels.shape), 0.0)
