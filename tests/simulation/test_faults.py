"""Every fault does what it says and leaves the rest alone."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation, faults
from boxplus.simulation.live_recording import as_recording
from tests.simulation.small_simulations import small


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return small("stress_fast", duration_s=4.0)


def run(simulation: Simulation, fault: faults.Fault | None) -> tuple[list[Scan], ImuSamples]:
    events = list(simulation.events() if fault is None else fault.events(simulation.events()))
    blocks = [event for event in events if isinstance(event, ImuSamples)]
    assert all(len(block) for block in blocks)
    columns = [np.concatenate([getattr(block, name) for block in blocks]) for name in ("time_ns", "gyro", "accel")]
    return [event for event in events if isinstance(event, Scan)], ImuSamples(*columns)


def same_scans(first: list[Scan], second: list[Scan]) -> None:
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.p_lidar, b.p_lidar)
        np.testing.assert_array_equal(a.time_ns, b.time_ns)


def same_imu(first: ImuSamples, second: ImuSamples) -> None:
    np.testing.assert_array_equal(first.time_ns, second.time_ns)
    np.testing.assert_array_equal(first.gyro, second.gyro)
    np.testing.assert_array_equal(first.accel, second.accel)


def interval(simulation: Simulation, imu: ImuSamples, start_s: float, duration_s: float) -> np.ndarray:
    since = (imu.time_ns - simulation.start_ns) * 1e-9
    return (since >= start_s) & (since < start_s + duration_s)


def test_drop_imu(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.drop_imu(1.0, 0.5))
    same_scans(scans, spoilt_scans)
    keep = ~interval(simulation, imu, 1.0, 0.5)
    assert keep.sum() == len(imu) - 100
    same_imu(ImuSamples(imu.time_ns[keep], imu.gyro[keep], imu.accel[keep]), spoilt)


def test_drop_scans(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.drop_scans(1.0, 0.3))
    same_imu(imu, spoilt)
    same_scans(scans[:10] + scans[13:], spoilt_scans)


def test_empty_scans(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.empty_scans(1.0, 0.3))
    same_imu(imu, spoilt)
    assert [len(scan) == 0 for scan in spoilt_scans] == [10 <= index < 13 for index in range(len(scans))]
    assert [scan.start_ns for scan in spoilt_scans] == [scan.start_ns for scan in scans]


def test_repeat_stamps(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    fault = faults.repeat_stamps(1.0, 0.3)
    for _ in range(2):  # a fault may be used again
        spoilt_scans, spoilt = run(simulation, fault)
        inside = interval(simulation, imu, 1.0, 0.3)
        assert (np.diff(spoilt.time_ns) == 0).sum() == 59
        np.testing.assert_array_equal(spoilt.time_ns[~inside], imu.time_ns[~inside])
        np.testing.assert_array_equal(spoilt.accel, imu.accel)
        assert [scan.start_ns for scan in spoilt_scans[10:13]] == [scans[10].start_ns] * 3
        np.testing.assert_array_equal(spoilt_scans[12].p_lidar, scans[12].p_lidar)
        assert spoilt_scans[13].start_ns == scans[13].start_ns


def test_backward_stamps(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.backward_stamps(1.0, 0.3, jump_s=0.7))
    np.testing.assert_array_equal(imu.time_ns - spoilt.time_ns, 700_000_000 * interval(simulation, imu, 1.0, 0.3))
    assert [a.start_ns - b.start_ns for a, b in zip(scans, spoilt_scans, strict=True)][9:14] == [0] + [700_000_000] * 3 + [0]
    np.testing.assert_array_equal(scans[10].time_ns - spoilt_scans[10].time_ns, 700_000_000)


def test_nan_burst(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.nan_burst(1.0, 0.3))
    bad = np.isnan(spoilt.gyro).all(axis=1) & np.isnan(spoilt.accel).all(axis=1)
    assert 29 <= bad.sum() <= 32
    assert not (bad & ~interval(simulation, imu, 1.0, 0.3)).any()
    np.testing.assert_array_equal(spoilt.accel[~bad], imu.accel[~bad])
    assert [scan.rejected.get("not finite", 0) for scan in spoilt_scans[9:14]] == [
        0,
        *((len(scan) + 1) // 2 for scan in scans[10:13]),
        0,
    ]


def test_units(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, in_g = run(simulation, faults.imu_in_g())
    same_scans(scans, spoilt_scans)
    np.testing.assert_allclose(in_g.accel * 9.80665, imu.accel, rtol=1e-12)
    np.testing.assert_array_equal(in_g.gyro, imu.gyro)
    _, in_deg = run(simulation, faults.gyro_in_deg())
    np.testing.assert_allclose(np.deg2rad(in_deg.gyro), imu.gyro, rtol=1e-12)
    np.testing.assert_array_equal(in_deg.accel, imu.accel)


def test_saturate_accel(simulation: Simulation) -> None:
    _, imu = run(simulation, None)
    _, spoilt = run(simulation, faults.saturate_accel(9.0))
    np.testing.assert_array_equal(spoilt.accel, np.clip(imu.accel, -9.0, 9.0))
    assert (spoilt.accel == 9.0).any()
    np.testing.assert_array_equal(spoilt.gyro, imu.gyro)


def test_wrong_time_unit(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.wrong_time_unit(1e-3))
    same_imu(imu, spoilt)
    for a, b in zip(scans, spoilt_scans, strict=True):
        np.testing.assert_array_equal(a.p_lidar, b.p_lidar)
        np.testing.assert_allclose((b.time_ns - b.start_ns) * 1000.0, a.time_ns - a.start_ns, atol=501.0)
        assert (a.start_ns, b.end_ns) == (b.start_ns, int(b.time_ns.max()))


def test_inverted_extrinsic(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    fault = faults.inverted_extrinsic()
    spoilt_scans, spoilt = run(simulation, fault)
    same_scans(scans, spoilt_scans)
    same_imu(imu, spoilt)
    declared = as_recording(simulation, fault).info.T_imu_lidar
    assert declared is not None
    np.testing.assert_allclose(declared @ simulation.T_imu_lidar, np.eye(4), atol=1e-12)


def test_signs_and_units_of_the_imu(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    for fault, gyro, accel in (
        (faults.flip_gyro(), -1.0, 1.0),
        (faults.flip_accel(), 1.0, -1.0),
        (faults.gyro_in_rad_as_deg(), np.pi / 180.0, 1.0),
    ):
        spoilt_scans, spoilt = run(simulation, fault)
        same_scans(scans, spoilt_scans)
        np.testing.assert_array_equal(spoilt.time_ns, imu.time_ns)
        np.testing.assert_allclose(spoilt.gyro, gyro * imu.gyro)
        np.testing.assert_allclose(spoilt.accel, accel * imu.accel)


def test_clocks(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.clock_offset(-0.25))
    same_scans(scans, spoilt_scans)
    np.testing.assert_array_equal(spoilt.time_ns, imu.time_ns - 250_000_000)
    fault = faults.clock_drift(0.01)
    for _ in range(2):
        spoilt_scans, spoilt = run(simulation, fault)
        same_scans(scans, spoilt_scans)
        np.testing.assert_allclose(np.diff(spoilt.time_ns), 1.01 * np.diff(imu.time_ns), atol=1.0)
        assert spoilt.time_ns[0] == imu.time_ns[0]


def test_the_imu_of_another_body(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    other = small("stress_drone", seed=1, duration_s=4.0)
    spoilt_scans, spoilt = run(simulation, faults.other_imu(other.imu_samples))
    same_scans(scans, spoilt_scans)
    same_imu(run(other, None)[1], spoilt)
    assert np.abs(spoilt.gyro - imu.gyro).max() > 0.1


def test_scaled_and_mirrored_points(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    for fault, factors in ((faults.scale_points(1.1), (1.1, 1.1, 1.1)), (faults.mirror_points(2), (1.0, 1.0, -1.0))):
        spoilt_scans, spoilt = run(simulation, fault)
        same_imu(imu, spoilt)
        for scan, before in zip(spoilt_scans, scans, strict=True):
            np.testing.assert_allclose(scan.p_lidar, before.p_lidar * np.float32(factors), rtol=1e-6)
            np.testing.assert_array_equal(scan.time_ns, before.time_ns)


def test_permuted_axes(simulation: Simulation) -> None:
    scans, imu = run(simulation, None)
    spoilt_scans, spoilt = run(simulation, faults.permute_gyro())
    same_scans(scans, spoilt_scans)
    np.testing.assert_array_equal(spoilt.gyro, imu.gyro[:, [1, 2, 0]])
    np.testing.assert_array_equal(spoilt.accel, imu.accel)
    spoilt_scans, spoilt = run(simulation, faults.permute_points((1, 0, 2)))
    same_imu(imu, spoilt)
    for scan, before in zip(spoilt_scans, scans, strict=True):
        np.testing.assert_array_equal(scan.p_lidar, before.p_lidar[:, [1, 0, 2]])
        np.testing.assert_array_equal(scan.time_ns, before.time_ns)
    assert faults.permute_points((1, 0, 2)).description == "coordinates yxz of points as xyz"


def test_declared_mountings(simulation: Simulation) -> None:
    other = np.linalg.inv(simulation.T_imu_lidar)
    info = as_recording(simulation, faults.declare(other)).info
    np.testing.assert_array_equal(info.T_imu_lidar, other)
    silent = as_recording(simulation, faults.inverted_extrinsic().then(faults.declare(None))).info
    assert (silent.T_imu_lidar, silent.T_imu_lidar_source) == (None, "")
    assert faults.inverted_extrinsic().declared_extrinsic(None) is None


def test_faults_compose(simulation: Simulation) -> None:
    both = faults.drop_scans(1.0, 0.3).then(faults.imu_in_g()).then(faults.inverted_extrinsic())
    assert both.name == "drop_scans+imu_in_g+inverted_extrinsic"
    scans, imu = run(simulation, both)
    assert len(scans) == simulation.scan_count - 3
    assert np.median(np.linalg.norm(imu.accel, axis=1)) == pytest.approx(1.0, abs=0.1)


def test_registered_faults_leave_the_start_alone(simulation: Simulation) -> None:
    clean = repr([(len(event), event.time_ns[:3]) for event in simulation.events()])
    for name, make in faults.FAULTS.items():
        fault = make()
        assert (fault.name, bool(fault.description)) == (name, True)
        # The intervals of the defaults begin after 10 s: nothing arrives at another time before.
        if name not in ("wrong_time_unit", "clock_offset", "clock_drift"):
            assert repr([(len(event), event.time_ns[:3]) for event in fault.events(simulation.events())]) == clean
    with pytest.raises(InputError, match=r"expected the name of a fault – got .* – .*the faults are: drop_imu, drop_scans"):
        faults.make_fault("gremlins")


def test_as_recording(simulation: Simulation) -> None:
    recording = as_recording(simulation, faults.nan_burst(1.0, 0.3))
    events = list(recording.events())
    assert recording.progress == 1.0
    assert recording.rejected["points: not finite"] > 100
    assert recording.info.message_count == sum(len(e) if isinstance(e, ImuSamples) else 1 for e in events)
    np.testing.assert_array_equal(recording.info.T_imu_lidar, simulation.T_imu_lidar)
