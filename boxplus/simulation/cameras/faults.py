"""What goes wrong in real recordings of cameras: in the scene, in the sensors, in the stream, or in what is declared of the rig.

Each fault carries the words one of which a right diagnosis of it contains, and who can tell: `inspect`, which has no estimator,
or an estimator only. Times count from the start of the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from boxplus._settings import suggestion
from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.recordings.cameras.calibration import inverse
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import faults as imu_faults
from boxplus.simulation.cameras.scenarios import ROOM_HIGH, ROOM_LOW, CameraScenario
from boxplus.simulation.cameras.sensor import CameraRig
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import SplineTrajectory
from boxplus.simulation.motions.trajectories import START_NS, control_times, fade_in, from_angles
from boxplus.simulation.worlds.world import Solid, World, box

Event = CameraImage | ImuSamples
Events = Callable[[Iterable[Event]], Iterator[Event]]
Witness = Literal["inspect", "estimator"]


def _same_scenario(scenario: CameraScenario) -> CameraScenario:
    return scenario


def _same_events(events: Iterable[Event]) -> Iterator[Event]:
    yield from events


def _same_rig(rig: CameraRig) -> CameraRig:
    return rig


@dataclass(frozen=True, slots=True)
class CameraFault:
    """One thing that goes wrong.

    Attributes:
        name: short name.
        description: one line.
        words: a diagnosis that names the cause contains one of these, in small letters.
        witness: who can tell.
        scenario: turns the scenario into the one that is recorded.
        events: turns the stream of events into the faulty one.
        declared: turns the rig that was recorded with into the one that the recording declares.
    """

    name: str
    description: str
    words: tuple[str, ...]
    witness: Witness
    scenario: Callable[[CameraScenario], CameraScenario] = _same_scenario
    events: Events = _same_events
    declared: Callable[[CameraRig], CameraRig] = _same_rig

    def named_in(self, text: str) -> bool:
        """Whether a diagnosis names this cause."""
        return any(word in text.lower() for word in self.words)


def _images(change: Callable[[CameraImage, float], CameraImage | None]) -> Events:
    """Events with every image changed, or left out where None; the change gets the time since the first event [s] as well."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        origin_ns: int | None = None
        for event in incoming:
            if origin_ns is None:
                origin_ns = event.time_ns if isinstance(event, CameraImage) else int(event.time_ns[0])
            changed = change(event, (event.time_ns - origin_ns) * 1e-9) if isinstance(event, CameraImage) else event
            if changed is not None:
                yield changed

    return events


def covered_lens(camera: int = 0, start_s: float = 5.0, duration_s: float = 3.0) -> CameraFault:
    """Something lies close before the lens: a smooth, dim picture with the sensor's noise, whatever the world."""

    def cover(image: CameraImage, since_s: float) -> CameraImage:
        if image.camera != camera or image.is_depth or not start_s <= since_s < start_s + duration_s:
            return image
        random = np.random.Generator(np.random.PCG64([image.time_ns, camera, 20]))
        height, width = image.shape
        coarse = gaussian_filter(random.standard_normal((height, width)), 0.3 * height, mode="nearest")
        smooth = 34.0 + 6.0 * coarse / max(float(np.abs(coarse).max()), 1e-9)
        pixels = np.rint(smooth + 1.5 * random.standard_normal((height, width)))
        return replace(image, pixels=np.clip(pixels, 0, 255).astype(np.uint8))

    return CameraFault(
        "covered_lens",
        f"cam{camera} is covered for {duration_s:g} s",
        ("covered", "shows nothing"),
        "inspect",
        events=_images(cover),
    )


def darkness(start_s: float = 5.0, duration_s: float = 3.0, level: float = 5e-4) -> CameraFault:
    """The light goes out."""

    def dark(scenario: CameraScenario) -> CameraScenario:
        light = {"dark_from_s": start_s, "dark_for_s": duration_s, "dark_level": level}
        return replace(scenario, light=scenario.light.model_copy(update=light))

    return CameraFault("darkness", f"the light goes out for {duration_s:g} s", ("dark", "black"), "inspect", scenario=dark)


def drop_frames(start_s: float = 5.0, duration_s: float = 0.6) -> CameraFault:
    """No images of any camera for a while."""

    def drop(image: CameraImage, since_s: float) -> CameraImage | None:
        return None if start_s <= since_s < start_s + duration_s else image

    text = f"no images for {duration_s:g} s"
    return CameraFault("drop_frames", text, ("missing", "gap"), "inspect", events=_images(drop))


def swapped_cameras() -> CameraFault:
    """The plugs of both cameras are swapped: images of one arrive as those of the other."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        waiting: list[CameraImage] = []
        for event in incoming:
            if isinstance(event, CameraImage) and not event.is_depth and event.camera < 2:
                waiting.append(replace(event, camera=1 - event.camera, name=f"cam{1 - event.camera}"))
                if len(waiting) < 2 and event.camera == 0:
                    continue
                yield from sorted(waiting, key=lambda image: image.camera)
                waiting = []
            else:
                yield from waiting
                waiting = []
                yield event
        yield from waiting

    return CameraFault("swapped_cameras", "the plugs of both cameras are swapped", ("swapped",), "inspect", events=events)


def wrong_baseline(factor: float = 1.25) -> CameraFault:
    """The distance of the cameras is declared wrong by a factor: every depth is then, no epipolar line; an IMU can tell."""

    def declared(rig: CameraRig) -> CameraRig:
        first = rig.cameras[0].mounting
        return _remounted(rig, 1, lambda T: _moved(T, first[:3, 3] + factor * (T[:3, 3] - first[:3, 3])))

    text = f"the distance of the cameras is declared {factor:g} times as long"
    return CameraFault("wrong_baseline", text, ("baseline", "scale"), "estimator", declared=declared)


def wrong_focal_length(factor: float = 1.1, camera: int | None = None) -> CameraFault:
    """The focal length is declared wrong by a factor, of every camera or of one, as it is after images were scaled or cropped."""

    def declared(rig: CameraRig) -> CameraRig:
        cameras = list(rig.cameras)
        for index in range(len(cameras)) if camera is None else (camera,):
            lens = cameras[index].sensor.lens
            fx, fy, cx, cy = lens.intrinsics
            lens = lens.model_copy(update={"intrinsics": (factor * fx, factor * fy, cx, cy)})
            cameras[index] = cameras[index].model_copy(update={"sensor": cameras[index].sensor.model_copy(update={"lens": lens})})
        return rig.model_copy(update={"cameras": tuple(cameras)})

    whose = "every camera" if camera is None else f"cam{camera}"
    text = f"the focal length of {whose} is declared {factor:g} times as long"
    return CameraFault("wrong_focal_length", text, ("focal length", "scaled or cropped"), "estimator", declared=declared)


def bent_rig(pitch_deg: float = 1.0) -> CameraFault:
    """The second camera has turned since it was calibrated."""

    def declared(rig: CameraRig) -> CameraRig:
        turn = so3.exp(np.array([np.deg2rad(pitch_deg), 0.0, 0.0]))
        return _remounted(rig, 1, lambda T: _turned(T, turn))

    text = f"cam1 is turned by {pitch_deg:g} deg against its calibration"
    words = ("does not fit these images", "stereo calibration")
    return CameraFault("bent_rig", text, words, "inspect", declared=declared)


def inverted_extrinsic() -> CameraFault:
    """Every mounting is declared the wrong way round: T_camera_imu as T_imu_camera."""

    def declared(rig: CameraRig) -> CameraRig:
        for index in range(len(rig.cameras)):
            rig = _remounted(rig, index, inverse)
        return rig

    text = "T_camera_imu declared as T_imu_camera"
    return CameraFault("inverted_extrinsic", text, ("inverse", "inverted"), "inspect", declared=declared)


def imu_clock_offset(offset_s: float = 0.05) -> CameraFault:
    """The stamps of the IMU lie `offset_s` too late (too early when negative)."""
    text = f"IMU stamps {offset_s:+g} s off"
    words = ("offset of the clocks", "timeshift", "time offset")
    return CameraFault("imu_clock_offset", text, words, "inspect", events=on_imu(imu_faults.clock_offset(offset_s)))


def other_imu(seed: int = 100) -> CameraFault:
    """The IMU is that of a telephone which is held apart from the cameras."""

    def apart(scenario: CameraScenario) -> CameraScenario:
        length = scenario.trajectory.duration_s
        return replace(scenario, imu_trajectory=manoeuvres.handheld(length, ROOM_LOW, ROOM_HIGH, standstill_s=0.0, seed=seed))

    words = ("different platforms", "another platform", "not rigid")
    return CameraFault("other_imu", "the IMU of a telephone, not rigid with the cameras", words, "inspect", scenario=apart)


def rolling_shutter(readout_s: float = 0.02) -> CameraFault:
    """Rows are read one after the other within `readout_s`, and nobody says so."""

    def rolling(scenario: CameraScenario) -> CameraScenario:
        cameras = tuple(
            camera.model_copy(
                update={"sensor": camera.sensor.model_copy(update={"line_delay_s": readout_s / camera.sensor.height})}
            )
            for camera in scenario.rig.cameras
        )
        return replace(scenario, rig=scenario.rig.model_copy(update={"cameras": cameras}))

    def declared(rig: CameraRig) -> CameraRig:
        cameras = tuple(
            camera.model_copy(update={"sensor": camera.sensor.model_copy(update={"line_delay_s": 0.0})}) for camera in rig.cameras
        )
        return rig.model_copy(update={"cameras": cameras})

    text = f"a rolling shutter of {1e3 * readout_s:g} ms, undeclared"
    return CameraFault("rolling_shutter", text, ("rolling shutter",), "inspect", scenario=rolling, declared=declared)


def rotation_at_start(turning_s: float = 4.0, seed: int = 0) -> CameraFault:
    """The cameras turn on the spot before they move: no depth can be had without a second camera."""
    words = ("rotation", "parallax", "translation")
    return CameraFault(
        "rotation_at_start", "pure rotation at the start", words, "estimator", scenario=_starting(turning_s, 0.0, seed)
    )


def constant_velocity_start(straight_s: float = 5.0, speed: float = 0.45, seed: int = 0) -> CameraFault:
    """Straight on without acceleration and rotation from the first image: one camera and an IMU do not show the scale."""
    words = ("scale", "excitation", "acceleration")
    text = "constant velocity at the start"
    return CameraFault("constant_velocity_start", text, words, "estimator", scenario=_starting(straight_s, speed, seed))


def bare_walls(contrast: float = 0.004) -> CameraFault:
    """An empty room whose walls have no texture."""

    def bare(scenario: CameraScenario) -> CameraScenario:
        world = World([box((0.0, 0.0, 1.6), (9.0, 7.5, 3.2), reflectivity=0.8)], cell_m=2.0)
        return replace(scenario, world=world, contrast=contrast)

    words = ("texture", "few features", "shows nothing")
    return CameraFault("bare_walls", "walls without texture", words, "inspect", scenario=bare)


def moving_object(start_s: float = 5.0, duration_s: float = 5.0, distance_m: float = 1.3) -> CameraFault:
    """Something with texture moves along before the cameras and fills half of the view."""

    def with_object(scenario: CameraScenario) -> CameraScenario:
        def movers(since_s: float, R_world_imu: NDArray[np.float64], p_world_imu: NDArray[np.float64]) -> list[Solid]:
            if not start_s <= since_s < start_s + duration_s:
                return []
            # Its edge wanders about the middle of the view while it slides up and down.
            sideways = 1.5 + 0.25 * np.sin(2.1 * since_s)
            centre = p_world_imu + R_world_imu @ np.array([distance_m, sideways, 0.25 * np.sin(3.0 * since_s)])
            return [box(centre, (0.1, 3.0, 4.0), R_world_box=R_world_imu)]

        return replace(scenario, movers=movers)

    words = ("moving object", "moves by itself", "outliers")
    text = f"an object fills half of the view for {duration_s:g} s"
    return CameraFault("moving_object", text, words, "inspect", scenario=with_object)


def on_imu(fault: imu_faults.Fault) -> Events:
    """A fault of the IMU's samples (`boxplus.simulation.faults`) as one of this stream; the images stay as they are."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        waiting: list[CameraImage] = []

        def samples() -> Iterator[ImuSamples]:
            for event in incoming:
                if isinstance(event, CameraImage):
                    waiting.append(event)
                else:
                    yield event

        for block in fault.events(samples()):
            yield from waiting
            waiting.clear()
            if isinstance(block, ImuSamples):
                yield block
        yield from waiting

    return events


def of_imu(fault: imu_faults.Fault, words: tuple[str, ...]) -> CameraFault:
    """A fault of `boxplus.simulation.faults` that concerns the IMU, and the words that name it."""
    return CameraFault(fault.name, fault.description, words, "inspect", events=on_imu(fault))


def _remounted(rig: CameraRig, index: int, change: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> CameraRig:
    if index >= len(rig.cameras):
        raise InputError("a rig of two cameras", f"one of {len(rig.cameras)}", "simulate a stereo rig")
    cameras = list(rig.cameras)
    T = change(cameras[index].mounting)
    cameras[index] = cameras[index].model_copy(update={"T_imu_camera": tuple(map(tuple, T.tolist()))})
    return rig.model_copy(update={"cameras": tuple(cameras)})


def _moved(T: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = T.copy()
    moved[:3, 3] = p
    return moved


def _turned(T: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ R
    return turned


def _starting(first_s: float, speed: float, seed: int) -> Callable[[CameraScenario], CameraScenario]:
    """The motion of a hand that turns on the spot (speed 0) or goes straight on for a while, then wanders about."""

    def start(scenario: CameraScenario) -> CameraScenario:
        time = control_times(scenario.trajectory.duration_s, 0.04)
        random = np.random.Generator(np.random.PCG64([seed, 13]))
        after = fade_in(time, first_s, 1.0)
        since = np.maximum(time - first_s, 0.0)
        phase = random.uniform(0.0, 2.0 * np.pi, 6)
        heading = random.uniform(-np.pi, np.pi)
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        # As straight on as the wandering has not begun; the middle of the way is the middle of the room.
        slowing = 1.0 - after
        way = np.concatenate([[0.0], np.cumsum(0.5 * (slowing[1:] + slowing[:-1]) * np.diff(time))])
        p = np.array([0.0, 0.0, 1.5]) + speed * (way - 0.5 * way[-1])[:, None] * ahead
        sway = np.stack([np.sin(1.1 * since + phase[k]) - np.sin(phase[k]) for k in range(3)], axis=1)
        p += after[:, None] * sway * np.array([0.5, 0.5, 0.2])
        turning = after if speed else fade_in(time, 0.0, 0.5)
        clock = since if speed else time
        roll, pitch = (0.15 * turning * np.sin(1.7 * clock + phase[k]) for k in (3, 4))
        yaw = heading + 0.7 * turning * np.sin(0.9 * clock + phase[5])
        return replace(scenario, trajectory=SplineTrajectory(START_NS, 0.04, from_angles(roll, pitch, yaw), p))

    return start


CAMERA_FAULTS: dict[str, Callable[[], CameraFault]] = {
    "covered_lens": covered_lens,
    "darkness": darkness,
    "drop_frames": drop_frames,
    "swapped_cameras": swapped_cameras,
    "wrong_baseline": wrong_baseline,
    "bent_rig": bent_rig,
    "wrong_focal_length": wrong_focal_length,
    "inverted_extrinsic": inverted_extrinsic,
    "imu_clock_offset": imu_clock_offset,
    "other_imu": other_imu,
    "rolling_shutter": rolling_shutter,
    "rotation_at_start": rotation_at_start,
    "constant_velocity_start": constant_velocity_start,
    "bare_walls": bare_walls,
    "moving_object": moving_object,
    "drop_imu": lambda: of_imu(imu_faults.drop_imu(start_s=5.0), ("missing", "gap")),
    "imu_in_g": lambda: of_imu(imu_faults.imu_in_g(), ("reports in g", "unit", "as g")),
    "gyro_in_deg": lambda: of_imu(imu_faults.gyro_in_deg(), ("another unit", "deg/s")),
    "flip_gyro": lambda: of_imu(imu_faults.flip_gyro(), ("opposite sign",)),
}
"""Name → maker."""


def make_camera_fault(name: str) -> CameraFault:
    """A fault with its default parameters.

    Raises:
        InputError: no fault of that name.
    """
    if name not in CAMERA_FAULTS:
        raise InputError("the name of a fault", repr(name), suggestion(name, CAMERA_FAULTS, "fault"))
    return CAMERA_FAULTS[name]()
