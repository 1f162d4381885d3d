"""What is asked of a place before it is believed, one question at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import se3
from boxplus.simulation.worlds.worlds import yard
from boxplus.systems.localization.candidate import Candidate, contradiction, distinct, lead, rivalry
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.localization.global_search import PlaceImages, same_pose
from boxplus.systems.localization.standing import seen_through, standing
from tests.systems.localization.days import INDOORS, drive_of, known_map

HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def candidate(fit: float, x: float = 0.0, refusal: str | None = None, distance: float = 0.05) -> Candidate:
    T = HERE + np.array([0.0, 0.0, 0.0, 0.0, x, 0.0, 0.0])
    return Candidate(0, T, np.eye(6), 0.5, fit, distance, 1.0, 0.02, 6, 0.0, refusal)


def judged(*candidates: Candidate) -> tuple[bool, bool]:
    """Whether the best is believed as far as rivals go, and whether at once."""
    best, why, at_once = rivalry(list(candidates), LocalizationConfig())
    assert (best is None) <= bool(why)
    return why == "", at_once


def test_a_rival_that_fits_nearly_as_well_forbids_to_believe() -> None:
    assert judged(candidate(0.9)) == (True, True)
    assert judged(candidate(0.9), candidate(0.3, 30.0)) == (True, True)
    assert judged(candidate(0.9), candidate(0.6, 30.0)) == (True, False)  # a second query has to agree
    assert judged(candidate(0.9), candidate(0.82, 30.0))[0] is False
    assert judged(candidate(0.9), candidate(0.82, 4.0))[0] is False  # a column farther
    assert judged(candidate(0.9), candidate(0.89, 0.5)) == (True, True)  # the same pose
    # Nearly nothing does not fit here, and three times as much there.
    assert judged(candidate(0.99), candidate(0.93, 30.0)) == (True, False)
    assert judged(candidate(0.99), candidate(0.96, 30.0))[0] is False
    # Nor does what stands lie on surfaces there.
    assert judged(candidate(0.95), candidate(0.88, 30.0, distance=0.08)) == (True, False)
    assert judged(candidate(0.95), candidate(0.88, 30.0, distance=0.06))[0] is False
    assert judged(candidate(0.95), candidate(0.92, 30.0, distance=0.12))[0] is False
    # A rival that is refused is a rival all the same.
    assert judged(candidate(0.9), candidate(0.88, 30.0, "surfaces lie apart"))[0] is False
    assert judged(candidate(0.9, 0.0, "seen through"), candidate(0.4, 30.0, "too little")) == (False, False)


def above(fit: float, z: float, refusal: str | None = "the surfaces determine 5 of 6 directions only") -> Candidate:
    own = candidate(fit, 0.0, refusal)
    return replace(own, T_map_query=own.T_map_query + np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0, z]))


def test_storeys_that_look_the_same_are_named() -> None:
    config = LocalizationConfig()
    _, why, _ = rivalry([above(0.99, 5.3), above(0.998, 1.3), above(0.96, 9.3), candidate(0.95, 20.0, "no")], config)
    assert why == (
        "no place passes every test; 3 poses above one another fit alike, 96 % to 100 %: storeys that look the same from here; "
        "go where they differ"
    )
    _, why, _ = rivalry([above(0.99, 5.3, None), above(0.998, 1.3), above(0.6, 9.3)], config)
    assert why.startswith("another pose, 4.0 m away, fits nearly as well") and "2 poses above one another fit alike" in why
    assert rivalry([above(0.9, 0.0), candidate(0.9, 20.0, "no"), above(0.5, 4.0)], config)[1] == "no place passes every test"
    # What fits best of all may be refused: storeys are those of the place that is meant.
    _, why, _ = rivalry([candidate(0.99, 20.0, "seen through"), above(0.97, 5.3, None), above(0.96, 1.3)], config)
    assert "2 poses above one another fit alike, 96 % to 97 %" in why


def test_no_candidate_is_no_place() -> None:
    assert rivalry([], LocalizationConfig()) == (None, "no place passes every test", False)


def test_the_lead_is_over_the_best_of_all_other_poses() -> None:
    best, twin = candidate(0.9, distance=0.03), candidate(0.9, 0.4, distance=0.031)
    assert lead(best, [best]) == pytest.approx(0.8)  # nothing else lies nearer than a point that belongs to no surface
    assert lead(best, [best, twin, candidate(0.8, 3.0, distance=0.06), candidate(0.7, 9.0, distance=0.1)]) == pytest.approx(0.5)
    assert lead(best, [best, candidate(0.8, 3.0, distance=0.024)]) == pytest.approx(-0.25)
    assert distinct([best, twin, candidate(0.5, 3.0)])[1].fit == 0.5


def test_a_place_that_is_followed_is_contradicted_by_one_that_fits_clearly_better() -> None:
    def against(here: Candidate, *others: Candidate) -> str | None:
        return contradiction(here, list(others), HERE, LocalizationConfig())

    here = candidate(0.7, distance=0.08)
    assert against(here) is None
    assert against(here, candidate(0.75, 9.0, distance=0.05)) is None  # a little better
    assert against(here, candidate(0.9, 9.0, distance=0.07)) is None
    assert against(here, candidate(0.9, 9.0, "seen through", distance=0.03)) is None
    assert against(here, candidate(0.9, 0.5, distance=0.03)) is None  # the same place
    assert "9.0 m away, fits better: 90 % and 70 %" in str(against(here, candidate(0.9, 9.0, distance=0.03)))
    assert "2.8 m away" in str(against(candidate(0.9, 2.8)))  # what it is registered to is elsewhere
    assert against(replace(candidate(0.9, 2.8), measured=5)) is None  # along a corridor
    assert against(replace(here, seen_through=0.3, refusal="in 30 % of directions")) == "in 30 % of directions"


def test_a_wall_of_the_map_that_a_scan_sees_past_speaks_against_it() -> None:
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(-8.0, 8.0, 0.1), np.arange(-1.0, 3.0, 0.1)))
    wall = np.column_stack([np.full_like(y, 10.0), y, z]).astype(np.float32)
    nearer = wall * np.array([0.5, 1.0, 1.0], np.float32)
    assert seen_through(wall, wall, np.zeros(3)) == 0.0
    assert seen_through(wall, nearer, np.zeros(3)) > 0.8
    farther = wall * np.array([2.0, 1.0, 1.0], np.float32)
    assert seen_through(wall, farther, np.zeros(3)) == 0.0  # something was put in front of it: no contradiction
    assert np.isnan(seen_through(wall, wall[:0], np.zeros(3)))


def test_only_what_stands_counts() -> None:
    random = np.random.default_rng(1)
    floor = np.column_stack([random.uniform(0, 20, (2000, 2)), random.normal(0.0, 0.02, 2000)])
    ceiling = floor + np.array([0.0, 0.0, 2.6])
    wall = np.column_stack([random.uniform(0, 20, 2000), np.full(2000, 30.2), random.uniform(0.0, 2.6, 2000)])
    mask = standing(np.concatenate([floor, ceiling, wall]).astype(np.float32))
    assert not mask[:4000].any() and mask[4000:].mean() > 0.95
    assert standing(np.zeros((0, 3), np.float32)).shape == (0,)


def test_every_turn_and_shift_of_a_place_is_found_from_above() -> None:
    place_map = known_map(yard(60.0, seed=3), [[-12, 0], [12, 0]], INDOORS, seed=3)
    images = PlaceImages(place_map.local_maps)
    drive = drive_of(yard(60.0, seed=3), [[3, 2], [-6, 2]], seed=9)
    for yaw in (0.3, 2.9):
        T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), 0.0, 0.0, 0.0])
        query = se3.act(T, drive.scans[4].astype(np.float64)).astype(np.float32)
        best = images.guesses(query, 5)[0]
        truth = se3.compose(drive.T_world_body[4], se3.inverse(T))
        assert same_pose(best.T_map_query, truth, 1.0, np.deg2rad(6.0), 0.5)
    assert images.guesses(query[:0], 5) == []
