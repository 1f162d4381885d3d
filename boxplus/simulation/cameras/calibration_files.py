"""The declared rig of a simulation in the files of Kalibr, EuRoC and ROS."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from boxplus.recordings.cameras.calibration import inverse
from boxplus.simulation.bag_writer import BagWriter
from boxplus.simulation.cameras.sensor import CameraRig, Lens, MountedCamera
from boxplus.simulation.imu import ImuModel

_KALIBR = {"pinhole": "none", "radtan": "radtan", "equidistant": "equidistant"}
_EUROC = {"pinhole": "none", "radtan": "radial-tangential", "equidistant": "equidistant"}
_ROS = {"pinhole": "plumb_bob", "radtan": "plumb_bob", "equidistant": "equidistant"}
INFO_TYPE = "sensor_msgs/msg/CameraInfo"


def camchain(rig: CameraRig, imu: ImuModel, topics: list[str]) -> str:
    """A Kalibr camchain with `T_cam_imu`, `line_delay` and the IMU's noise.

    Args:
        rig: as declared.
        imu: its densities.
        topics: `rostopic` of each camera.
    """
    content: dict[str, Any] = {}
    for index, (camera, topic) in enumerate(zip(rig.cameras, topics, strict=True)):
        content[f"cam{index}"] = {
            "T_cam_imu": inverse(camera.mounting).tolist(),
            "camera_model": "pinhole",
            "distortion_model": _KALIBR[camera.sensor.lens.kind],
            "distortion_coeffs": list(camera.sensor.lens.distortion),
            "intrinsics": list(camera.sensor.lens.intrinsics),
            "resolution": [camera.sensor.width, camera.sensor.height],
            "rostopic": topic,
            "timeshift_cam_imu": 0.0,
            "line_delay": camera.sensor.line_delay_s,
        }
    content["imu0"] = {**_noise(imu), "update_rate": imu.rate_hz}
    return _yaml(content)


def _noise(imu: ImuModel) -> dict[str, float]:
    return {
        "gyroscope_noise_density": imu.gyro_noise_density,
        "gyroscope_random_walk": imu.gyro_bias_walk,
        "accelerometer_noise_density": imu.accel_noise_density,
        "accelerometer_random_walk": imu.accel_bias_walk,
    }


def euroc_camera(camera: MountedCamera, rate_hz: float) -> str:
    """EuRoC's cam0/sensor.yaml."""
    lens = camera.sensor.lens
    return _yaml(
        {
            "sensor_type": "camera",
            "comment": "simulated",
            "T_BS": _matrix(camera.mounting),
            "rate_hz": rate_hz,
            "resolution": [camera.sensor.width, camera.sensor.height],
            "camera_model": "pinhole",
            "intrinsics": list(lens.intrinsics),
            "distortion_model": _EUROC[lens.kind],
            "distortion_coefficients": list(lens.distortion),
        }
    )


def euroc_imu(imu: ImuModel) -> str:
    """EuRoC's imu0/sensor.yaml; the IMU is the body."""
    return _yaml(
        {"sensor_type": "imu", "comment": "simulated", "T_BS": _matrix(np.eye(4)), "rate_hz": imu.rate_hz, **_noise(imu)}
    )


def _matrix(T: NDArray[np.float64]) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": T.ravel().tolist()}


def _yaml(content: dict[str, Any]) -> str:
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=1000)
    return text


def camera_info(bag: BagWriter, stamp_ns: int, frame: str, width: int, height: int, lens: Lens) -> Any:
    """sensor_msgs/CameraInfo of a camera whose images are as the lens makes them."""
    fx, fy, cx, cy = lens.intrinsics
    letters = {
        "D": np.array(lens.distortion or (0.0,) * 5),
        "K": np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        "R": np.eye(3).ravel(),
        "P": np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }
    region = bag.message("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return bag.message(
        INFO_TYPE,
        header=bag.header(stamp_ns, frame),
        height=height,
        width=width,
        distortion_model=_ROS[lens.kind],
        binning_x=0,
        binning_y=0,
        roi=region,
        **(letters if bag.ros1 else {name.lower(): value for name, value in letters.items()}),
    )
