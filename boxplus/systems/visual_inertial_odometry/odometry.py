"""Visual-inertial odometry: a sliding window of keyframes with IMU, landmarks and a prior of first estimates.

Every frame: corners are followed into the new images, starting where the gyroscope puts them; the IMU predicts pose and velocity;
the window is minimised over reprojection, IMU and prior; what does not fit is left out; what leaves the window stays as a prior.
docs/visual_inertial_odometry.md derives the terms.

Source: Qin, Li and Shen, VINS-Mono, TRO 2018; Leutenegger et al., OKVIS, IJRR 2015; Usenko et al., Basalt, RA-L 2020.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings, shown
from boxplus._extras import require
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.sensors.checked import checked_imu
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.images.eight_bits import EightBits
from boxplus.sensors.images.image_instants import ImageInstants
from boxplus.sensors.images.repeated_images import RepeatedImages
from boxplus.sensors.inertial.glitch_filter import GlitchFilter
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_saturation import Limit, Saturation
from boxplus.sensors.inertial.imu_values import measurements
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.tracking import FeatureTracker, Tracker
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.estimate import VioEstimate
from boxplus.systems.visual_inertial_odometry.health import Health, position_sigma
from boxplus.systems.visual_inertial_odometry.known_motion import imu_moves, is_motion
from boxplus.systems.visual_inertial_odometry.lines.tracking import LineFollower, LineTracker
from boxplus.systems.visual_inertial_odometry.observations import Fit
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.sensor_watches import SensorWatches
from boxplus.systems.visual_inertial_odometry.start.search import StartSearch
from boxplus.systems.visual_inertial_odometry.start.start import Start
from boxplus.systems.visual_inertial_odometry.window import SPARE_NS, Window

_START_ITERATIONS = 20
_OUTLIER = 4.0  # standard deviations
BEFORE_A_GAP = "frames that waited for a start when samples of the IMU were missing"
REPEATED = "images that are the one before, while the IMU moved"
_LONGEST_STALL_NS = 3_000_000_000  # that images which come again are left out
_GIVEN = ("config", "rig", "window", "_tracker", "_line_tracker")


class VisualInertialOdometry:
    """Estimates the pose of an IMU from its samples and the images of cameras rigidly attached to it.

    Push IMU samples and images in the order of time; each call returns the estimates that are ready, one for each instant of
    images, with the stamp of the first, up to 1 ms apart (it waits for those of all cameras, and for samples). `flush` ends it.

    Args:
        config: the settings; None for the defaults.
        rig: cameras and IMU.
        tracker: what follows corners through the images; optical flow if left out, for which OpenCV has to be installed.
        line_tracker: what follows lines; if left out `LineTracker`, where the settings ask for lines.

    Raises:
        InputError: OpenCV, the extra `vision`, is not installed; lines and a rolling shutter.

    Example:
        >>> from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
        >>> simulation = simulate_cameras("room", duration_s=2.0, rig=make_rig("stereo", scale=0.25, rate_hz=8.0))
        >>> recording = as_camera_recording(simulation)
        >>> cams = [stream.calibrated() for stream in recording.info.cameras]
        >>> rig = bp.Rig.of([c.model for c in cams], [c.T_body_camera for c in cams], [(c.width, c.height) for c in cams])
        >>> odometry, estimates = bp.VisualInertialOdometry(None, rig), []
        >>> for event in recording:
        ...     estimates += odometry.push_image(event) if isinstance(event, bp.CameraImage) else odometry.push_imu(event)
        >>> estimates[-1].status, odometry.start.kind
        ('ok', 'at rest')
    """

    def __init__(
        self, config: VioConfig | None, rig: Rig, tracker: Tracker | None = None, line_tracker: LineFollower | None = None
    ) -> None:
        self.config = as_settings(VioConfig, config)
        if not isinstance(rig, Rig):
            raise InputError("a Rig", shown(rig), "make one with Rig.of(models, mountings, sizes)")
        self.rig = rig if self.config.cameras == "all" else replace(rig, cameras=rig.cameras[:1], mountings=rig.mountings[:1])
        self.start: Start | None = None
        self.window = Window(self.config, self.rig)
        if self.config.lines and any(camera.line_delay_s for camera in self.rig.cameras):
            raise InputError("cameras that take all rows at once, for lines", "a rolling shutter", "leave lines out")
        self._tracker = FeatureTracker(self.config, self.rig) if tracker is None else tracker
        self._to_8_bits = EightBits()  # for lines; corners have their own
        self._line_tracker = line_tracker
        if self.config.lines and line_tracker is None:
            self._line_tracker = LineTracker(require("cv2", "which finds lines"), self.rig, self.config.max_lines)
        self._imu, self._glitches = ImuSamples.joined([]), GlitchFilter()
        self._newest_imu_ns = -(2**62)
        self._images = ImageInstants(len(self.rig.cameras))
        self._search = StartSearch()
        self._repeated = RepeatedImages()
        self._time_ns = 0  # of the frame before
        self._health = Health(self.config)
        self._watches = SensorWatches(self.rig, self.config.pixel_sigma, self.config.gravity)
        self._saturation = Saturation()
        self._counters: Counter[str] = Counter()

    @overload
    def push_imu(self, samples: ImuSamples) -> list[VioEstimate]: ...
    @overload
    def push_imu(self, samples: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> list[VioEstimate]: ...
    def push_imu(
        self, samples: ImuSamples | ArrayLike, gyro: ArrayLike | None = None, accel: ArrayLike | None = None
    ) -> list[VioEstimate]:
        """Take IMU samples, or times (N,) int64 [ns] with gyro (N, 3) [rad/s] and accel (N, 3) [m/s²]."""
        if not isinstance(samples, ImuSamples):
            if gyro is None or accel is None:
                raise InputError("times, gyro and accel", "times alone", "give all three, or ImuSamples")
            samples = ImuSamples.from_arrays(samples, gyro, accel)
        samples = measurements(checked_imu(samples), self._counters)
        last = np.concatenate([[self._newest_imu_ns], samples.time_ns[:-1]])
        ahead = samples.time_ns > np.maximum.accumulate(last)
        self._counters["IMU sample out of order"] += int((~ahead).sum())
        samples = samples.where(ahead)
        self._newest_imu_ns = int(samples.time_ns[-1]) if len(samples) else self._newest_imu_ns
        self._imu = ImuSamples.joined([self._imu, self._glitches.take(samples)])
        return self._advance(final=False)

    def push_image(self, image: CameraImage) -> list[VioEstimate]:
        """Take an image; returns the estimates that became ready.

        Raises:
            InputError: an image of a camera that the rig does not have, or of another size than its calibration's.
        """
        if not 0 <= image.camera < len(self.rig.cameras):
            if self.config.cameras == "first":
                return []
            raise InputError(f"cameras 0 to {len(self.rig.cameras) - 1}", f"camera {image.camera}", "give the rig all cameras")
        camera = self.rig.cameras[image.camera]
        if image.shape != (camera.height, camera.width):
            got = f"{image.shape[1]}x{image.shape[0]} pixels of {image.name}"
            raise InputError(f"{camera.width}x{camera.height} pixels, as calibrated", got, "calibrate for the size of the images")
        if image.time_ns <= self._time_ns:
            self._counters["images out of order"] += 1
            return []
        self._images.add(image)
        return self._advance(final=False)

    def flush(self) -> list[VioEstimate]:
        """No more data will come: process what still waits."""
        self._imu = ImuSamples.joined([self._imu, self._glitches.rest()])
        return self._advance(final=True)

    def snapshot(self) -> dict[str, object]:
        """All that later estimates depend on beside config and rig, for `restore`; only to be read, before anything is pushed."""
        own = {name: value for name, value in vars(self).items() if name not in _GIVEN}
        lines = None if self._line_tracker is None else self._line_tracker.snapshot()
        return {"own": own, "window": self.window.snapshot(), "tracker": self._tracker.snapshot(), "lines": lines}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from where another odometry with the same config and rig was: estimates are the same to the bit."""
        vars(self).update(snapshot["own"])
        vars(self.window).update(snapshot["window"])
        self._tracker.restore(snapshot["tracker"])
        if self._line_tracker is not None:
            self._line_tracker.restore(snapshot["lines"])

    @property
    def counters(self) -> Mapping[str, int]:
        """What could not be used before it reached the window, by reason."""
        return self._counters + self._glitches.rejected

    @property
    def start_problem(self) -> str | None:
        """Which test of the start was not passed, with its number; None where there is a start."""
        return self._search.problem

    @property
    def contradiction(self) -> str | None:
        """What makes the estimates not to be trusted, whatever their status: cameras and IMU that contradict each other."""
        return self._health.contradiction

    @property
    def lengths(self) -> tuple[float, float]:
        """By what share lengths of the cameras exceed the IMU's, and its standard deviation; NaN, infinite if nothing tells."""
        return self._watches.lengths

    def _advance(self, *, final: bool) -> list[VioEstimate]:
        """The frames that are complete, and covered by IMU samples."""
        estimates = []
        for time_ns in self._images.complete(final=final):
            until = time_ns + self.window.cut_ns + (SPARE_NS if self.config.time_offset_estimation and not final else 0)
            if not len(self._imu) or self._imu.time_ns[-1] < until:
                break
            images = self._images.take(time_ns)
            if self._imu.time_ns[0] > time_ns:
                self._counters["images before the first IMU sample"] += 1
                continue
            if self.start is not None and not self._has_imu_since_last_frame(time_ns):
                self._counters["images between two IMU samples"] += 1
                continue
            images = self._new_ones(time_ns, images)
            if not images:
                continue
            estimates.append(self._frame(time_ns, images))
            self._time_ns = time_ns
        return estimates

    def _new_ones(self, time_ns: int, images: dict[int, NDArray[Any]]) -> dict[int, NDArray[Any]]:
        """Images but those that are the ones before, although the IMU moved meanwhile.

        No longer than a few seconds: what the IMU says of the motion is worth little then, and a source without noise may have
        come to rest.
        """
        repeated = self._repeated.among(images)
        if repeated and time_ns - self._time_ns < _LONGEST_STALL_NS and self._moves(time_ns):
            self._counters[REPEATED] += len(repeated)
            images = {camera: image for camera, image in images.items() if camera not in repeated}
        self._repeated.keep(images)
        return images

    def _moves(self, time_ns: int) -> bool:
        """Whether the IMU moved since the frame before."""
        if self.start is None:
            first, last = np.searchsorted(self._imu.time_ns, [self._time_ns, time_ns], side="right")
            return imu_moves(self._imu.gyro[first:last], self._imu.accel[first:last], self.config.gravity)
        pose, state = self.window.predict(time_ns, self._imu)
        before = self.window.bodies.values[-1]
        turn = so3.log(quaternion.to_matrix(before[:4]).T @ quaternion.to_matrix(pose[:4]))
        focal_px = self.rig.cameras[0].model.fx
        return is_motion(float(np.linalg.norm(turn)), pose[4:] - before[4:], state[:3], focal_px)

    def _has_imu_since_last_frame(self, time_ns: int) -> bool:
        """Whether a sample lies between the newest frame and this time: without one they cannot be told apart by the IMU.

        Within a gap nothing else is to be had, and images tell the motion.
        """
        since, until = self.window.frames[-1].time_ns + self.window.cut_ns, time_ns + self.window.cut_ns
        first, last = np.searchsorted(self._imu.time_ns, [since, until], side="right")
        if last > first and self._imu.time_ns[first] < until:
            return True
        around = self._imu.time_ns[max(first - 1, 0) : first + 1]
        return len(around) == 2 and 1e-9 * float(around[1] - around[0]) > self.config.max_imu_gap

    def _frame(self, time_ns: int, images: dict[int, NDArray[Any]]) -> VioEstimate:
        limits = self._limits_reached(time_ns)
        if self.start is None:
            return self._before_start(time_ns, images)
        pose, state = self.window.predict(time_ns, self._imu, is_clipped=bool(limits))
        before = self.window.bodies.values[-1]
        R = quaternion.to_matrix(before[:4]).T
        R_before_now, p_before_now = R @ quaternion.to_matrix(pose[:4]), R @ (pose[4:] - before[4:])
        tracks = self._tracker.track(time_ns, images, R_before_now, p_before_now, self._rate(time_ns) - state[6:])
        is_keyframe = self.window.wants_keyframe(tracks, pose)
        if is_keyframe:
            tracks = self._tracker.detect(tracks)
        if self._line_tracker is not None:
            greys = {camera: self._to_8_bits(image) for camera, image in images.items()}
            tracks = replace(tracks, lines=self._line_tracker.track(greys, R_before_now, p_before_now, wants_new=is_keyframe))
        self.window.add(tracks, pose, state, is_keyframe, self._imu)
        rests = self.window.rests()
        if rests:
            self.window.hold_still()
        self.window.solve()
        fit = self.window.reject(_OUTLIER)
        self._tracker.forget(fit.given_up)
        if self._line_tracker is not None:
            self._line_tracker.forget(fit.lines.given_up)
        estimate = self._estimate(tracks, is_keyframe, fit, rests, limits)
        self.window.shrink()
        self._forget_imu(self.window.frames[0].time_ns)
        return estimate

    def _longest_gap_s(self, time_ns: int) -> float:
        """Between the samples that lie around the time from the frame before to this one [s]."""
        first = max(int(np.searchsorted(self._imu.time_ns, self._time_ns, side="right")) - 1, 0)
        around = self._imu.time_ns[first : int(np.searchsorted(self._imu.time_ns, time_ns)) + 1]
        return 1e-9 * float(np.diff(around).max(initial=0))

    def _limits_reached(self, time_ns: int) -> list[Limit]:
        """Limits of the IMU that its samples from the frame before to this one reach."""
        first, last = np.searchsorted(self._imu.time_ns, [self._time_ns + self.window.cut_ns, time_ns + self.window.cut_ns])
        return self._saturation.update(self._imu.where(slice(int(first), int(last) + 1)))

    def _rate(self, time_ns: int) -> NDArray[np.float64]:
        """Angular velocity (3,) that the gyroscope measured at a time of the cameras' clock [rad/s]."""
        at = time_ns + self.window.cut_ns
        first = min(max(int(self._imu.time_ns.searchsorted(at)) - 1, 0), max(len(self._imu) - 2, 0))
        near = slice(first, first + 2)
        after_s = 1e-9 * (self._imu.time_ns[near] - at)
        return np.array([np.interp(0.0, after_s, self._imu.gyro[near, k]) for k in range(3)])

    def _forget_imu(self, oldest_ns: int) -> None:
        """Samples from before the oldest frame that is still needed are not; some are kept for an offset of the clocks."""
        oldest = int(np.searchsorted(self._imu.time_ns, oldest_ns + self.window.cut_ns - 2 * SPARE_NS)) - 2
        if oldest > 0:
            self._imu = self._imu.where(slice(oldest, None))

    def _before_start(self, time_ns: int, images: dict[int, NDArray[Any]]) -> VioEstimate:
        turn = np.eye(3)
        if self._search.seen and self._longest_gap_s(time_ns) > self.config.max_imu_gap:
            self._counters[BEFORE_A_GAP] += len(self._search.seen)
            self._search = StartSearch()
        if self._search.seen:
            chosen = (self._imu.time_ns >= self._time_ns - 20_000_000) & (self._imu.time_ns <= time_ns + 20_000_000)
            attitude = GyroAttitude(self._imu.time_ns[chosen], self._imu.gyro[chosen])
            before, now = attitude.at(np.array([self._time_ns, time_ns]))
            turn = before.T @ now
        tracks = self._tracker.detect(self._tracker.track(time_ns, images, turn, None, self._rate(time_ns)))
        self._search.add(tracks, self.config)
        seen = list(self._search.seen)
        self._forget_imu(seen[0].time_ns)
        start = self._search.look(self._imu, self.rig, self.config)
        if start is None:
            return self._nothing(tracks, self._search.problem or "the next frames are waited for")
        self.start, self._search = start, StartSearch()
        self.window.begin(start, [seen[k] for k in start.frames], self._imu)
        self.window.solve(_START_ITERATIONS)
        fit = self.window.reject(_OUTLIER)
        self._tracker.forget(fit.given_up)
        if not self.config.refines_mounting:
            self.window.solve()  # with the weight that the corners' residuals show
        self._health.begin(tracks.time_ns)
        return self._estimate(tracks, True, fit, start.kind == "at rest")

    def _nothing(self, tracks: Tracks, reason: str) -> VioEstimate:
        nan = np.full(3, np.nan)
        return VioEstimate(
            time_ns=tracks.time_ns,
            status="starting",
            reasons=(reason,),
            T_world_imu=np.full((4, 4), np.nan),
            velocity_world=nan,
            gyro_bias=nan,
            accel_bias=nan,
            covariance=np.full((15, 15), np.nan),
            tracked=0,
            new=int(tracks.is_new.sum()),
            rejected=tracks.rejected,
            lines_rejected={},
            is_keyframe=False,
            landmark_ids=np.zeros(0, np.int64),
            landmarks=np.zeros((0, 3)),
            landmark_sigmas=np.zeros(0),
            lines_tracked=0,
            line_ids=np.zeros(0, np.int64),
            line_ends=np.zeros((0, 6)),
            T_imu_camera=np.array([camera.T_imu_camera for camera in self.rig.cameras]),
            time_offset_s=0.0,
            timing_s={},
        )

    def _estimate(self, tracks: Tracks, is_keyframe: bool, fit: Fit, rests: bool, limits: Sequence[Limit] = ()) -> VioEstimate:
        pose, state = self.window.bodies.values[-1], self.window.states.values[-1]
        ids, landmarks, sigmas = self.window.landmarks()
        line_ids, line_ends = self.window.lines.ends(self.window.bodies, self.window.mountings.values)
        lines = tracks.lines
        covariance = self.window.covariance
        self._watches.add(pose, state, covariance, self.window.last_step)
        if is_keyframe and not rests:
            self._watches.add_keyframe(tracks, pose, state, self._rate(tracks.time_ns))
        among, apart = self._watches.among_cameras, self._watches.apart
        sigma = position_sigma(covariance)
        status, reasons = self._health.judge(tracks, fit, rests, self.window.gap_s, sigma, among, apart, limits)
        return VioEstimate(
            time_ns=tracks.time_ns,
            status=status,
            reasons=reasons,
            T_world_imu=_matrices(pose[None])[0],
            velocity_world=state[:3].copy(),
            gyro_bias=state[6:].copy(),
            accel_bias=state[3:6].copy(),
            covariance=covariance,
            tracked=fit.agreed,
            new=int(tracks.is_new.sum()),
            rejected={**tracks.rejected, "does not fit the window": fit.not_agreed},
            lines_rejected={**lines.rejected, "does not fit the window": fit.lines.not_agreed} if lines is not None else {},
            is_keyframe=is_keyframe,
            landmark_ids=ids,
            landmarks=landmarks,
            landmark_sigmas=sigmas,
            lines_tracked=fit.lines.agreed,
            line_ids=line_ids,
            line_ends=line_ends,
            T_imu_camera=_matrices(self.window.mountings.values),
            time_offset_s=float(self.window.offset.values[0, 0]),
            timing_s={"opencv": self._tracker.opencv_s}
            | ({} if self._line_tracker is None else {"lines": self._line_tracker.seconds}),
        )


def _matrices(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4, 4) of (n, 7)."""
    matrices = np.tile(np.eye(4), (len(T), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = quaternion.to_matrix(T[:, :4]), T[:, 4:]
    return matrices
