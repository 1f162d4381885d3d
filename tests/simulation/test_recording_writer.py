"""Simulations on disk: what the readers give back is what was simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from boxplus.cli.simulate import simulate_command
from boxplus.errors import InputError, OutputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.recordings.bags.open_container import open_container
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation, SimulationConfig, faults
from boxplus.simulation.bag_writer import BagFormat as Format
from boxplus.simulation.gnss import RECEIVERS
from boxplus.simulation.live_recording import IMU_TOPIC, LIDAR_TOPIC, fixes_of
from boxplus.simulation.recording_writer import write_recording
from tests.simulation.small_simulations import small


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return small("stress_fast", duration_s=4.0)


@pytest.mark.parametrize("format", ["ros2", "ros1"])
def test_round_trip(simulation: Simulation, tmp_path: Path, format: Format) -> None:
    shares: list[float] = []
    path = write_recording(simulation, tmp_path / "new" / "fast", format, progress=shares.append)
    assert path.name == ("fast" if format == "ros2" else "fast.bag")
    assert shares == sorted(shares)
    assert shares[-1] > 0.95
    with open_recording(path, RecordingOptions(gyro_unit="rad/s")) as recording:
        np.testing.assert_allclose(recording.info.T_imu_lidar, simulation.T_imu_lidar, atol=1e-12)
        assert recording.info.point_time.unit == "s"
        assert recording.info.accel_unit == "m/s2"
        events = list(recording.events())
    assert len(events) == 2 * simulation.scan_count + 1
    for written, original in zip(events, simulation.events(), strict=True):
        if isinstance(original, Scan):
            assert isinstance(written, Scan)
            np.testing.assert_array_equal(written.p_lidar, original.p_lidar)
            np.testing.assert_array_equal(written.intensity, original.intensity)
            assert np.abs(written.time_ns - original.time_ns).max() < 10
        else:
            assert isinstance(written, ImuSamples)
            np.testing.assert_array_equal(written.time_ns, original.time_ns)
            np.testing.assert_array_equal(written.gyro, original.gyro)
            np.testing.assert_array_equal(written.accel, original.accel)


def test_a_receiver_takes_part(simulation: Simulation, tmp_path: Path) -> None:
    path = write_recording(simulation, tmp_path / "fast", "ros2", gnss=RECEIVERS["good"])
    with open_recording(path, RecordingOptions(gyro_unit="rad/s")) as recording:
        written, lever = recording.fixes(), recording.info.p_imu_antenna
        scans = sum(isinstance(event, Scan) for event in recording)
    expected = fixes_of(simulation, RECEIVERS["good"])
    np.testing.assert_array_equal(written.time_ns, expected.time_ns)
    np.testing.assert_array_equal(written.lat_lon_alt, expected.lat_lon_alt)
    np.testing.assert_array_equal(written.covariance, expected.covariance)
    assert lever is not None and lever.tolist() == list(RECEIVERS["good"].lever) and scans == simulation.scan_count


def test_ground_truth_and_parameters_lie_beside_it(simulation: Simulation, tmp_path: Path) -> None:
    write_recording(simulation, tmp_path / "fast.bag", "ros1")
    truth = read_trajectory(tmp_path / "fast.gt.tum")
    exact = simulation.ground_truth(truth.time_ns)
    assert len(truth.time_ns) == 401
    np.testing.assert_allclose(truth.p, exact.p_world_imu, atol=1e-8)
    assert SimulationConfig.model_validate_json((tmp_path / "fast.json").read_text()) == simulation.config


def test_nan_reaches_the_disk(simulation: Simulation, tmp_path: Path) -> None:
    fault = faults.nan_burst(3.0, 0.3)
    path = write_recording(simulation, tmp_path / "nan", fault=fault)
    expected = sum(e.rejected.get("not finite", 0) for e in fault.events(simulation.events()) if isinstance(e, Scan))
    with open_recording(path, RecordingOptions(gyro_unit="rad/s")) as recording:
        samples = [event for event in recording.events() if isinstance(event, ImuSamples)]
        assert recording.rejected["points: not finite"] == expected > 0
    assert np.isnan(np.concatenate([block.accel for block in samples])).any(axis=1).sum() == 30


def test_an_inverted_mounting_is_declared(simulation: Simulation, tmp_path: Path) -> None:
    path = write_recording(simulation, tmp_path / "inverted", fault=faults.inverted_extrinsic())
    with open_recording(path, RecordingOptions(gyro_unit="rad/s")) as recording:
        np.testing.assert_allclose(recording.info.T_imu_lidar, np.linalg.inv(simulation.T_imu_lidar), atol=1e-12)


def test_empty_scans_and_backward_stamps_reach_the_disk(simulation: Simulation, tmp_path: Path) -> None:
    fault = faults.empty_scans(1.0, 0.3).then(faults.backward_stamps(2.0, 0.3))
    path = write_recording(simulation, tmp_path / "both", "ros1", fault)
    with open_recording(path, RecordingOptions(gyro_unit="rad/s")) as recording:
        events = list(recording.events())
    scans = [event for event in events if isinstance(event, Scan)]
    assert [len(scan) == 0 for scan in scans] == [10 <= index < 13 for index in range(simulation.scan_count)]
    imu_ns = np.concatenate([event.time_ns for event in events if isinstance(event, ImuSamples)])
    assert (np.diff(imu_ns) < 0).sum() == 1
    assert scans[20].start_ns < scans[19].start_ns


def test_refused(simulation: Simulation, tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match=r"got one that exists, .*taken – remove it or choose another name"):
        write_recording(simulation, tmp_path / "taken")
    with pytest.raises(InputError, match="expected the format 'ros2' or 'ros1' – got 'ros3'"):
        write_recording(simulation, tmp_path / "new", "ros3")  # type: ignore[arg-type]
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="something else of that name in the way"):
        write_recording(simulation, tmp_path / "file" / "walk")


app = Typer()
app.command()(simulate_command)


def test_command(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["at_rest", "-o", str(tmp_path), "--duration", "0.3", "--fault", "imu_in_g", "--seed", "3"])
    assert result.exit_code == 0, result.output
    assert "2 scans, 0.3 s" in result.output
    assert (tmp_path / "at_rest_imu_in_g" / "metadata.yaml").is_file()
    assert '"seed": 3' in (tmp_path / "at_rest_imu_in_g.json").read_text()
    listing = CliRunner().invoke(app, ["--list"]).output
    assert "stress_flips        flips at 1000 deg/s" in listing
    assert "wrong_time_unit" in listing
    assert isinstance(CliRunner().invoke(app, []).exception, InputError)


@pytest.mark.parametrize("fault", [faults.clock_offset(-0.3), faults.clock_offset(0.3), faults.wrong_time_unit(1000.0)])
def test_wrong_stamps_do_not_change_when_messages_arrive(simulation: Simulation, tmp_path: Path, fault: faults.Fault) -> None:
    received = []
    for name, spoilt in (("sound", None), ("faulty", fault)):
        container = open_container(write_recording(simulation, tmp_path / name, fault=spoilt))
        topics = frozenset((IMU_TOPIC, LIDAR_TOPIC))
        messages = container.messages(topics, container.start_ns, container.end_ns + 1)
        received.append([(channel.topic, received_ns) for channel, received_ns, _ in messages])
        container.close()
    assert len(received[0]) > 800
    assert received[0] == received[1]
