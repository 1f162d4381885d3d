"""Real flights from the middle on, as a user runs them."""

from __future__ import annotations

from pathlib import Path

import pytest

from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.open import open_recording
from boxplus.recordings.options import RecordingOptions
from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.odometry_run import run_odometry


@pytest.mark.slow
def test_a_flight_that_is_joined_after_eight_seconds_is_followed_to_centimetres(shared_data: Path, tmp_path: Path) -> None:
    """In full flight specific force stays along the thrust, and the gyroscope must not be taken for one in deg/s for it."""
    folder = shared_data / "recordings"
    with open_recording(folder / "v103_velodyne.bag", RecordingOptions(start_s=8.0)) as recording:
        assert recording.info.gyro_unit == "rad/s"
        summary = run_odometry(recording, tmp_path / "run", RunConfig(map=MapConfig(save=False)))
    assert set(summary.status) == {"ok"} and summary.scans > 130 and summary.contradiction is None
    truth = read_trajectory(folder / "v103_velodyne.gt.tum", "tum")
    found = evaluate(read_trajectory(tmp_path / "run" / "trajectory.csv"), truth, method="interpolate")
    assert found.ate.rmse < 0.03
