"""Simulated recordings of cameras as files: ROS bags, EuRoC and TUM RGB-D folders, with calibration and ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from boxplus.errors import InputError
from boxplus.formats.image_file import ImageFormat, encode_image
from boxplus.formats.output import atomic_file, make_folder, output_error
from boxplus.formats.trajectory_rows import tum_row
from boxplus.manifolds import quaternion
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.bag_writer import IMU_DELAY_NS, IMU_TYPE, TRANSFORMS_TYPE, BagWriter, ground_truth_lines
from boxplus.simulation.cameras.calibration_files import INFO_TYPE, camchain, camera_info, euroc_camera, euroc_imu
from boxplus.simulation.cameras.faults import CameraFault
from boxplus.simulation.cameras.recorded import Recorded
from boxplus.simulation.cameras.simulation import DEPTH, CameraSimulation

CameraFormat = Literal["euroc", "tum", "ros2", "ros1"]

_IMAGE_TYPE = "sensor_msgs/msg/Image"
_IMU_TOPIC, _IMU_FRAME = "/imu0", "imu"
_IMAGE_DELAY_NS = 12_000_000
_TUM_COUNTS_A_METRE = 5000.0
_IMU_HEAD = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z\n"
_STATE_HEAD = (
    "#timestamp,p_RS_R_x [m],p_RS_R_y,p_RS_R_z,q_RS_w [],q_RS_x,q_RS_y,q_RS_z,v_RS_R_x [m s^-1],v_RS_R_y,v_RS_R_z,"
    "b_w_RS_S_x [rad s^-1],b_w_RS_S_y,b_w_RS_S_z,b_a_RS_S_x [m s^-2],b_a_RS_S_y,b_a_RS_S_z\n"
)
_STATE_NS = 5_000_000


class _Writer(Protocol):
    """Takes events in the order in which they arrive."""

    def image(self, image: CameraImage) -> None: ...

    def samples(self, samples: ImuSamples) -> None: ...

    def close(self) -> None: ...


def write_camera_recording(
    simulation: CameraSimulation,
    path: str | Path,
    format: CameraFormat = "euroc",
    fault: CameraFault | None = None,
    images: ImageFormat = "png",
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a simulation to disk, image by image.

    Beside the recording `NAME` come `NAME.gt.tum` (pose of the body, 100 Hz, whatever the fault), `NAME.calib.yaml` (a Kalibr
    camchain of the rig as declared) and `NAME.json` (the parameters). A EuRoC folder holds the exact state at 200 Hz where EuRoC
    has it, a TUM folder the poses of its camera in `groundtruth.txt`.

    Args:
        simulation: what to write.
        path: `euroc`, `tum`, `ros2`: the folder to create; `ros1`: the file to create, its ending is set to `.bag`.
        format: `tum` takes one camera, with depths or without; `euroc` takes no depths.
        fault: what goes wrong.
        images: files of the folders.
        progress: called with the share of the recording that is written, 0 to 1.

    Returns:
        The path that was written.

    Raises:
        InputError: a format that is unknown or does not fit the rig, or the path exists.
        OutputError: it cannot be written.
    """
    recorded = Recorded(simulation, fault)
    simulation = recorded.simulation
    _check_format(simulation, format)
    target = Path(path)
    if format == "ros1":
        target = target.with_name(f"{target.name.removesuffix('.bag')}.bag")
    if target.exists():
        raise InputError("the path of a new recording", f"one that exists, {target}", "remove it or choose another name")
    make_folder(target.parent)
    stem = target.with_suffix("") if format == "ros1" else target
    topics = [f"/{name}/image_raw" for name in simulation.names if name != DEPTH]
    calibration = camchain(recorded.declared, simulation.scenario.imu, topics)
    try:
        writer: _Writer
        if format == "euroc":
            writer = _Euroc(target, recorded, images)
        elif format == "tum":
            writer = _Tum(target, recorded, images, calibration)
        else:
            writer = _Bag(target, recorded, format)
        last = len(simulation.names) - 1
        written = 0
        try:
            for event in recorded.events():
                if isinstance(event, ImuSamples):
                    writer.samples(event)
                    continue
                writer.image(event)
                written += event.camera == last
                if progress is not None:
                    progress(min(written / max(simulation.image_count, 1), 1.0))
        finally:
            writer.close()
    except OSError as error:
        raise output_error(target, error) from error
    with atomic_file(f"{stem}.gt.tum") as file:
        for rows in ground_truth_lines(simulation.scenario.trajectory, simulation.start_ns, simulation.end_ns):
            file.write(rows.encode())
    with atomic_file(f"{stem}.calib.yaml") as file:
        file.write(calibration.encode())
    with atomic_file(f"{stem}.json") as file:
        file.write(simulation.config.model_dump_json(indent=2).encode())
    return target


def _check_format(simulation: CameraSimulation, format: str) -> None:
    count, depth = len(simulation.scenario.rig.cameras), simulation.scenario.rig.depth
    if format not in ("euroc", "tum", "ros2", "ros1"):
        raise InputError("the format 'euroc', 'tum', 'ros2' or 'ros1'", repr(format), "choose one of them")
    if format == "tum" and count > 1:
        raise InputError("one camera in a TUM RGB-D folder", f"{count}", "write another format, or simulate 'mono' or 'rgbd'")
    if format == "euroc" and depth:
        raise InputError("a rig without depths in a EuRoC folder", "one with depths", "write 'tum', 'ros1' or 'ros2'")


class _Folder:
    """What the folders have in common: IMU samples in a table."""

    def __init__(self, images: ImageFormat) -> None:
        self._suffix = images
        self._imu: list[str] = []
        self._exposures: dict[int, dict[str, float]] = {}

    def samples(self, samples: ImuSamples) -> None:
        for time_ns, gyro, accel in zip(samples.time_ns.tolist(), samples.gyro.tolist(), samples.accel.tolist(), strict=True):
            self._imu.append(f"{time_ns}," + ",".join(map(repr, (*gyro, *accel))) + "\n")

    def _encoded(self, image: CameraImage) -> bytes:
        if image.exposure_s is not None:
            self._exposures.setdefault(image.time_ns, {})[image.name] = image.exposure_s
        pixels = image.pixels
        if image.is_depth:
            counts = np.rint(image.depth().astype(np.float64) * _TUM_COUNTS_A_METRE)
            pixels = np.where(np.isfinite(counts) & (counts <= 65535.0), counts, 0.0).astype(np.uint16)
        return encode_image(pixels, self._suffix)  # type: ignore[arg-type]

    def _exposure_table(self, names: list[str]) -> str:
        """Exposure times by camera, in the form that the readers take."""
        rows = ["#timestamp [ns]," + ",".join(f"{name} shutter [s]" for name in names) + "\n"]
        for time_ns, told in sorted(self._exposures.items()):
            rows.append(f"{time_ns}," + ",".join(repr(told[name]) if name in told else "" for name in names) + "\n")
        return "".join(rows)

    def _write(self, file: Path, text: str) -> None:
        make_folder(file.parent)
        with atomic_file(file) as out:
            out.write(text.encode())


class _Euroc(_Folder):
    """mav0/cam0/data.csv, mav0/cam0/data/, mav0/cam0/sensor.yaml, mav0/imu0/, mav0/state_groundtruth_estimate0/."""

    def __init__(self, path: Path, recorded: Recorded, images: ImageFormat) -> None:
        super().__init__(images)
        self._root, self._recorded = path / "mav0", recorded
        self._rows: dict[str, list[str]] = {name: ["#timestamp [ns],filename\n"] for name in recorded.simulation.names}
        for name, camera in zip(recorded.simulation.names, recorded.declared.cameras, strict=True):
            make_folder(self._root / name / "data")
            self._write(self._root / name / "sensor.yaml", euroc_camera(camera, recorded.declared.rate_hz))
        self._write(self._root / "imu0" / "sensor.yaml", euroc_imu(recorded.simulation.scenario.imu))

    def image(self, image: CameraImage) -> None:
        file = f"{image.time_ns}.{self._suffix}"
        (self._root / image.name / "data" / file).write_bytes(self._encoded(image))
        self._rows[image.name].append(f"{image.time_ns},{file}\n")

    def close(self) -> None:
        for name, rows in self._rows.items():
            self._write(self._root / name / "data.csv", "".join(rows))
        self._write(self._root / "imu0" / "data.csv", _IMU_HEAD + "".join(self._imu))
        self._write(self._root / "exposure.csv", self._exposure_table(list(self._rows)))
        self._write(self._root / "state_groundtruth_estimate0" / "data.csv", _STATE_HEAD + _states(self._recorded.simulation))


def _states(simulation: CameraSimulation) -> str:
    time_ns = np.arange(simulation.start_ns, simulation.end_ns + 1, _STATE_NS)
    motion = simulation.ground_truth(time_ns)
    q_wxyz = quaternion.from_matrix(motion.R_world_imu)
    columns = [motion.p_world_imu, q_wxyz, motion.v_world_imu, *simulation.imu.biases(time_ns)]
    rows = np.concatenate(columns, axis=1).tolist()
    return "".join(f"{time}," + ",".join(map(repr, row)) + "\n" for time, row in zip(time_ns.tolist(), rows, strict=True))


class _Tum(_Folder):
    """rgb.txt, rgb/, depth.txt, depth/, imu.csv, calib.yaml, groundtruth.txt (poses of the camera)."""

    def __init__(self, path: Path, recorded: Recorded, images: ImageFormat, calibration: str) -> None:
        super().__init__(images)
        self._root, self._simulation = path, recorded.simulation
        self._rows: dict[str, list[str]] = {}
        self._stamps: list[int] = []
        for name in ("rgb", "depth") if recorded.simulation.scenario.rig.depth else ("rgb",):
            make_folder(path / name)
            self._rows[name] = ["# timestamp filename\n"]
        self._write(path / "calib.yaml", calibration)

    def image(self, image: CameraImage) -> None:
        name = "depth" if image.is_depth else "rgb"
        seconds, rest = divmod(image.time_ns, 1_000_000_000)
        file = f"{name}/{seconds}.{rest:09d}.{self._suffix}"
        (self._root / file).write_bytes(self._encoded(image))
        self._rows[name].append(f"{seconds}.{rest:09d} {file}\n")
        if name == "rgb":
            self._stamps.append(image.time_ns)

    def close(self) -> None:
        for name, rows in self._rows.items():
            self._write(self._root / f"{name}.txt", "".join(rows))
        self._write(self._root / "imu.csv", _IMU_HEAD + "".join(self._imu))
        self._write(self._root / "exposure.csv", self._exposure_table(["cam0"]))
        T = self._simulation.T_world_camera(0, np.array(self._stamps, np.int64)) if self._stamps else np.zeros((0, 4, 4))
        q_wxyz = quaternion.from_matrix(T[:, :3, :3])
        self._write(self._root / "groundtruth.txt", "".join(map(tum_row, self._stamps, T[:, :3, 3], q_wxyz)))


class _Bag:
    """/cam0/image_raw, /cam0/camera_info, /depth/image_raw …, /imu0, /tf_static."""

    def __init__(self, path: Path, recorded: Recorded, format: Literal["ros2", "ros1"]) -> None:
        simulation, declared = recorded.simulation, recorded.declared
        topics = {"/tf_static": TRANSFORMS_TYPE, _IMU_TOPIC: IMU_TYPE}
        for name in simulation.names:
            topics |= {f"/{name}/image_raw": _IMAGE_TYPE, f"/{name}/camera_info": INFO_TYPE}
        self._bag = BagWriter(path, format, topics)
        self._bag.__enter__()
        start_ns = simulation.start_ns
        of_stream = {name: declared.cameras[0 if name == DEPTH else k] for k, name in enumerate(simulation.names)}
        mountings = {name: camera.mounting for name, camera in of_stream.items()}
        self._bag.write("/tf_static", start_ns, self._bag.transforms(start_ns, _IMU_FRAME, mountings))
        for name, camera in of_stream.items():
            sensor = camera.sensor
            info = camera_info(self._bag, start_ns, name, sensor.width, sensor.height, sensor.lens)
            self._bag.write(f"/{name}/camera_info", start_ns, info)

    def image(self, image: CameraImage) -> None:
        message: Any = self._bag.message(
            _IMAGE_TYPE,
            header=self._bag.header(image.time_ns, image.name),
            height=image.shape[0],
            width=image.shape[1],
            encoding="32FC1" if image.is_depth else "mono8",
            is_bigendian=0,
            step=image.pixels.shape[1] * image.pixels.dtype.itemsize,
            data=np.ascontiguousarray(image.pixels).view(np.uint8).ravel(),
        )
        self._bag.write(f"/{image.name}/image_raw", image.time_ns + _IMAGE_DELAY_NS, message)

    def samples(self, samples: ImuSamples) -> None:
        for time_ns, gyro, accel in zip(samples.time_ns.tolist(), samples.gyro.tolist(), samples.accel.tolist(), strict=True):
            self._bag.write(_IMU_TOPIC, time_ns + IMU_DELAY_NS, self._bag.imu(time_ns, _IMU_FRAME, gyro, accel))

    def close(self) -> None:
        self._bag.__exit__(None, None, None)
