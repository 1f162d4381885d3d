"""Odometry with lines beside corners, on simulated ones: truth, consistency, and lines that move."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from boxplus.systems.visual_inertial_odometry import VioConfig, VioEstimate, VisualInertialOdometry
from tests.systems.visual_inertial_odometry.lines.simulated_lines import LINE_SIGMA, SimulatedLines, run_with_lines
from tests.systems.visual_inertial_odometry.simulated_rays import PIXEL_SIGMA, Flight, at, rig, truth_relative_to_first
from tests.systems.visual_inertial_odometry.test_vio_simulated import position_and_yaw_error

CONFIG = VioConfig(pixel_sigma=PIXEL_SIGMA, line_sigma=LINE_SIGMA)


@pytest.fixture(scope="module")
def flown() -> tuple[Flight, VisualInertialOdometry, list[VioEstimate], SimulatedLines]:
    flight = Flight(51, 6.0)
    return flight, *run_with_lines(flight, rig(), CONFIG)


def test_lines_are_where_they_are_and_are_told(flown) -> None:
    flight, _, estimates, lines = flown
    known = [e for e in estimates if e.status != "starting"]
    last = known[-1]
    assert {e.status for e in known} == {"ok"} and last.lines_tracked >= 5
    assert max(e.lines_tracked + e.lines_rejected["does not fit the window"] for e in known[5:]) <= 20
    R, p = truth_relative_to_first(flight, known[0], at(flight, last))
    k = at(flight, last)
    truth = (lines.ends - flight.p[k]) @ flight.R[k] @ R.T + p
    d = truth[:, 1] - truth[:, 0]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    ends = last.line_ends.reshape(-1, 2, 3)
    off = np.linalg.norm(np.cross(ends[:, None] - truth[None, :, :1], d[None, :, None]), axis=3).max(axis=2).min(axis=1)
    assert len(last.line_ids) == len(ends) == len(off) > 8 and np.median(off) < 0.15


@pytest.mark.slow
def test_errors_of_position_and_yaw_have_the_covariance_stated() -> None:
    total, count = 0.0, 0
    for seed in range(80, 84):
        flight = Flight(seed, 5.0)
        _, estimates, _ = run_with_lines(flight, rig(), CONFIG)
        known = [e for e in estimates if e.status != "starting"]
        error, covariance = position_and_yaw_error(flight, known[0], known[-1])
        total, count = total + float(error @ np.linalg.solve(covariance, error)), count + 4
    low, high = chi2.ppf([0.025, 0.975], count)
    assert low < total < high


def test_lines_make_the_pose_more_certain(flown) -> None:
    flight, _, estimates, _ = flown
    _, without, _ = run_with_lines(flight, rig(), CONFIG, most=0)
    sigma = [np.sqrt(np.trace(run[-1].covariance[3:6, 3:6])) for run in (estimates, without)]
    assert sigma[0] < 0.9 * sigma[1]
    assert without[-1].lines_tracked == 0 == len(without[-1].line_ids)


def test_lines_that_move_on_their_own_are_left_out() -> None:
    flight = Flight(52, 5.0)
    _, estimates, _ = run_with_lines(flight, rig(), CONFIG, features=60, moving=0.5)
    known = [e for e in estimates if e.status != "starting"]
    late = [e for e in known if at(flight, e) > 640]
    assert sum(e.lines_rejected["does not fit the window"] for e in late) > 20
    error, covariance = position_and_yaw_error(flight, known[0], known[-1])
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(covariance))).all()


def test_with_lines_off_nothing_is_looked_for() -> None:
    vio = VisualInertialOdometry(CONFIG, rig(), object())  # type: ignore[arg-type]
    assert not CONFIG.lines and vio._line_tracker is None
    assert len(vio.window.lines) == 0
