"""Points that were corrected for motion before are named, and clocks that are apart are not taken for such points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.simulation import faults
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.corrected_points import CorrectedPoints
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, FINE, corrected, data, handheld


def causes(agreement: Agreement, T_declared: np.ndarray) -> list[str]:
    return [finding.cause for finding in contradictions(agreement, T_declared)]


@pytest.mark.slow
@pytest.mark.parametrize("end", [True, False])
@pytest.mark.parametrize("seed", [1, 5, 9])
def test_corrected_points_are_named_and_to_which_instant(seed: int, end: bool) -> None:
    simulation = handheld(seed, lidar=FINE)
    agreement = compare_sensors(*data(simulation, corrected(simulation, end)), CONFIG, T_declared=simulation.T_imu_lidar)
    assert causes(agreement, simulation.T_imu_lidar) == ["corrected_points"]
    assert agreement.corrected is not None
    assert agreement.corrected.instant_s == pytest.approx(0.05 if end else -0.05, abs=0.01)
    assert ("its end" if end else "its beginning") in agreement.corrected.finding.text


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [0.05, -0.05, 0.1])
@pytest.mark.parametrize("seed", [1, 5])
def test_clocks_that_are_half_a_scan_apart_are_still_clocks(seed: int, offset_s: float) -> None:
    simulation = handheld(seed, lidar=FINE)
    spoilt = data(simulation, faults.lidar_clock_offset(offset_s))
    agreement = compare_sensors(*spoilt, CONFIG, T_declared=simulation.T_imu_lidar)
    assert agreement.corrected is None
    assert causes(agreement, simulation.T_imu_lidar) == ["time_offset"]


@pytest.mark.parametrize(("instant_s", "words"), [
    (0.05, "50 ms after the middle of each scan, its end;"),
    (-0.05, "50 ms before the middle of each scan, its beginning;"),
    (0.001, "1 ms after the middle of each scan, its middle;"),
    (0.2, "200 ms after the middle of each scan;"),
    (None, "have been corrected already; record"),
])  # fmt: skip
def test_the_finding_says_to_which_instant(instant_s: float | None, words: str) -> None:
    assert words in CorrectedPoints(0.02, 0.04, instant_s, 0.1, 0.04).finding.text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5, 9])
def test_times_that_run_backwards_are_not_taken_for_corrected_points(seed: int) -> None:
    simulation = handheld(seed, lidar=FINE)
    scans, imu = data(simulation)
    reversed_ = [replace(scan, time_ns=scan.start_ns + scan.end_ns - scan.time_ns) for scan in scans]
    ages = [scan.shifted(scan.end_ns - scan.start_ns) for scan in reversed_]  # before a stamp at the end, read as after it
    for spoilt in (reversed_, ages):
        agreement = compare_sensors(spoilt, imu, CONFIG, T_declared=simulation.T_imu_lidar)
        assert causes(agreement, simulation.T_imu_lidar) == ["reversed_times"]


def test_the_finding_says_that_times_run_backwards() -> None:
    found = CorrectedPoints(0.04, 0.05, 0.01, 0.1, 0.02).finding
    assert found.cause == "reversed_times" and "to 2.0 cm, and as the times are to 5.0 cm only" in found.text
