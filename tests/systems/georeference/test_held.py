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
    assert all(f"for {duration:.0f} s from 20 s on" in text for text in said)
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
        [[49.0, 8.0, 1.0], [49.0, 8.0, 1.0], [49.0, 8.0, 2.0], [49.0, 8.0, 2.0], [49.0000001, 8.0, 2.0], [49.0, 8.0, 2.0]]
    )
    p = np.column_stack([[0.0, 0.1, 0.5, 9.0, 9.5, 10.0], np.zeros((6, 2))])
    # the second stands; heights do not matter; what is left and come back to is another measurement
    assert held(places, p).tolist() == [False, False, True, True, False, False]
    hold = longest_hold(np.arange(6) * 4_000_000_000, places, p, held(places, p))
    assert hold is not None and (hold.begin, hold.duration, hold.metres) == (0.0, 12.0, 9.0) and hold.lasts
    assert held(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)
    assert longest_hold(np.arange(6), places, p, np.zeros(6, dtype=np.bool_)) is None
