"""Fixes that say how far they are off do not jump, and a datum that jumps beside them does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.gnss import GnssConfig
from boxplus.systems.georeference.georeference import Georeference, georeference
from tests.systems.georeference.drives import LAPS, ORIGIN, Drive, drive

LEVER = (0.8, -0.3, 1.1)
RTK = GnssConfig(sigma=0.01, slow_sigma=0.01, claimed=0.02, lever=LEVER)
SLOW = DriftConfig(speed=3.0)


def lost(fixes: GnssFixes, begin: float, duration: float, stated: float, seed: int) -> GnssFixes:
    """Fixes that are not fixed from a share of the recording on for some seconds: as far off as they state, all by the same."""
    random, seconds = np.random.default_rng(seed), (fixes.time_ns - fixes.time_ns[0]) * 1e-9
    inside = (seconds >= begin * seconds[-1]) & (seconds < begin * seconds[-1] + duration)
    turn = random.uniform(0.0, 2.0 * np.pi)
    p, covariance = ORIGIN.to_enu(fixes.lat_lon_alt), fixes.covariance.copy()
    p[inside, :2] += stated * np.array([np.cos(turn), np.sin(turn)]) + 0.1 * stated * random.standard_normal((inside.sum(), 2))
    covariance[inside] = stated**2 * np.diag([1.0, 1.0, 4.0])
    return replace(fixes, lat_lon_alt=ORIGIN.to_geodetic(p), covariance=covariance)


def laid(given: Drive, fixes: GnssFixes) -> Georeference:
    return georeference(given.graph, fixes, given.time_ns, given.T_odo_imu, None, np.array(LEVER))


def jumps(result: Georeference) -> bool:
    return any("fixes jump by" in text for text in [*result.warnings, result.contradiction or ""])


@pytest.mark.parametrize("seed", [4, 8, 11, 12])
def test_rtk_that_loses_its_fixed_solution_and_says_so_does_not_jump(seed: int) -> None:
    """Its fixes were held against what most state, or the more of both sides, each for itself: one such map in five jumped."""
    given, random = drive(LAPS, seed, SLOW), np.random.default_rng(seed)
    fixes = lost(given.fixes(RTK, seed), random.uniform(0.1, 0.6), random.uniform(30.0, 60.0), random.uniform(0.2, 0.6), seed)
    result = laid(given, fixes)
    assert result.fit is not None and not jumps(result)
    assert given.off(result).max() < 4.0 * np.sqrt(2.0) * result.fit.sigma.max()


def test_stretches_that_are_not_fixed_hide_no_jump() -> None:
    """Six of them, whose begins and ends are larger steps than the datum's."""
    given = drive([*LAPS, [0, 60], [0, 0], [120, 0]], 3, SLOW)
    jumped = given.fixes(RTK.model_copy(update={"jump": (0.4, 0.3, 0.0)}), 3)
    sound = given.fixes(RTK, 3)
    for begin in (0.1, 0.2, 0.3, 0.6, 0.7, 0.8):
        jumped, sound = (lost(fixes, begin, 10.0, 0.6, round(10.0 * begin)) for fixes in (jumped, sound))
    said, silent = laid(given, jumped), laid(given, sound)
    assert said.contradiction is not None and "fixes jump by 0." in said.contradiction
    assert silent.fit is not None and not jumps(silent)


def test_a_jump_that_the_map_bends_along_with_is_told() -> None:
    """No means of five fixes stepped, as the odometry may drift by as much: off by four standard deviations without a word."""
    given = drive(LAPS, 12)
    result = laid(given, given.fixes(RTK.model_copy(update={"jump": (0.28, 0.21, 0.0)}), 12))
    assert result.contradiction is not None and "fixes jump by 0." in result.contradiction
