"""Positions that are repeated while the antenna goes on are those of some time ago, and are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.gnss import GnssConfig
from boxplus.systems.georeference.georeference import Georeference, georeference
from boxplus.systems.georeference.held import HELD, held, longest_hold
from tests.systems.georeference.drives import LAPS, Drive, drive

LEVER = (0.8, -0.3, 1.1)
RTK = GnssConfig(sigma=0.01, slow_sigma=0.01, claimed=0.02, lever=LEVER)


@pytest.fixture(scope="module")
def laps() -> Drive:
    return drive(LAPS)


def laid(one: Drive, fixes: GnssFixes) -> Georeference:
    return georeference(one.graph, fixes, one.time_ns, one.T_odo_imu, p_imu_antenna=np.array(LEVER))


def stuck(fixes: GnssFixes, begin_s: float, duration_s: float) -> GnssFixes:
    seconds = (fixes.time_ns - fixes.time_ns[0]) * 1e-9
    inside = (seconds >= begin_s) & (seconds < begin_s + duration_s)
    places = np.where(inside[:, None], fixes.lat_lon_alt[np.searchsorted(seconds, begin_s)], fixes.lat_lon_alt)
    return replace(fixes, lat_lon_alt=places)


@pytest.mark.parametrize("every", [2, 8])
def test_a_position_that_is_sent_several_times_counts_when_it_was_made(laps: Drive, every: int) -> None:
    fixes = laps.fixes(RTK)
    again = replace(fixes, lat_lon_alt=fixes.lat_lon_alt[np.arange(len(fixes)) // every * every])
    found = laid(laps, again)
    assert found.refusal is None and found.warnings == [] and found.contradiction is None
    assert laps.off(found).max() < 0.3
    assert found.left_out[HELD] == pytest.approx((1 - 1 / every) * len(fixes), abs=2)


@pytest.mark.parametrize("duration", [5.0, 20.0, 40.0])
def test_a_receiver_that_hangs_is_named_and_no_jump(laps: Drive, duration: float) -> None:
    found = laid(laps, stuck(laps.fixes(RTK), 20.0, duration))
    assert found.refusal is None and found.contradiction is None
    assert laps.off(found).max() < 1.0
    said = [text for text in found.warnings if text.startswith("the receiver repeated one position")]
    assert len(said) == (duration > 5.0)
    assert all(f"for {duration:.0f} s, from 20 s after its first fix on" in text for text in said)
    assert not any("contradict" in text or "jump" in text for text in found.warnings)


def test_a_receiver_that_never_moves_is_refused_by_that(laps: Drive) -> None:
    found = laid(laps, stuck(laps.fixes(RTK), 0.0, np.inf))
    assert found.refusal is not None and f"{HELD}" in found.refusal


@pytest.mark.parametrize("digits", [5, 6, 7])
@pytest.mark.parametrize("speed", [1.5, 8.0])
def test_positions_that_are_rounded_are_not_repeated(digits: int, speed: float) -> None:
    slow = drive(LAPS, 3, DriftConfig(speed=speed), stops=[(0.3, 40.0)])
    fixes = slow.fixes(RTK, 3)
    rounded = np.column_stack([np.round(fixes.lat_lon_alt[:, :2], digits), fixes.lat_lon_alt[:, 2]])
    assert HELD not in laid(slow, replace(fixes, lat_lon_alt=rounded)).left_out


def test_what_counts_as_repeated() -> None:
    places: NDArray[np.float64] = np.array(
        [[49.0, 8.0, 1.0], [49.0, 8.0, 1.0], [49.0, 8.0, 2.0], [49.0, 8.0, 2.0], [49.0000852, 8.0, 2.0], [49.0, 8.0, 2.0]]
    )
    p = np.column_stack([[0.0, 0.1, 0.5, 9.0, 9.5, 10.0], np.zeros((6, 2))])
    # the second stands; heights do not matter; what is left and come back to is another measurement
    assert held(places, p).tolist() == [False, False, True, True, False, False]
    hold = longest_hold(np.arange(6) * 4_000_000_000, places, p, held(places, p))
    assert hold is not None and (hold.begin, hold.duration, hold.metres) == (0.0, 12.0, 9.0) and hold.lasts
    assert held(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)
    assert longest_hold(np.arange(6), places, p, np.zeros(6, dtype=np.bool_)) is None


ROUTES = {"straight": [[0.0, 0.0], [400.0, 0.0]], "L": [[0.0, 0.0], [250.0, 0.0], [250.0, 200.0]]}


@pytest.mark.parametrize("every", [2, 5])
@pytest.mark.parametrize("speed", [1.5, 8.0])
@pytest.mark.parametrize("route", ROUTES)
def test_what_is_sent_again_is_told_on_a_way_that_never_comes_back(route: str, speed: float, every: int) -> None:
    """Where every position is new the smallest step between them is the way, and not what they are rounded to."""
    one = drive(ROUTES[route], 7, DriftConfig(speed=speed))
    fixes = one.fixes(RTK)
    again = fixes.lat_lon_alt[np.arange(len(fixes)) // every * every]
    p = np.column_stack([np.interp(fixes.time_ns, one.time_ns, one.T_odo_imu[:, 4 + k]) for k in range(3)])
    way = np.linalg.norm(p - p[np.arange(len(fixes)) // every * every], axis=1)
    np.testing.assert_array_equal(held(again, p)[:-every], (way > 0.2)[:-every])
    assert not held(fixes.lat_lon_alt, p).any()


@pytest.mark.parametrize("step", [1e-5, 1e-4 / 60.0, 1e-3 / 60.0])
def test_what_is_rounded_coarsely_is_not_held_and_one_odd_position_changes_nothing(step: float) -> None:
    metres = np.linspace(0.0, 300.0, 600)
    p = np.column_stack([metres, np.zeros((600, 2))])
    exact = np.column_stack([48.2 + np.degrees(metres / 6_378_137.0), np.full(600, 11.6), np.zeros(600)])
    rounded = np.round(exact / [step, step, 1.0]) * [step, step, 1.0]
    assert not held(rounded, p).any()
    rounded[300, 0] += 1e-9
    assert not held(rounded, p).any()


def test_an_antenna_that_stood_while_the_path_slid_is_where_it_was() -> None:
    """It goes on from where it was: the path is wrong, not the fixes. One that hung comes back where the path is."""
    seconds = np.arange(0.0, 60.0, 0.2)
    stands = (seconds >= 20.0) & (seconds < 40.0)
    metres = np.where(seconds < 20.0, seconds, np.where(stands, 20.0, seconds - 20.0))
    slides = metres + np.clip(0.25 * (seconds - 20.0), 0.0, 5.0)
    random = np.random.default_rng(3)
    noise = np.where(stands[:, None], 0.0, 0.005 * random.normal(size=(len(seconds), 2)))
    deg = np.degrees(1.0 / 6_378_137.0)
    fixes = np.column_stack([48.2 + deg * (metres + noise[:, 0]), 11.6 + deg * noise[:, 1], np.zeros(len(seconds))])
    assert not held(fixes, np.column_stack([slides, np.zeros((len(seconds), 2))])).any()
    went_on = np.column_stack([seconds, np.zeros((len(seconds), 2))])
    hung = np.where(stands[:, None], fixes[np.searchsorted(seconds, 20.0)], fixes)
    hung[seconds >= 40.0, 0] += 20.0 * deg
    assert held(hung, went_on)[(seconds > 20.6) & stands].all()
