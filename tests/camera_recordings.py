"""Small camera recordings for the tests: bags written with rosbags, folders with PGM images, which need no OpenCV."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.bags import Container, Content, _Bag, _imu_message, _transform_message

START_NS = 1_700_000_000_123_456_789
FRAME_NS = 50_000_000
IMU_NS = 5_000_000
WIDTH, HEIGHT = 12, 8
K = (10.0, 11.0, 5.5, 3.5)
D = (-0.1, 0.02, 1e-3, -2e-3)
T_IMU_CAM = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


def picture(camera: int, index: int, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> NDArray[np.uint8]:
    """Pixels that tell the camera and the image."""
    return np.random.default_rng(1000 * camera + index).integers(0, 255, shape, dtype=np.uint8)


def pgm(pixels: NDArray[Any]) -> bytes:
    """A PGM (or PPM) file of 8 or 16 bits."""
    kind = "P5" if pixels.ndim == 2 else "P6"
    largest = 255 if pixels.dtype == np.uint8 else 65535
    header = f"{kind}\n# made for a test\n{pixels.shape[1]} {pixels.shape[0]}\n{largest}\n".encode()
    return header + pixels.astype(pixels.dtype.newbyteorder(">")).tobytes()


@dataclass
class CameraBag:
    """What a bag for a test holds."""

    topics: tuple[str, ...] = ("/cam0/image_raw", "/cam1/image_raw")
    frames: int = 6
    encoding: str = "mono8"
    delay_ns: int = 15_000_000
    imu: bool = True
    info: bool = True
    distortion: str = "plumb_bob"
    D: tuple[float, ...] = D
    transforms: bool = True
    moved_again: bool = False  # one more transform of the last camera, half a metre from the first
    padding: int = 3
    compressed: str = ""
    R: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    binning: int = 0
    same_frames: bool = False
    pictures: dict[tuple[int, int], NDArray[Any]] = field(default_factory=dict)
    stamps: dict[tuple[int, int], int] = field(default_factory=dict)
    payloads: dict[tuple[int, int], bytes] = field(default_factory=dict)

    def stamp_ns(self, camera: int, index: int) -> int:
        return self.stamps.get((camera, index), START_NS + index * FRAME_NS)

    def pixels(self, camera: int, index: int) -> NDArray[Any]:
        return self.pictures.get((camera, index), picture(camera, index))

    def frame(self, camera: int) -> str:
        return "imu" if self.same_frames else f"cam{camera}"

    def write(self, folder: Path, container: Container = "ros1") -> Path:
        path = folder / ("cameras.bag" if container == "ros1" else "cameras")
        bag = _Bag(path, container)
        events: list[tuple[int, str, Any]] = []
        for camera, topic in enumerate(self.topics):
            if self.info:
                name = f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
                events.append((START_NS, name, self._info(bag, camera)))
            for index in range(self.frames):
                received_ns = START_NS + index * FRAME_NS + self.delay_ns + camera
                events.append((received_ns, topic, self._image(bag, topic, camera, index)))
        if self.imu:
            for stamp_ns in range(START_NS - 4 * IMU_NS, START_NS + self.frames * FRAME_NS, IMU_NS):
                events.append((stamp_ns, "/imu", _imu_message(bag, Content(), stamp_ns, "imu")))
        if self.transforms:
            content = Content(transforms=[("imu", f"cam{k}", _values(k)) for k in range(len(self.topics))])
            if self.moved_again:
                content.transforms.append(("imu", content.transforms[-1][1], content.transforms[-1][2] + np.eye(7)[0] / 2))
            events.append((START_NS, "/tf_static", _transform_message(bag, content)))
        with bag.writer:
            for received_ns, topic, message in sorted(events, key=lambda event: event[0]):
                bag.write(topic, message, received_ns)
        return path

    def _image(self, bag: _Bag, topic: str, camera: int, index: int) -> Any:
        header = bag.header(self.stamp_ns(camera, index), self.frame(camera))
        pixels = self.pixels(camera, index)
        if topic.endswith("/compressed"):
            data = np.frombuffer(self.payloads.get((camera, index), pgm(pixels)), np.uint8)
            return bag.store.types["sensor_msgs/msg/CompressedImage"](header=header, format=self.compressed, data=data)
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
        padded = np.pad(rows, ((0, 0), (0, self.padding)))
        data = np.frombuffer(self.payloads.get((camera, index), padded.tobytes()), np.uint8)
        return bag.store.types["sensor_msgs/msg/Image"](
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=self.encoding,
            is_bigendian=0,
            step=padded.shape[1],
            data=data,
        )

    def _info(self, bag: _Bag, camera: int) -> Any:
        types = bag.store.types
        fx, fy, cx, cy = K
        letters = {
            "D": np.array(self.D),
            "K": np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
            "R": np.array(self.R),
            "P": np.array([fx + 1, 0.0, cx + 1, -2.0 * camera, 0.0, fx + 1, cy + 1, 0.0, 0.0, 0.0, 1.0, 0.0]),
        }
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return types["sensor_msgs/msg/CameraInfo"](
            header=bag.header(START_NS, self.frame(camera)),
            height=HEIGHT,
            width=WIDTH,
            distortion_model=self.distortion,
            binning_x=self.binning,
            binning_y=self.binning,
            roi=region,
            **(letters if bag.ros1 else {name.lower(): value for name, value in letters.items()}),
        )


def mounting(camera: int) -> NDArray[np.float64]:
    """T_imu_camera of the recordings made here."""
    T = T_IMU_CAM.copy()
    T[0, 3] += 0.11 * camera
    return T


def _values(camera: int) -> NDArray[np.float64]:
    half = np.sqrt(0.5)  # a quarter turn about z
    return np.array([*mounting(camera)[:3, 3], 0.0, 0.0, half, half])


def sensor_yaml(camera: int, **changes: object) -> str:
    """EuRoC's sensor.yaml."""
    stated = {
        "sensor_type": "camera",
        "T_BS": "{cols: 4, rows: 4, data: [" + ", ".join(map(str, mounting(camera).ravel())) + "]}",
        "rate_hz": 20,
        "resolution": [WIDTH, HEIGHT],
        "camera_model": "pinhole",
        "intrinsics": list(K),
        "distortion_model": "radial-tangential",
        "distortion_coefficients": list(D),
        **changes,
    }
    return "".join(f"{name}: {value}\n" for name, value in stated.items() if value is not None)


def write_euroc(folder: Path, frames: int = 6, cameras: int = 2, imu: bool = True) -> Path:
    """A EuRoC folder with PGM images."""
    root = folder / "euroc" / "mav0"
    for camera in range(cameras):
        home = root / f"cam{camera}"
        (home / "data").mkdir(parents=True)
        rows = ["#timestamp [ns],filename"]
        for index in range(frames):
            stamp_ns = START_NS + index * FRAME_NS
            (home / "data" / f"{stamp_ns}.pgm").write_bytes(pgm(picture(camera, index)))
            rows.append(f"{stamp_ns},{stamp_ns}.pgm")
        (home / "data.csv").write_text("\r\n".join(rows) + "\r\n")
        (home / "sensor.yaml").write_text(sensor_yaml(camera))
    if imu:
        (root / "imu0").mkdir()
        lines = ["#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z"]
        for stamp_ns in range(START_NS - 4 * IMU_NS, START_NS + frames * FRAME_NS, IMU_NS):
            lines.append(f"{stamp_ns},0.01,0.02,0.03,0.1,0.2,9.81")
        (root / "imu0" / "data.csv").write_text("\n".join(lines) + "\n")
        (root / "imu0" / "sensor.yaml").write_text(
            "%YAML:1.0\nsensor_type: imu\nT_BS: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: d\n"
            "  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n"
            "gyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 1.9e-05\n"
            "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
        )
    return folder / "euroc"
