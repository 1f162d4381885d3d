"""What `boxplus inspect` says about positions by satellite."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.gnss_checks import check_gnss, check_receivers
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.gnss import GnssConfig, simulate_gnss

ORIGIN = EnuFrame(49.0, 8.4, 115.0)
RATE = 0.1  # rad/s, to the left


def circle() -> tuple[np.ndarray, np.ndarray, ImuSamples]:
    """A minute to the left, 5 m/s."""
    t = np.arange(0.0, 60.0, 0.1)
    time_ns = np.rint(t * 1e9).astype(np.int64) + 10**18
    zero = np.zeros(len(t))
    q = np.column_stack([np.cos(0.5 * RATE * t), zero, zero, np.sin(0.5 * RATE * t)])
    p = 50.0 * np.column_stack([np.sin(RATE * t), 1.0 - np.cos(RATE * t), zero])
    imu = ImuSamples.from_arrays(time_ns, np.tile([0.0, 0.0, RATE], (len(t), 1)), np.tile([0.0, 0.5, 9.81], (len(t), 1)))
    return time_ns, np.hstack([q, p]), imu


def examined(config: GnssConfig, shift_ns: int = 0) -> dict[str, Evidence]:
    time_ns, poses, imu = circle()
    fixes = simulate_gnss(time_ns, poses, ORIGIN, config, seed=1).shifted(shift_ns)
    return {evidence.key: evidence for evidence in check_gnss(fixes, time_ns, imu)}


def test_a_good_receiver_is_found_good() -> None:
    found = examined(GnssConfig())
    assert {key for key, evidence in found.items() if evidence.verdict != "ok"} == set()
    assert found["gnss_rate"].value == "5.0 Hz" and "EPSG 32632" in found["gnss_place"].text
    assert float(found["gnss_turns"].value) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("config", "shift_ns", "key", "verdict"),
    [
        (GnssConfig(swapped=True), 0, "gnss_turns", "error"),
        (GnssConfig(), 10**12, "gnss_time", "error"),
        (GnssConfig(tunnels=1, tunnel_s=15.0), 0, "gnss_gaps", "warning"),
        (GnssConfig(claimed=None), 0, "gnss_sigma", "warning"),
        (GnssConfig(claimed=1e-5), 0, "gnss_sigma", "warning"),
        (GnssConfig(multipath=1, multipath_m=150.0), 0, "gnss_jumps", "warning"),
    ],
)
def test_what_is_wrong_is_said(config: GnssConfig, shift_ns: int, key: str, verdict: str) -> None:
    assert examined(config, shift_ns)[key].verdict == verdict


def test_metres_in_the_place_of_degrees_are_an_error_and_nothing_is_a_warning() -> None:
    time_ns, _, imu = circle()
    metres = GnssFixes.from_arrays(time_ns[:50], np.tile([456114.0, 5427629.0, 100.0], (50, 1)))
    found = {evidence.key: evidence for evidence in check_gnss(metres, time_ns, imu)}
    assert found["gnss_status"].verdict == "error" and "metres" in found["gnss_status"].text
    assert found["gnss_rate"].verdict == "warning"


@pytest.mark.parametrize(
    ("shift", "verdict", "word"),
    [
        ((0.5, 0.0, 0.5), "ok", ""),
        ((90.0, -120.0, 3.0), "error", "another datum"),
        ((0.0, 0.0, 48.0), "error", "heights above the sea"),
    ],
)
def test_two_receivers_that_differ_by_a_datum(shift: tuple[float, float, float], verdict: str, word: str) -> None:
    time_ns, poses, _ = circle()
    one, other = (
        simulate_gnss(time_ns, poses, ORIGIN, GnssConfig(datum_shift=by), seed) for seed, by in ((1, (0.0, 0.0, 0.0)), (2, shift))
    )
    (found,) = check_receivers({"/fix": one, "/rtk": other})
    assert found.verdict == verdict and word in found.text
    (late,) = check_receivers({"/fix": one, "/rtk": other.shifted(10**12)})
    assert late.verdict == "warning"
