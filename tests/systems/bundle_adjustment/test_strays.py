"""Points that converge to a minimum of their own, points that nothing confirms, and lenses that are wrong: named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import boxplus as bp
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.manifolds.se3 import SE3Left
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.strays import stray_points
from tests.systems.bundle_adjustment.scenes import FORMATS, SIGMA, perturbed, reconstruction

GIVEN = BundleAdjustmentConfig(sigma_px=SIGMA)


def row(seed: int, format: str = "gbp", *, cameras: int = 6, points: int = 80):
    """Cameras beside each other that look the same way at points of very different depths; truth and a start beside it."""
    rng = np.random.default_rng([seed, 5])
    center = np.column_stack([np.linspace(-1.5, 1.5, cameras), 0.1 * rng.standard_normal((cameras, 2))])
    T = np.hstack([np.tile([1.0, 0.0, 0.0, 0.0], (cameras, 1)), -center])
    T = SE3Left.boxplus(T, 0.05 * rng.standard_normal((cameras, 6)) * [1, 1, 1, 0, 0, 0])
    z = rng.uniform(3.0, 12.0, points)
    p = np.column_stack([rng.uniform(-0.4, 0.4, (points, 2)) * z[:, None], z])
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:cameras, :points])
    return p, perturbed(rng, T, p, camera_of, point_of, format, 0.01, 0.02)


@pytest.mark.parametrize("format", FORMATS)
def test_points_that_lie_elsewhere_are_found_where_their_rays_meet(format):
    for seed in (1, 2):
        _, start = row(seed, format)
        result = adjust_bundle(start, GIVEN)
        assert result.doubt is None and not [note for note in result.notes if "minimum of their own" in note]
        used = np.ones(len(start.pixels), dtype=bool)
        none, _ = stray_points(result.reconstruction, used, result.depth.ratio, GIVEN, None)
        assert len(none) == 0
        moved = result.reconstruction.points.copy()
        moved[[3, 17]] *= np.array([[0.3], [6.0]])
        found, places = stray_points(replace(result.reconstruction, points=moved), used, result.depth.ratio, GIVEN, None)
        assert found.tolist() == [3, 17]
        np.testing.assert_allclose(places, result.reconstruction.points[[3, 17]], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("loss", [None, bp.losses.Huber(1.345), bp.losses.Cauchy(2.385)])
def test_an_adjustment_that_left_points_astray_names_them(loss):
    """With one step only, they are named; with steps left, all ends where it does from a good start."""
    _, start = row(3)
    sound = adjust_bundle(start, GIVEN, loss=loss)
    points = sound.reconstruction.points.copy()
    points[[5, 40]] *= np.array([[30.0], [0.3]])
    astray = replace(sound.reconstruction, points=points)
    few = GIVEN.model_copy(update={"solver": GIVEN.solver.model_copy(update={"max_iterations": 1})})
    (note,) = [note for note in adjust_bundle(astray, few, loss=loss).notes if "at a wrong depth" in note]
    assert note.endswith(": 5, 40") or note.endswith(": 5") or note.endswith(": 40")
    result = adjust_bundle(astray, GIVEN, loss=loss)
    assert result.solution.cost == pytest.approx(sound.solution.cost, rel=1e-5)
    assert [step.number for step in result.solution.history] == list(range(len(result.solution.history)))
    assert (np.diff([step.time_s for step in result.solution.history]) >= 0.0).all()


def test_points_whose_observations_contradict_each_other_are_named():
    start = reconstruction(3, "colmap")
    rng = np.random.default_rng(3)
    pixels = start.pixels.copy()
    wrong = np.array([int(np.flatnonzero(start.point_of == k)[0]) for k in (12, 77)])
    pixels[wrong] += rng.choice([-1.0, 1.0], (2, 2)) * 90.0
    notes = adjust_bundle(replace(start, pixels=pixels), GIVEN).notes
    (note,) = [note for note in notes if "have observations that contradict each other" in note]
    assert {"1012", "1077"} <= set(note.rpartition(": ")[2].split(", ")[:2])
    assert not [note for note in adjust_bundle(start, GIVEN).notes if "contradict each other" in note]


def test_points_that_a_robust_loss_leaves_unconfirmed_are_named():
    start = reconstruction(4)
    twice = np.flatnonzero(np.bincount(start.point_of) >= 3)[0]
    own = np.flatnonzero(start.point_of == twice)
    rows = np.setdiff1d(np.arange(len(start.pixels)), own[2:])
    pair = replace(start, camera_of=start.camera_of[rows], point_of=start.point_of[rows], pixels=start.pixels[rows].copy())
    sound = adjust_bundle(pair, GIVEN, loss=bp.losses.Cauchy(2.385))
    assert not [note for note in sound.notes if "nothing confirms" in note]
    pair.pixels[np.flatnonzero(pair.point_of == twice)[0]] += [150.0, -150.0]
    notes = adjust_bundle(pair, GIVEN, loss=bp.losses.Cauchy(2.385)).notes
    assert any(
        "1 point rests on fewer" in note and "nothing confirms where it is" in note and note.endswith(f": {twice}")
        for note in notes
    )


def test_a_chi_square_that_a_given_sigma_does_not_promise_is_told():
    start = reconstruction(5)
    assert any("times what sigma = 0.3 px" in note for note in adjust_bundle(start, BundleAdjustmentConfig(sigma_px=0.3)).notes)
    for config in (GIVEN, BundleAdjustmentConfig()):
        assert not [note for note in adjust_bundle(start, config).notes if "times what sigma" in note]


@pytest.mark.parametrize("what", ["k1", "cx"])
def test_a_wrong_lens_that_is_held_is_told_whatever_is_wrong_of_it(what):
    for seed in (1, 2):
        start = reconstruction(seed, "colmap", cameras=12)
        assert isinstance(start, ColmapModel)
        params = np.array([500.0, 0.0, 0.0, 0.0])
        radial = replace(start, camera_models=("SIMPLE_RADIAL",), camera_params=(params,))
        assert not [note for note in adjust_bundle(radial, GIVEN).notes if "intrinsics" in note]
        wrong = params + ([0.0, 0.0, 0.0, 0.3] if what == "k1" else [0.0, 40.0, 0.0, 0.0])
        notes = adjust_bundle(replace(radial, camera_params=(wrong,)), GIVEN).notes
        (note,) = [note for note in notes if "other intrinsics than those held" in note]
        assert f"{what} = " in note and "which moves its pixels by" in note


def test_the_search_for_points_astray_is_seen_and_can_be_stopped():
    _, start = row(3)
    sound = adjust_bundle(start, GIVEN)
    points = sound.reconstruction.points.copy()
    points[[5, 40]] *= np.array([[30.0], [0.3]])
    purposes = []

    def stop(step):
        purposes.append(step.purpose)
        return bool(step.purpose)

    few = GIVEN.model_copy(update={"solver": GIVEN.solver.model_copy(update={"max_iterations": 1})})
    result = adjust_bundle(replace(sound.reconstruction, points=points), few, callback=stop)
    assert purposes[-1] == "points at a wrong depth?" and purposes.count(purposes[-1]) == 1
    assert any("stopped while the result was examined (points at a wrong depth?)" in note for note in result.notes)
