"""Rotation between LiDAR and IMU, time offset and gyro scale, against exact motions."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.sensors import scan_registration
from boxplus.sensors.gyro_attitude import GyroAttitude
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.lidar_rotation import align_rotations, estimate_rotation_extrinsic
from boxplus.sensors.scan import Scan
from boxplus.sensors.scan_registration import LidarRotations, lidar_rotations

START_NS = 1_700_000_000_000_000_000


class Swing:
    """A body that swings about its three axes, with chosen amplitudes [rad]."""

    def __init__(self, amplitude: tuple[float, float, float]) -> None:
        self.amplitude = np.array(amplitude)

    def attitude(self, time_s: NDArray[np.float64]) -> Rotation:
        phase = np.outer(time_s, [2.1, 2.7, 1.7]) + np.array([0.0, 1.0, 2.0])
        return Rotation.from_rotvec(self.amplitude * np.sin(phase))

    def imu(self, seconds: float, scale: float = 1.0, bias: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ImuSamples:
        time = np.arange(round(seconds * 200)) / 200
        before, after = self.attitude(time - 1e-4), self.attitude(time + 1e-4)
        gyro = (before.inv() * after).as_rotvec() / 2e-4
        accel = self.attitude(time).inv().apply([0.0, 0.0, 9.81])
        return ImuSamples.from_arrays(START_NS + np.rint(time * 1e9).astype(np.int64), scale * (gyro + bias), accel)

    def lidar(self, R_imu_lidar: NDArray[np.float64], offset_s: float, seconds: float, noise: float, seed: int) -> LidarRotations:
        time = np.arange(0.4, seconds - 0.4, 0.1)
        R = self.attitude(time + offset_s)
        turned = (R[:-1].inv() * R[1:]).as_rotvec() @ R_imu_lidar
        turned += np.random.default_rng(seed).normal(size=turned.shape) * noise
        stamps = START_NS + np.rint(time * 1e9).astype(np.int64)
        return LidarRotations(stamps[:-1], stamps[1:], turned, np.zeros_like(turned), 0)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 1000),
    offset=st.floats(-0.15, 0.15),
    degrees=st.booleans(),
    bias=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
)
def test_everything_is_recovered(seed: int, offset: float, degrees: bool, bias: tuple[float, float, float]) -> None:
    swing = Swing((0.2, 0.15, 0.25))
    R_imu_lidar = Rotation.random(random_state=seed).as_matrix()
    scale = 180 / np.pi if degrees else 1.0
    found = align_rotations(swing.lidar(R_imu_lidar, offset, 12.0, 1e-4, seed), swing.imu(12.0, scale, bias))
    assert np.degrees(np.linalg.norm(so3.log(found.R_imu_lidar.T @ R_imu_lidar))) < 0.3
    assert abs(found.time_offset_s - offset) < 0.003
    assert found.time_offset_std_s < 0.005
    assert abs(found.gyro_scale / scale - 1) < 0.02
    np.testing.assert_allclose(found.gyro_bias, scale * np.array(bias), atol=0.01 * scale)
    assert found.observable_axes == 3


@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_standard_deviations_are_honest(seed: int) -> None:
    swing = Swing((0.2, 0.05, 0.1))
    R_imu_lidar = Rotation.random(random_state=seed).as_matrix()
    found = align_rotations(swing.lidar(R_imu_lidar, 0.0, 12.0, 3e-3, seed), swing.imu(12.0))
    error_deg = np.degrees(found.axes.T @ so3.log(found.R_imu_lidar @ R_imu_lidar.T))
    assert (np.abs(error_deg) < 5 * found.std_deg).all()
    assert (found.std_deg < 3).all()


def test_turning_about_one_axis_leaves_one_unknown() -> None:
    swing = Swing((0.0, 0.0, 0.3))
    R_imu_lidar = Rotation.from_euler("z", 0.4).as_matrix()
    found = align_rotations(swing.lidar(R_imu_lidar, 0.0, 12.0, 1e-3, 1), swing.imu(12.0))
    assert found.observable_axes == 2
    assert "known about two axes only" in found.text and "turn about more axes" in found.text
    # The axis itself is found; about it, the rotation stays near identity.
    np.testing.assert_allclose(np.abs(found.axes[:, 2]), [0.0, 0.0, 1.0], atol=0.02)
    np.testing.assert_allclose(found.R_imu_lidar[:, 2], [0.0, 0.0, 1.0], atol=0.05)


def test_without_motion_nothing_is_claimed() -> None:
    swing = Swing((0.0, 0.0, 0.0))
    found = align_rotations(swing.lidar(np.eye(3), 0.0, 6.0, 1e-3, 1), swing.imu(6.0))
    assert found.observable_axes == 0 and (found.std_deg > 3).all()


def test_too_few_intervals() -> None:
    swing = Swing((0.2, 0.1, 0.1))
    with pytest.raises(InputError, match=r"at least 10 scan pairs within the IMU samples.*give a longer stretch"):
        align_rotations(swing.lidar(np.eye(3), 0.0, 1.2, 0.0, 1), swing.imu(1.2))
    nothing = ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
    with pytest.raises(InputError, match="at least 10 scan pairs"):
        align_rotations(swing.lidar(np.eye(3), 0.0, 5.0, 0.0, 1), nothing)
    with pytest.raises(InputError, match="at least 10 scan pairs"):
        estimate_rotation_extrinsic([], swing.imu(3.0))


def test_attitude_is_the_integral_of_the_rate() -> None:
    swing = Swing((0.5, 0.4, 0.6))
    imu = swing.imu(4.0)
    time_s = np.linspace(0.0, 3.9, 40)
    R = GyroAttitude(imu.time_ns, imu.gyro).at(START_NS + np.rint(time_s * 1e9).astype(np.int64))
    expected = (swing.attitude(np.zeros(40)).inv() * swing.attitude(time_s)).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-4)


def room_scan(R: Rotation, position: NDArray[np.float64], time_ns: NDArray[np.int64], rng: np.random.Generator) -> Scan:
    """One spinning scan of a box room of 8 x 6 x 3 m, every point seen from the pose of its own instant."""
    azimuth = -2 * np.pi * np.arange(len(time_ns)) / len(time_ns) * 5
    elevation = np.radians(rng.uniform(-35, 35, len(time_ns)))
    ray = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), axis=1)
    world = R.apply(ray)
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.where(world > 0, np.array([4.0, 3.0, 1.6]), np.array([-4.0, -3.0, -1.4]))
        reach = np.where(world == 0, np.inf, (walls - position) / world)
    distance = reach.min(axis=1) + rng.normal(size=len(ray)) * 0.01
    return Scan.from_arrays((ray * distance[:, None]).astype(np.float32), time_ns)


def test_scans_of_a_room_give_rotation_and_extrinsic() -> None:
    swing = Swing((0.3, 0.2, 0.35))
    R_imu_lidar = Rotation.from_euler("xyz", [0.5, -0.4, 1.2])
    rng = np.random.default_rng(0)
    scans = []
    for k in range(30):
        offset_s = 0.1 * k + 0.1 * np.arange(3000) / 3000
        R_world_lidar = swing.attitude(offset_s) * R_imu_lidar
        position = np.stack((0.3 * np.sin(offset_s), 0.2 * offset_s, 0.1 * np.sin(2 * offset_s)), axis=1)
        scans.append(room_scan(R_world_lidar, position, START_NS + np.rint(offset_s * 1e9).astype(np.int64), rng))
    lidar = lidar_rotations(scans)
    assert len(lidar.rotation) == 29 and lidar.failed == 0
    begin, end = ((t - START_NS) * 1e-9 for t in (lidar.begin_ns, lidar.end_ns))
    R_begin, R_end = swing.attitude(begin) * R_imu_lidar, swing.attitude(end) * R_imu_lidar
    error_deg = np.degrees(np.linalg.norm(lidar.rotation - (R_begin.inv() * R_end).as_rotvec(), axis=1))
    assert np.median(error_deg) < 0.25
    found = estimate_rotation_extrinsic(scans, swing.imu(3.2))
    assert np.degrees(np.linalg.norm(so3.log(found.R_imu_lidar.T @ R_imu_lidar.as_matrix()))) < 1.0
    assert found.observable_axes == 3


def test_empty_scans_and_gaps_restart_the_registration() -> None:
    empty = Scan(np.empty((0, 3), np.float32), np.empty(0, np.int64), None, 0, 0, {})
    assert len(lidar_rotations([empty, empty]).rotation) == 0
    rng = np.random.default_rng(0)
    identity = Rotation.identity(3000)
    position = np.zeros((3000, 3))
    scans = []
    for start_s in (0.0, 0.1, 5.0, 5.1):
        time_ns = START_NS + np.rint((start_s + 0.1 * np.arange(3000) / 3000) * 1e9).astype(np.int64)
        scans.append(room_scan(identity, position, time_ns, rng))
    lidar = lidar_rotations(scans)
    assert ((lidar.end_ns - lidar.begin_ns) == 100_000_000).all() and len(lidar.rotation) == 2
    assert np.abs(lidar.rotation).max() < np.radians(0.2)


@pytest.mark.parametrize(("name", "start_s"), [("v103_velodyne", 10.0), ("mh05_ouster_ros2", 1.0)])
def test_extrinsics_of_real_flights(shared_data: Path, name: str, start_s: float) -> None:
    path = shared_data / "recordings" / name
    path = path if path.is_dir() else path.with_suffix(".bag")
    with open_recording(path, RecordingOptions(start_s=start_s, duration_s=7.0)) as recording:
        events = list(recording)
    blocks = [e for e in events if isinstance(e, ImuSamples)]
    imu = ImuSamples(*(np.concatenate([getattr(b, field) for b in blocks]) for field in ("time_ns", "gyro", "accel")))
    found = estimate_rotation_extrinsic([e for e in events if isinstance(e, Scan)], imu)
    R_imu_lidar = np.array(json.loads((shared_data / "recordings" / f"{name}.json").read_text())["R_imu_lidar"])
    assert np.degrees(np.linalg.norm(so3.log(found.R_imu_lidar.T @ R_imu_lidar))) < 1.0
    assert abs(found.time_offset_s) < 0.01 and abs(found.gyro_scale - 1) < 0.05


def test_eigenvalues_and_the_normal_in_closed_form() -> None:
    random = np.random.default_rng(0)
    factors = random.normal(size=(500, 3, 3)) * 10.0 ** random.uniform(-3.0, 1.0, size=(500, 1, 3))
    A = np.concatenate([factors @ factors.transpose(0, 2, 1), [np.eye(3), np.zeros((3, 3)), np.diag([0.0, 1.0, 1.0])]])
    entries = np.stack([A[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    expected, axes = np.linalg.eigh(A)
    found = scan_registration._eigenvalues(entries)
    assert np.all(np.abs(found.T - expected) <= 1e-7 * expected[:, 2:])
    apart = (expected[:, 0] < 0.15 * expected[:, 1]) & (expected[:, 1] > 0.02 * expected[:, 2])
    assert apart.sum() > 100
    normals = scan_registration._eigenvector(entries[:, apart], found[0, apart])
    along = np.abs(np.einsum("ni,ni->n", normals, axes[apart][:, :, 0]))
    np.testing.assert_allclose(along, 1.0, atol=1e-6)
