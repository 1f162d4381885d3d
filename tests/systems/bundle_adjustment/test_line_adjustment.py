"""Cameras and lines, and points with them, adjusted from perturbed starts; the published sets to their levels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.reconstructions.vgg_lines import read_vgg_lines
from boxplus.optimization.losses import Huber
from boxplus.systems.bundle_adjustment import LineAdjustmentConfig, adjust_lines
from tests.systems.bundle_adjustment.line_scenes import house, looking, perturbed, seen, turning


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("use_points", [False, True])
def test_noise_is_all_that_is_left(seed: int, use_points: bool) -> None:
    data = house(seed, noise_px=0.2)
    start = perturbed(data, seed)
    result = adjust_lines(start, LineAdjustmentConfig(sigma_px=0.2, sigma_point_px=0.2, use_points=use_points))
    assert result.solution.status == "converged" and result.doubt is None
    assert np.nanmedian(result.errors_start) > 10.0 * np.nanmedian(result.errors)
    residuals = 2 * len(data.segments) + (2 * len(data.pixels) if use_points else 0)
    unknown = 6 * (len(data.names) - 1) + 4 * len(data.end_points_world) - 1 + (3 * len(data.points_world) if use_points else 0)
    # χ² of the degrees of freedom left.
    assert abs(2.0 * result.solution.cost / (residuals - unknown) - 1.0) < 5.0 * np.sqrt(2.0 / (residuals - unknown))
    assert len(result.point_errors) == (len(data.pixels) if use_points else 0)
    assert (result.points is not None) == use_points


def test_without_noise_the_world_comes_back_up_to_its_size() -> None:
    data = house(1, noise_px=0.0)
    result = adjust_lines(replace(perturbed(data, 1), T_camera_world=data.T_camera_world), LineAdjustmentConfig(sigma_px=0.2))
    assert np.nanmax(result.errors) < 1e-3
    d = data.end_points_world[:, 3:] - data.end_points_world[:, :3]
    found = result.data.end_points_world[:, 3:] - result.data.end_points_world[:, :3]
    sine = np.linalg.norm(np.cross(d, found), axis=1) / np.linalg.norm(d, axis=1) / np.linalg.norm(found, axis=1)
    assert np.quantile(sine, 0.8) < 0.02


def test_lines_are_found_from_segments_and_what_cannot_be_is_said() -> None:
    places = np.column_stack([np.linspace(-2.0, 2.0, 6), np.full(6, -8.0), np.full(6, 1.0)])
    level = np.array([[-1.5, 0.5, 0.2, 1.5, 0.5, 0.2]])
    ends = np.vstack([level, house(0).end_points_world])
    data = seen(looking(places, np.zeros(3)), ends, np.zeros((0, 3)), 0.1, 0)
    result = adjust_lines(data, LineAdjustmentConfig(sigma_px=0.1, triangulate=True))
    assert result.triangulation.states[0] == "along the line" and "move along them" in result.notes[0]
    assert np.isnan(result.errors[data.line_of == 0]).all()
    assert (result.data.end_points_world[0] == level[0]).all()
    given = adjust_lines(data, LineAdjustmentConfig(sigma_px=0.1))
    assert "move along them" in given.notes[0] and np.isfinite(given.errors).all()


def test_doubts_and_refusals() -> None:
    data = house(2)
    wrong = data.segments.copy()
    wrong[::4, :2] += 40.0
    result = adjust_lines(replace(data, segments=wrong), LineAdjustmentConfig(sigma_px=0.2, use_points=False))
    assert result.doubt is not None and "matched wrongly" in result.doubt
    robust = adjust_lines(replace(data, segments=wrong), LineAdjustmentConfig(sigma_px=0.2, use_points=False), loss=Huber(1.0))
    assert np.nanmedian(robust.errors) < np.nanmedian(result.errors)
    with pytest.raises(InputError, match="a method that damps its steps"):
        solver = LineAdjustmentConfig().solver.model_copy(update={"method": "gauss_newton"})
        adjust_lines(data, LineAdjustmentConfig(solver=solver))
    first = data.view_of == 0
    alone = replace(data, segments=data.segments[first], view_of=data.view_of[first], line_of=data.line_of[first])
    with pytest.raises(
        InputError, match="segments that determine a line – got 15 lines are not determined, seen in one view only"
    ):
        adjust_lines(alone, LineAdjustmentConfig(triangulate=True))


@pytest.mark.parametrize(("name", "level", "with_points"), [("Corridor", 0.128, 0.131), ("Model-House", 0.239, 0.219)])
def test_the_published_sets(shared_data: Path, name: str, level: float, with_points: float) -> None:
    folder = shared_data / "lines" / "vgg" / name
    if not folder.is_dir():
        pytest.skip(f"{name} is not on this machine")
    data = read_vgg_lines(folder)
    assert data.reflected
    for seed in range(2):
        start = perturbed(data, seed, 0.005)
        alone = adjust_lines(start, LineAdjustmentConfig(use_points=False))
        together = adjust_lines(start)
        for result, bar in ((alone, level), (together, with_points)):
            assert result.solution.status == "converged" and result.doubt is None
            assert np.nanmedian(result.errors_start) > 2.0
            assert round(float(np.nanmedian(result.errors)), 3) <= bar
        assert np.nanmedian(together.point_errors) < 0.28
        assert any("mirror image" in note for note in together.notes)


def test_points_that_are_matched_wrongly_are_named_and_not_trusted():
    for seed in (1, 3):
        data = perturbed(house(seed), seed)
        assert adjust_lines(data).doubt is None and adjust_lines(data).notes == ()
        pixels = data.pixels.copy()
        pixels[47] += [180.0, -120.0]  # of view 2
        result = adjust_lines(replace(data, pixels=pixels))
        assert "px from their points" in result.doubt
        assert any("residuals of points of 002 (7" in note for note in result.notes), result.notes


@pytest.mark.slow
@pytest.mark.parametrize("use_points", [True, False])
@pytest.mark.parametrize("seed", [10, 11, 12])
def test_cameras_that_only_turn_are_told_from_those_that_move_apart(seed: int, use_points: bool) -> None:
    config = LineAdjustmentConfig(use_points=use_points)
    for baseline in (0.0, 1e-3):
        told = adjust_lines(perturbed(turning(seed, baseline), seed), config).doubt
        assert told is not None and told.startswith("the cameras do not move apart")
    for baseline in (0.15, 1.0):
        assert adjust_lines(perturbed(turning(seed, baseline), seed), config).doubt is None


@pytest.mark.parametrize("triangulate", [False, True])
def test_lines_of_segments_that_have_no_direction_are_left_out_and_named(triangulate: bool) -> None:
    data = house(3)
    segments = data.segments.copy()
    dots = np.isin(data.line_of, [2, 7])
    segments[dots, 2:] = segments[dots, :2] + [0.4, 0.3]
    result = adjust_lines(replace(data, segments=segments), LineAdjustmentConfig(triangulate=triangulate))
    (told,) = (note for note in result.notes if "shorter than 1 px and have no direction" in note)
    assert told.startswith("2 lines are not determined, of which all segments are shorter than 1 px") and told.endswith(": 2, 7")
    assert (result.data.end_points_world[[2, 7]] == data.end_points_world[[2, 7]]).all()
    assert np.isnan(result.errors[dots]).all() and np.isfinite(result.errors[~dots]).all()
    assert [result.triangulation.states[line] for line in (2, 7)] == ["too short"] * 2
    assert result.doubt is None


def test_a_line_without_any_segment_stays_as_it_is() -> None:
    data = house(4)
    rows = np.flatnonzero(data.line_of != 5)
    without = replace(data, segments=data.segments[rows], view_of=data.view_of[rows], line_of=data.line_of[rows])
    assert (adjust_lines(without).data.end_points_world[5] == data.end_points_world[5]).all()


def test_the_examination_of_lines_is_seen_and_can_be_stopped() -> None:
    purposes = []

    def stop(step) -> bool:
        purposes.append(step.purpose)
        return bool(step.purpose)

    data = turning(0, 0.0)
    assert adjust_lines(data).doubt is not None
    result = adjust_lines(data, callback=stop)
    assert purposes[-1] == "do the cameras move apart?" and purposes.count(purposes[-1]) == 1
    assert result.solution.status == "converged"
    assert any("stopped while the result was examined (do the cameras move apart?)" in note for note in result.notes)
