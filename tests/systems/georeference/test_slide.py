"""Fixes that slide or turn slowly against an odometry: told as far as its covariance allows no such drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.gnss import GnssConfig
from boxplus.systems.georeference.georeference import Georeference, georeference
from tests.systems.georeference.drives import LAPS, ORIGIN, Drive, drive

LEVER = (0.8, -0.3, 1.1)
USUAL = GnssConfig(sigma=0.5, slow_sigma=0.5, claimed=0.7, lever=LEVER)
STEADY = DriftConfig(yaw_drift=1e-4, position_drift=0.003)


@pytest.fixture(scope="module")
def laps() -> Drive:
    return drive(LAPS, config=STEADY)


def moved(fixes: GnssFixes, slides: tuple[float, float], turns_deg: float) -> GnssFixes:
    """By so much from the begin to the end, and turned from half way on about where they are then."""
    p = ORIGIN.to_enu(fixes.lat_lon_alt)
    share = (fixes.time_ns - fixes.time_ns[0]) / (fixes.time_ns[-1] - fixes.time_ns[0])
    p[:, :2] += np.outer(share, slides)
    after, angle = share > 0.5, np.radians(turns_deg)
    arm = (p - p[np.argmax(after)])[after, :2]
    p[after, :2] += arm @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) - arm
    return replace(fixes, lat_lon_alt=ORIGIN.to_geodetic(p))


def found(
    given: Drive, slides: tuple[float, float] = (0.0, 0.0), turns_deg: float = 0.0, receiver: GnssConfig = USUAL, seed: int = 1
) -> Georeference:
    fixes = moved(given.fixes(receiver, seed), slides, turns_deg)
    return georeference(given.graph, fixes, given.time_ns, given.T_odo_imu, None, np.array(LEVER))


def shapes(result: Georeference) -> NDArray[np.float64]:
    """(N, 2, 2) of a slide over all of the recording."""
    t = result.attached.time_ns
    return ((t - t[0]) / (t[-1] - t[0]))[:, None, None] * np.eye(2)


def test_a_shift_is_what_the_fixes_were_moved_by(laps: Drive) -> None:
    """Of the same noise, moved and not: to first order the difference is what they were moved by, and its covariance the same."""
    still, slid = found(laps), found(laps, (2.0, -1.0))
    assert still.fit is not None and slid.fit is not None and still.used == slid.used == len(still.attached)
    a, b = (own.fit.shifts.along(shapes(own)) for own in (still, slid) if own.fit is not None)
    assert a is not None and b is not None
    np.testing.assert_allclose(b.size - a.size, [2.0, -1.0], atol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diag(b.covariance)), np.sqrt(np.diag(a.covariance)), rtol=0.05)


def test_a_shift_of_fixes_that_are_not_used_is_none(laps: Drive) -> None:
    result = found(laps)
    assert result.fit is not None
    used = result.fit.is_used.astype(float)
    assert replace(result.fit.shifts, information=0.0 * result.fit.shifts.information).along(shapes(result)) is None
    assert result.fit.shifts.along(shapes(result) * used[:, None, None]) is not None


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_slides_and_turns_beyond_what_may_go_unshown_are_named(laps: Drive, seed: int) -> None:
    sound = found(laps, seed=seed)
    assert sound.unshown is not None and sound.contradiction is None
    assert not any("against the odometry, which may not drift so" in text for text in sound.warnings)
    slid = found(laps, (2.0 * sound.unshown.slide_m, 0.0), seed=seed)
    assert slid.refusal is not None or any("fixes slide by" in text for text in slid.warnings)
    turned = found(laps, turns_deg=2.0 * sound.unshown.turn_deg, seed=seed)
    said = ("fixes turn by", "contradict the others")  # where it is turned by much, one of the two parts is gated
    assert turned.refusal is not None or any(words in text for text in turned.warnings for words in said)


def test_more_goes_unshown_where_the_odometry_drifts_more(laps: Drive) -> None:
    worse = found(drive(LAPS, config=DriftConfig(yaw_drift=1e-3, position_drift=0.03)))
    better = found(laps)
    assert worse.unshown is not None and better.unshown is not None
    assert worse.unshown.slide_m > 1.2 * better.unshown.slide_m and worse.unshown.turn_deg > 1.2 * better.unshown.turn_deg
