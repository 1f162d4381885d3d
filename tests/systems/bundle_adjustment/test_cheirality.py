"""Points behind cameras: counted, computed anew, dropped and named, whatever their share; cameras turned around; the way out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem, write_bal
from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
from boxplus.systems.bundle_adjustment.cheirality import make_sound
from boxplus.systems.bundle_adjustment.sightings import Sightings
from tests.systems.bundle_adjustment.scenes import FORMATS, reconstruction, turned_around, with_points_behind


@pytest.mark.parametrize("format", FORMATS)
def test_depths_do_not_depend_on_the_format(format):
    sightings = Sightings.of(reconstruction(0, format))
    assert (sightings.depths() > 5.0).all() and len(sightings.depths()) == len(sightings.pixels)
    np.testing.assert_allclose(sightings.depths(), Sightings.of(reconstruction(0, "gbp")).depths(), rtol=1e-9)
    errors = sightings.errors(np.arange(len(sightings.pixels)), sightings.points[sightings.point_of])
    assert 1.0 < np.median(errors) < 50.0


@pytest.mark.parametrize("format", FORMATS)
def test_a_sound_start_stays_as_it_is(format):
    start = reconstruction(1, format)
    sound = make_sound(start)
    assert sound.reconstruction is start and sound.used.all() and sound.cheirality.bad_share == 0.0
    assert sound.cheirality.notes(start) == []


@pytest.mark.parametrize("kind", ["mirrored", "beyond"])
@pytest.mark.parametrize(("seed", "share", "format"), [(2, 0.02, "bal"), (3, 0.1, "gbp"), (4, 0.3, "colmap"), (5, 0.3, "bal")])
def test_points_behind_cameras_are_repaired(seed, share, format, kind):
    start = reconstruction(seed, format)
    expected = adjust_bundle(start)
    spoiled, bad = with_points_behind(start, share, kind, seed)
    behind = Sightings.of(spoiled).depths() <= 0.0
    assert behind.any()
    result = adjust_bundle(spoiled)
    found = result.cheirality
    assert found.behind_start == behind.sum() and found.behind == 0
    assert set(found.triangulated) | set(found.dropped) >= set(Sightings.of(spoiled).point_of[behind])
    assert set(found.triangulated) | set(found.dropped) <= set(bad)
    assert not len(found.dropped)
    assert result.solution.cost <= expected.solution.cost * (1.0 + 1e-4)
    assert (Sightings.of(result.reconstruction).depths()[make_sound(spoiled).used] > 0.0).all()
    said = " ".join(result.notes)
    assert f"{behind.sum()} of {len(behind)} observations are of points behind their cameras in the input" in said
    assert f"{len(found.triangulated)} points behind cameras, or far off, were triangulated anew: " in said
    assert np.isfinite(result.errors).all()


@pytest.mark.parametrize(("seed", "format", "chosen"), [(6, "bal", [4]), (7, "gbp", [1, 5, 6]), (8, "colmap", [0, 3])])
def test_cameras_turned_around_are_named_and_set_anew(seed, format, chosen):
    start = reconstruction(seed, format)
    result = adjust_bundle(turned_around(start, np.array(chosen)))
    assert list(result.cheirality.turned) == list(result.cheirality.turned_back) == chosen
    assert result.solution.cost <= adjust_bundle(start).solution.cost * (1.0 + 1e-4)
    assert result.doubt is None
    names = ", ".join(str(100 + k if format == "colmap" else k) for k in chosen)
    assert any(note.endswith(f"turned around, and were set anew from these: {names}") for note in result.notes)


def test_a_turned_camera_that_cannot_be_set_anew_is_left_out():
    """All points lie in a plane, from which the linear transform tells nothing."""
    start = reconstruction(9, "gbp")
    flat = start.points * [1.0, 1.0, 0.0]
    sightings = Sightings.of(replace(start, points=flat))
    p = np.einsum("nij,nj->ni", sightings.R_camera_world[start.camera_of], flat[start.point_of]) + sightings.t[start.camera_of]
    start = replace(start, points=flat, pixels=500.0 * p[:, :2] / p[:, 2:])
    result = adjust_bundle(turned_around(start, np.array([2])))
    assert list(result.cheirality.turned) == [2] and not len(result.cheirality.turned_back)
    assert result.cheirality.left_out == np.count_nonzero(start.camera_of == 2) and 2 not in result.camera_of
    assert "could not be set anew; all they saw is left out: 2" in " ".join(result.notes)
    assert "observations (" in result.doubt and "left out" in result.doubt


def test_tracks_that_meet_behind_cameras_are_dropped_and_named():
    """Wrong matches: disparities of the opposite sign. The others' result is as if these had never been."""
    start = reconstruction(10, "colmap", cameras=4, share=0.9)
    sightings = Sightings.of(start)
    wrong = np.array([3, 40])
    pixels, points = start.pixels.copy(), start.points.copy()
    for k in wrong:
        rows = np.flatnonzero(start.point_of == k)
        centers = sightings.centers[start.image_of[rows]]
        points[k] = centers.mean(axis=0) * 8.0
        P = np.einsum("nij,j->ni", sightings.R_camera_world[start.image_of[rows]], points[k]) + sightings.t[start.image_of[rows]]
        assert len(rows) > 1 and (P[:, 2] < 0.0).all()
        pixels[rows] = 500.0 * P[:, :2] / P[:, 2:]
    result = adjust_bundle(replace(start, pixels=pixels, points=points))
    assert list(result.cheirality.dropped) == list(wrong)
    np.testing.assert_array_equal(result.reconstruction.points[wrong], points[wrong])
    np.testing.assert_array_equal(result.reconstruction.errors[wrong], [-1.0, -1.0])
    assert any("2 points lie behind cameras" in note and note.endswith("1003, 1040") for note in result.notes)
    without = replace(start, point_of=np.where(np.isin(start.point_of, wrong), -1, start.point_of))
    assert result.solution.cost == pytest.approx(adjust_bundle(without).solution.cost, rel=1e-6)


def test_the_wrong_convention_of_all_cameras_is_refused():
    start = reconstruction(11, "gbp")
    with pytest.raises(InputError, match=r"expected points before the cameras that saw them – got \d+ of \d+ observations"):
        adjust_bundle(turned_around(start, np.arange(8)))


def test_the_command_says_so_and_ends_with_3(tmp_path):
    start = reconstruction(12, "bal", cameras=4, share=0.9)
    spoiled, _ = with_points_behind(start, 0.05, "mirrored", 12)
    write_bal(tmp_path / "good.txt", spoiled)
    repaired = CliRunner().invoke(app, ["ba", str(tmp_path / "good.txt"), "-o", str(tmp_path / "repaired"), "--no-report"])
    assert repaired.exit_code == 0, repaired.output
    assert "points triangulated anew" in repaired.output and "observations are of points behind their cameras" in repaired.output
    # Matches whose rays meet behind the cameras, more than a few of them.
    sightings, pixels, points = Sightings.of(start), start.pixels.copy(), start.points.copy()
    for k in range(20):
        rows = np.flatnonzero(start.point_of == k)
        points[k] = sightings.centers[start.camera_of[rows]].mean(axis=0) * 8.0
        P = (
            np.einsum("nij,j->ni", sightings.R_camera_world[start.camera_of[rows]], points[k])
            + sightings.t[start.camera_of[rows]]
        )
        pixels[rows] = 500.0 * P[:, :2] / P[:, 2:] * [1.0, -1.0]
    assert isinstance(start, BalProblem)
    write_bal(tmp_path / "bad.txt", replace(start, pixels=pixels, points=points))
    result = CliRunner().invoke(app, ["ba", str(tmp_path / "bad.txt"), "-o", str(tmp_path / "out")])
    assert result.exit_code == 3, result.output
    assert "not to be trusted: " in result.output and "behind their cameras at the end, or were left out for it" in result.output
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["state"] == "finished" and summary["doubt"] in " ".join(result.output.split())
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8").split("<body>")[1]
    assert "not to be trusted" in page and "nowhere before them fit what was seen" in page
