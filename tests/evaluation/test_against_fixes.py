"""A trajectory against positions by satellite: errors at the antenna, alignments, refusals, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from boxplus.cli.eval import evaluate_command
from boxplus.errors import InputError, RecordingError
from boxplus.evaluation.against_fixes import compare_with_fixes
from boxplus.formats.trajectory import Trajectory, write_tum
from boxplus.manifolds import se3
from boxplus.recordings.gnss_source import read_fixes
from boxplus.runs.slam.gnss_output import read_origin
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.simulation.gnss import GnssConfig, simulate_gnss
from boxplus.systems.georeference.held import HELD
from tests.bags import START_NS, Content, write_bag

ORIGIN = EnuFrame(49.0, 8.4, 115.0)
LEVER = (0.5, -0.2, 1.0)
EXACT = GnssConfig(sigma=0.0, slow_sigma=0.0, claimed=0.1, lever=LEVER)


def eight(count: int = 400) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    t = np.linspace(0.0, 40.0, count)
    p = np.column_stack([20.0 * np.sin(0.3 * t), 10.0 * np.sin(0.6 * t), 0.1 * t])
    yaw = np.arctan2(6.0 * np.cos(0.6 * t), 6.0 * np.cos(0.3 * t))
    q = np.column_stack([np.cos(0.5 * yaw), 0.0 * t, 0.0 * t, np.sin(0.5 * yaw)])
    return START_NS + np.rint(t * 1e9).astype(np.int64), np.hstack([q, p])


def trajectory(time_ns: NDArray[np.int64], T: NDArray[np.float64]) -> Trajectory:
    return Trajectory(time_ns, T[:, 4:], T[:, :4])


def test_a_trajectory_that_is_turned_and_moved_agrees() -> None:
    time_ns, T = eight()
    turn = np.array([np.cos(0.6), 0.0, 0.0, np.sin(0.6), 100.0, -50.0, 7.0])
    fixes = simulate_gnss(time_ns, T, ORIGIN, EXACT)
    found = compare_with_fixes(trajectory(time_ns, se3.compose(turn, T)), fixes, lever_arm=LEVER)
    assert found.horizontal.max < 1e-4 and found.vertical.max < 1e-4  # verticals of two origins 20 m apart differ by 3 µrad
    assert found.sigma_m == pytest.approx(0.1)
    without = compare_with_fixes(trajectory(time_ns, T), fixes)
    assert without.horizontal.rmse > 0.2 and any("no lever arm" in text for text in without.warnings)


def test_without_alignment_the_origin_counts() -> None:
    time_ns, T = eight()
    fixes = simulate_gnss(time_ns, T, ORIGIN, EXACT)
    moved = trajectory(time_ns, se3.compose([1.0, 0, 0, 0, 3.0, 4.0, 0], T))
    found = compare_with_fixes(moved, fixes, alignment="none", frame=ORIGIN, lever_arm=LEVER)
    assert found.horizontal.mean == pytest.approx(5.0, abs=1e-6)
    with pytest.raises(InputError, match="origin"):
        compare_with_fixes(moved, fixes, alignment="none")


def test_multipath_is_doubted_and_what_cannot_be_compared_refused() -> None:
    time_ns, T = eight()
    fixes = simulate_gnss(time_ns, T, ORIGIN, GnssConfig(sigma=0.1, slow_sigma=0.0, multipath=1, multipath_s=2.0), seed=2)
    found = compare_with_fixes(trajectory(time_ns, T), fixes, lever_arm=(0, 0, 0))
    assert found.horizontal.median < 0.2 and found.horizontal.max > 15.0  # and turns nothing
    assert any("multipath" in text for text in found.warnings)
    with pytest.raises(InputError, match="same clock"):
        compare_with_fixes(trajectory(time_ns, T), fixes.shifted(10**12))
    late = compare_with_fixes(trajectory(time_ns - 10**12, T), fixes, offset_s=1000.0)
    assert len(late.time_ns) == len(found.time_ns)
    with pytest.raises(InputError, match="lever_arm"):
        compare_with_fixes(trajectory(time_ns, T), fixes, lever_arm=[1.0])


def test_positions_that_a_receiver_repeats_are_no_error_of_the_trajectory() -> None:
    time_ns, T = eight()
    fixes = simulate_gnss(time_ns, T, ORIGIN, GnssConfig(sigma=0.1, slow_sigma=0.0))
    rows = np.arange(len(fixes))
    for hangs, is_said in ((rows // 5 * 5, False), (np.where((rows >= 50) & (rows < 100), 50, rows), True)):
        found = compare_with_fixes(
            trajectory(time_ns, T), replace(fixes, lat_lon_alt=fixes.lat_lon_alt[hangs]), lever_arm=[0, 0, 0]
        )
        assert found.horizontal.max < 1.0
        assert found.rejected == {HELD: int((hangs != rows).sum())} and found.unmatched == 0
        assert (
            any("repeated one position for 10 s, from 10 s after its first fix on" in text for text in found.warnings) == is_said
        )
    with pytest.raises(InputError, match="it hangs"):
        compare_with_fixes(
            trajectory(time_ns, T), replace(fixes, lat_lon_alt=np.repeat(fixes.lat_lon_alt[:1], len(fixes), axis=0))
        )


def test_the_command_compares_with_the_fixes_of_a_bag(tmp_path: Path) -> None:
    time_ns, T = eight(60)
    fixes = simulate_gnss(time_ns[:12], T[:12], ORIGIN, EXACT)
    places: list[tuple[float, float, float]] = [(lat, lon, alt) for lat, lon, alt in fixes.lat_lon_alt.tolist()]
    rows = [(int(t) - START_NS, place, 0) for t, place in zip(fixes.time_ns, places, strict=True)]
    bag = write_bag(tmp_path, "ros1", Content(fixes=rows, scans=2))
    write_tum(tmp_path / "trajectory.tum", trajectory(time_ns, T))
    app = typer.Typer()
    app.command()(evaluate_command)
    arguments = [str(tmp_path / "trajectory.tum"), str(bag), "--gnss-lever-arm", "0.5,-0.2,1"]
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0 and "on the ground" in shown.output, shown.output
    (tmp_path / "georeference.yaml").write_text("origin: {latitude_deg: 49.0, longitude_deg: 8.4, height_m: 115.0}\n")
    told = CliRunner().invoke(app, [*arguments, "--align", "none", "--json"])
    assert json.loads(told.output)["horizontal_m"]["max"] < 1e-3  # a TUM file has six digits
    (tmp_path / "georeference.yaml").write_text("origin: 3\n")
    with pytest.raises(InputError, match=r"georeference\.yaml"):
        read_origin(tmp_path)


def test_where_fixes_are_read_from(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no file"):
        read_fixes(tmp_path / "nothing")
    with pytest.raises(RecordingError, match="positions"):
        read_fixes(write_bag(tmp_path, "ros1", Content(scans=1)))
    (tmp_path / "oxts" / "data").mkdir(parents=True)
    (tmp_path / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.0\n2011-09-26 13:02:25.1\n")
    for k in range(2):
        row = np.zeros(30)
        row[:3], row[27] = (49.0, 8.4, 110.0), 3
        (tmp_path / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, row)))
    for folder in (tmp_path / "oxts", tmp_path):
        assert read_fixes(folder).lat_lon_alt.tolist() == [[49.0, 8.4, 110.0]] * 2
