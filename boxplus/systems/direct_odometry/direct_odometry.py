"""Direct odometry of an RGB-D camera, a stereo camera or one camera alone: poses from grey values.

For every frame:

1. **Track** it against the keyframe that sees most of the same, coarse to fine, from the motion so far going on and from
   standstill; where that fails, from half and double of it, small turns, and against the other keyframes.
2. **Judge** the alignment: a pose that the images do not support is not a pose.
3. Where it moved far, its brightness changed, or it fits much worse than others did, it becomes a **keyframe**: with its depths
   it enters the window, whose poses, brightness and inverse depths are adjusted together (`window.py`). Depths that no sensor
   measures come from the motion (`depth_filter.py`); one camera alone waits for two views that tell them.

Source: Engel, Koltun and Cremers, Direct Sparse Odometry, TPAMI 2018; Kerl, Sturm and Cremers, Dense Visual SLAM for RGB-D
Cameras, IROS 2013; docs/direct_odometry.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus._stopwatch import Stopwatch
from boxplus.cameras.model import CameraModel, check_pinhole
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3
from boxplus.sensors.images.image import Image, as_image
from boxplus.systems.direct_alignment.keyframe import FEWEST_PIXELS, Keyframe
from boxplus.systems.direct_alignment.tracking import Alignment, track
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.depth.depth_filter import depth_from, depth_of_two
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth, StereoPair, rgbd_depth
from boxplus.systems.direct_odometry.estimate import Estimate
from boxplus.systems.direct_odometry.frame_order import FrameOrder
from boxplus.systems.direct_odometry.image_motion import image_motion, keyframe_distance
from boxplus.systems.direct_odometry.patches import choose_patches
from boxplus.systems.direct_odometry.search_starts import starts_around
from boxplus.systems.direct_odometry.sensor_watches.sensor_watch import Motion, SensorWatch
from boxplus.systems.direct_odometry.two_view_start import TwoViews, TwoViewStart
from boxplus.systems.direct_odometry.verdict import Tracked, Verdict, Watch
from boxplus.systems.direct_odometry.window import Window
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]
Found = tuple[int, Alignment | None, Verdict]  # the keyframe's number, the alignment to it, what to think of it
DepthOf = Callable[[Matrix, float], SensedDepth]  # of a new keyframe, by its pose and the logarithm of its gain

_STANDSTILL = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_WORLD = np.diag([1e-5**2] * 6)  # of the first pose, which is the world's
_SEARCH_DEG = 20.0  # how far around the last pose a view is looked for while lost
_NEARLY_LOST = 0.5, 1.25  # px, whose shift changes grey values as much (one is lost); and by those of the frames before
_STAYS = 0.7  # the keyframe that is tracked is left only for one that is closer by this factor
_LEAST_FOUND = 0.4  # share of the patches that one camera alone has to find again in its second view
_SCARCE = 0.3  # share of pixels without a measured depth from which on depths by the motion are looked for
_SEEN_PX = 0.5  # a motion of the image that shows
_AGAIN = Verdict("lost", ("the image is the one before, to the bit, while the camera moves: the last pose stays",), np.nan)
_UNSEEN = Verdict("lost", ("fewer than 100 pixels have a depth and a gradient above noise: there is nothing to track",), np.nan)
_LOST_SPEED, _LOST_TURN = 1.0, 1.0  # [m/s], [rad/s] standard deviations of a motion that is not seen


class DirectOdometry:
    """Direct odometry, frame by frame.

    Args:
        camera: of the images; without IMU, the camera is the body. A pinhole, with lens distortion or without.
        config: settings.
        stereo: the second camera, for `push_stereo`.
        T_world_camera: (7,) pose of the first frame; by default the world is the first frame's camera.

    Raises:
        InputError: a camera that is no pinhole, a pose that is none.

    Example:
        >>> odometry, v = bp.DirectOdometry(bp.Pinhole(100.0, 100.0, 63.5, 47.5)), np.linspace(0.0, 20.0, 140)
        >>> wall = 100.0 + 40.0 * np.sin(v[None, :]) + 40.0 * np.cos(v[:96, None])
        >>> for k in range(4):  # a wall 2 m ahead that passes by, a pixel a frame
        ...     estimate = odometry.push_rgbd(k * 33_000_000, wall[:, k : k + 128], np.full((96, 128), 2.0))
        >>> estimate.status, estimate.p_world_camera.round(2) + 0.0
        ('ok', array([0.06, 0.  , 0.  ]))
    """

    def __init__(
        self,
        camera: CameraModel,
        config: DirectOdometryConfig | None = None,
        *,
        stereo: StereoPair | None = None,
        T_world_camera: ArrayLike = _STANDSTILL,
    ) -> None:
        self.camera = check_pinhole(camera, "direct odometry")
        self.config = as_settings(DirectOdometryConfig, config)
        self.stereo, self.window = stereo, Window(self.camera, self.config.window)
        self.gaps = 0  # how often the view was lost for so long that the poses since are a guess
        self._T: Matrix = SE3.check("T_world_camera", T_world_camera)[0].copy()
        self._covariance: Matrix = _WORLD
        self._velocity, self._velocity_s = _STANDSTILL, 0.0
        self._log_gain, self._offset = 0.0, 0.0
        self._reference: WindowKeyframe | None = None
        self._frames = FrameOrder()
        self._seen_ns: int | None = None
        self._watch, self._sensor = Watch(self.config), SensorWatch(stereo)
        self._start: TwoViewStart | None = None

    @property
    def keyframes(self) -> int:
        """Keyframes so far."""
        return self.window.taken

    @property
    def contradiction(self) -> str:
        """Why no pose is to be trusted, whatever the status: of the calibration, or of what is in view."""
        return self._watch.contradiction

    @property
    def remarks(self) -> dict[str, str]:
        """What makes poses worse, though not wrong: of a rolling "shutter", of something in view that is "carried" along."""
        return self._sensor.remarks

    @property
    def start_problem(self) -> str:
        """Why one camera alone had no pose before its start, with the number that was not met."""
        return "" if self._start is None else self._start.problem

    def push_rgbd(self, time_ns: int, image: Image | ArrayLike, depth: ArrayLike) -> Estimate:
        """A frame of an RGB-D camera.

        Args:
            time_ns: later than that of the frame before [ns].
            image: grey values (H, W), or colours.
            depth: (H, W) along the optical axis [m], registered to the image; 0 or NaN where there is none.

        Raises:
            InputError: arrays of another shape or not finite, a time that does not go on, depths that are no metres.
        """
        grey = as_image(image)
        return self._push(time_ns, grey, lambda *at: self._filled(rgbd_depth(depth, grey, self.config.depth_noise), grey, *at))

    def push_stereo(self, time_ns: int, left: Image | ArrayLike, right: Image | ArrayLike) -> Estimate:
        """A frame of a stereo camera: poses are those of the left one.

        Args:
            time_ns: later than that of the frame before [ns].
            left, right: grey values (H, W), or colours, taken at the same time.

        Raises:
            InputError: no second camera was given, images of another shape or not finite, a time that does not go on.
        """
        if self.stereo is None:
            raise InputError("the second camera", "none", "give it as DirectOdometry(camera, stereo=StereoPair(…))")
        stereo, one, two = self.stereo, as_image(left), as_image(right)

        def depth_of(T_world_camera: Matrix, _: float) -> SensedDepth:
            depth, unseen_s = stereo.depth(one, two, self.camera), self._unseen_s(time_ns)
            motion = Motion.between(self._T, T_world_camera, unseen_s) if unseen_s > 0.0 else None
            self._sensor.pair(one, two, depth, self.camera, motion)
            return depth

        return self._push(time_ns, one, depth_of)

    def push_mono(self, time_ns: int, image: Image | ArrayLike) -> Estimate | None:
        """A frame of one camera alone. Lengths are in units that nothing tells: about the median depth of the first view.

        Args:
            time_ns: later than that of the frame before [ns].
            image: grey values (H, W), or colours.

        Returns:
            None as long as no two views tell depths; `start_problem` says why.

        Raises:
            InputError: an image of another shape or not finite, a time that does not go on, OpenCV is not installed.
        """
        grey = as_image(image)
        if self._reference is not None:
            return self._push(time_ns, grey, lambda *at: depth_from(self.window.keyframes, grey, self.camera, *at))
        self._frames.take(time_ns, grey)
        watch = Stopwatch()
        if self._start is None:
            self._start, self._sensor = TwoViewStart(self.camera), SensorWatch(is_alone=True)
        views = self._start.push(time_ns, grey)
        begun = None if views is None else self._begin_alone(self._start, views, watch)
        if begun is not None or self._seen_ns is None:
            return begun
        lost = Verdict("lost", (f"the view was lost, and no two views tell depths again: {self._start.problem}",), np.nan)
        return self._estimate(time_ns, -1, False, None, lost, watch)

    def _push(self, time_ns: int, image: Image, depth_of: DepthOf) -> Estimate:
        elapsed_s = self._frames.take(time_ns, image)
        watch = Stopwatch()
        if self._reference is None:
            return self._begin(time_ns, image, depth_of, watch)
        T_predicted = self._predicted(self._unseen_s(time_ns))
        if self._frames.again and self._moves(image, T_predicted, self._reference):
            if self._unseen_s(time_ns) > self.config.lost_s:
                return self._lost(time_ns, image, depth_of, (self._reference.number, None, _AGAIN), watch)
            return self._estimate(time_ns, self._reference.number, False, None, _AGAIN, watch)
        keyframe, alignment, verdict = self._track(image, T_predicted)
        watch.lap("tracking")
        if verdict.status == "lost":
            return self._lost(time_ns, image, depth_of, (keyframe.number, alignment, verdict), watch)
        T_camera_keyframe = alignment.T_21
        T = se3.compose(keyframe.T_world_camera, se3.inverse(T_camera_keyframe))
        Ad = se3.adjoint(T_camera_keyframe)
        covariance = Ad @ self.window.covariance(keyframe) @ Ad.T + alignment.covariance
        is_keyframe, added = self._asks_for_keyframe(alignment, keyframe, verdict.residual_ratio), None
        if is_keyframe:
            log_gain = keyframe.log_gain - alignment.brightness[0]
            depth = depth_of(T, log_gain)
            motion = Motion.between(self._T, T, self._unseen_s(time_ns))
            self._sensor.frame(keyframe, image, depth, alignment, motion)
            self._watch.contradiction = self._sensor.contradiction
            added = self._keyframe(time_ns, image, depth, T, log_gain)
            is_keyframe = added is not None
            if added is not None:
                watch.lap("keyframe")
                self.window.add(added, covariance)
                if self.config.adjustments:
                    self.window.adjust(self.config.adjustments)
                self._sensor.keyframe(self.window.keyframes, depth, motion)
                T, covariance = added.T_world_camera, self.window.covariance(added)
                self._reference = added
                watch.lap("adjustment")
        if elapsed_s > 0.0:
            self._velocity, self._velocity_s = se3.compose(se3.inverse(self._T), T), self._unseen_s(time_ns)
        self._T, self._covariance, self._seen_ns = T, covariance, time_ns
        self._log_gain, self._offset = keyframe.log_gain - alignment.brightness[0], alignment.brightness[1]
        if added is not None:
            self._log_gain, self._offset = added.log_gain, 0.0
        return self._estimate(time_ns, keyframe.number, is_keyframe, alignment, verdict, watch)

    def _filled(self, sensed: SensedDepth, image: Image, T_world_camera: Matrix, log_gain: float) -> SensedDepth:
        """Where a sensor measures little, with depths by the motion."""
        missing = sensed.z == 0.0
        if missing.mean() < _SCARCE or self._reference is None:  # without one, nothing says where the window is from here
            return sensed
        return sensed.filled(depth_from(self.window.keyframes, image, self.camera, T_world_camera, log_gain, missing))

    def _begin_alone(self, start: TwoViewStart, views: TwoViews, watch: Stopwatch) -> Estimate | None:
        """Two keyframes of one camera alone; None where grey values do not agree with how corners moved."""
        first_ns, time_ns = views.time_ns
        self._sensor.begin_alone(views)
        depth = depth_of_two(views.first, views.second, self.camera, views.T_21, views.within)
        first = self._keyframe(first_ns, views.first, depth, self._T, 0.0)
        found, wanted = 0 if first is None else len(first.patches), round(_LEAST_FOUND * self.config.patches)
        if first is None or found < wanted:
            start.problem = f"{found} patches are found where corners say that they moved to ({wanted} are needed)"
            return None
        alignment = track(first.tracker, views.second, T_21=views.T_21)
        verdict = Watch(self.config).judge(alignment, first.tracker)
        if verdict.status == "lost":
            start.problem = f"grey values do not confirm how corners moved: {'; '.join(verdict.reasons)}"
            return None
        self._resume(first_ns)
        self.window.begin(first, self._covariance)
        Ad = se3.adjoint(alignment.T_21)
        covariance = Ad @ self._covariance @ Ad.T + alignment.covariance
        T = se3.compose(self._T, se3.inverse(alignment.T_21))
        depth = depth_from(self.window.keyframes, views.second, self.camera, T, -alignment.brightness[0])
        second = self._keyframe(time_ns, views.second, depth, T, -alignment.brightness[0])
        self._seen_ns, self._T, self._covariance, self._reference, self._velocity_s = time_ns, T, covariance, first, 0.0
        self._log_gain, self._offset = -alignment.brightness[0], alignment.brightness[1]
        if second is not None:
            self.window.add(second, covariance, holds_scale=True)
            if self.config.adjustments:
                self.window.adjust(2 * self.config.adjustments)
            self._T, self._covariance = second.T_world_camera, self.window.covariance(second)
            self._reference, self._log_gain, self._offset = second, second.log_gain, 0.0
        watch.lap("start")
        reasons = (*self._watch.reasons, *verdict.reasons)
        verdict = Verdict("weak" if reasons else "ok", reasons, np.nan)
        return self._estimate(time_ns, first.number, second is not None, alignment, verdict, watch)

    def _begin(self, time_ns: int, image: Image, depth_of: DepthOf, watch: Stopwatch) -> Estimate:
        """The first frame, or the first after the view was lost for good."""
        keyframe, verdict = self._keyframe(time_ns, image, depth_of(self._T, 0.0), self._T, 0.0), _UNSEEN
        self._watch.contradiction = self._sensor.contradiction
        if keyframe is not None:
            self._resume(time_ns)
            verdict = Verdict("weak" if self._watch.reasons else "ok", self._watch.reasons, np.nan)
            self.window.begin(keyframe, self._covariance)
            self._reference, self._seen_ns = keyframe, time_ns
            self._velocity_s = self._log_gain = self._offset = 0.0
        watch.lap("keyframe")
        return self._estimate(time_ns, -1 if keyframe is None else keyframe.number, keyframe is not None, None, verdict, watch)

    def _predicted(self, elapsed_s: float) -> Matrix:
        """Where the camera is if its motion goes on."""
        if self._velocity_s <= 0.0:
            return self._T
        share = min(elapsed_s / self._velocity_s, 2.0)
        return se3.compose(self._T, se3.exp(share * se3.log(self._velocity)))

    def _moves(self, image: Image, T_predicted: Matrix, keyframe: WindowKeyframe) -> bool:
        """Whether the motion so far, going on, would show in the image: a source without noise has equal images at rest."""
        T = se3.compose(se3.inverse(T_predicted), self._T)
        return image_motion(keyframe.tracker, T).flow * sum(image.shape) > _SEEN_PX

    def _track(self, image: Image, T_predicted: Matrix) -> Tracked:
        """The frame against the keyframe closest to where the camera should be; with more starts where that fails."""
        near = self._nearest(T_predicted)
        others = [keyframe for keyframe in reversed(self.window.keyframes) if keyframe is not near]
        attempts = [(near, False)] + [(keyframe, True) for keyframe in (near, *others)]
        tracked: list[Tracked] = []
        for keyframe, is_hard in attempts:
            if is_hard and self._watch.lost:
                starts, search_deg = starts_around(self._T, T_predicted, keyframe.T_world_camera, False)[1:], _SEARCH_DEG
            else:
                starts, search_deg = starts_around(self._T, T_predicted, keyframe.T_world_camera, is_hard), 0.0
            offset = self._offset if keyframe is self._reference else 0.0
            light = keyframe.log_gain - self._log_gain, offset
            alignment = track(keyframe.tracker, image, T_21=starts, light=light, search_deg=search_deg)
            verdict = self._watch.judge(alignment, keyframe.tracker)
            tracked.append(Tracked(keyframe, alignment, verdict))
            if verdict.status != "lost":
                self._reference = keyframe
                break
        else:
            tracked = tracked[:1]
        self._watch.keep(tracked[-1])
        return tracked[-1]

    def _nearest(self, T_world_camera: Matrix) -> WindowKeyframe:
        """The keyframe whose pixels move least; the one that was tracked last, unless another is clearly closer."""
        wanted, T_camera_world = {}, se3.inverse(T_world_camera)
        for k in self.window.keyframes:
            away = keyframe_distance(k.tracker, se3.compose(T_camera_world, k.T_world_camera), self.config)
            wanted[k.number] = away * (_STAYS if k is self._reference else 1.0)
        return min(self.window.keyframes, key=lambda k: wanted[k.number])

    def _asks_for_keyframe(self, alignment: Alignment, keyframe: WindowKeyframe, ratio: float) -> bool:
        by_brightness = abs(alignment.brightness[0]) / self.config.keyframe_brightness
        missing = (1.0 - alignment.overlap) / (1.0 - self.config.keyframe_overlap)
        keyframe.least_sigma = min(keyframe.least_sigma, alignment.sigma)
        fits_worse = alignment.sigma > self.config.keyframe_residual * keyframe.least_sigma
        fits_worse |= alignment.shift_px > _NEARLY_LOST[0] and ratio > _NEARLY_LOST[1]
        return fits_worse or max(keyframe_distance(keyframe.tracker, alignment.T_21, self.config) + by_brightness, missing) > 1.0

    def _keyframe(self, time_ns: int, image: Image, depth: SensedDepth, T: Matrix, log_gain: float) -> WindowKeyframe | None:
        """None where too little has a depth and a gradient."""
        depth = self._sensor.of_world(image, depth, T, log_gain, self.camera)
        try:
            tracker = Keyframe.prepare(image, depth.z, self.camera, levels=self.config.levels, points=self.config.pixels)
        except InputError:
            return None
        if max(level.above_noise for level in tracker.levels) < FEWEST_PIXELS:
            return None
        patches = choose_patches(image.grey, depth, self.camera, self.config.patches)
        return WindowKeyframe(self.window.taken, time_ns, image.grey, T, log_gain, tracker, patches)

    def _unseen_s(self, time_ns: int) -> float:
        """Time since the last frame with a pose [s]."""
        return 0.0 if self._seen_ns is None else (time_ns - self._seen_ns) * 1e-9

    def _unseen_covariance(self, time_ns: int) -> Matrix:
        """(6, 6) of the last pose, and of what the camera may have done since."""
        since_s = self._unseen_s(time_ns)
        turned, moved = min(_LOST_TURN * since_s, np.pi), _LOST_SPEED * since_s
        return np.asarray(self._covariance + np.diag([turned**2] * 3 + [moved**2] * 3))

    def _resume(self, time_ns: int) -> None:
        """The first view since the last pose that can be followed: its pose is the last one, with all that may have happened."""
        if self._seen_ns is not None:
            self._covariance = self._unseen_covariance(time_ns)
            self._watch.begin_anew(self._unseen_s(time_ns))

    def _lost(self, time_ns: int, image: Image, depth_of: DepthOf, found: Found, watch: Stopwatch) -> Estimate:
        """No pose: the last one stays; after a while, begin anew from it."""
        self._velocity, self._velocity_s = _STANDSTILL, 0.0
        if self._unseen_s(time_ns) > self.config.lost_s:
            self.gaps, self._reference = self.gaps + 1, None
            if self._start is None:
                return self._begin(time_ns, image, depth_of, watch)
            self._start = TwoViewStart(self.camera)
        number, alignment, verdict = found
        return self._estimate(time_ns, number, False, alignment, verdict, watch)

    def _estimate(
        self, time_ns: int, keyframe: int, is_keyframe: bool, alignment: Alignment | None, verdict: Verdict, watch: Stopwatch
    ) -> Estimate:
        covariance = self._unseen_covariance(time_ns) if verdict.status == "lost" else self._covariance
        turn = np.eye(6)
        turn[3:, 3:] = quaternion.to_matrix(self._T[:4])
        return Estimate(
            time_ns=time_ns,
            T_world_camera=self._T.copy(),
            pose_covariance=turn @ covariance @ turn.T,
            status=verdict.status,
            reasons=verdict.reasons,
            keyframe=keyframe,
            is_keyframe=is_keyframe,
            overlap=1.0 if alignment is None else alignment.overlap,
            pixels=0 if alignment is None else alignment.pixels,
            sigma=0.0 if alignment is None else alignment.sigma,
            residual_ratio=verdict.residual_ratio,
            brightness=(0.0, 0.0) if alignment is None else alignment.brightness,
            finished_points=self.window.take_finished(),
            timing_s=watch.laps,
        )
