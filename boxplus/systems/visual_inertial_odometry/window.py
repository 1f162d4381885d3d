"""The window: frames with IMU between them, landmarks by inverse depth in the keyframe that found them, and what was let go.

A keyframe that leaves takes along the landmarks it found, with what older keyframes saw of them; what the newest ones saw of a
landmark that is still followed founds a new one there. No measurement counts twice, and no variable that still moves much is
linearised for good. A frame that is no keyframe is dropped, and the IMU's intervals before and after it become one.

Source: Demmel et al., Square root marginalization, ICCV 2021; Qin, Li and Shen, VINS-Mono, TRO 2018; docs/marginalization.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.losses import Huber
from boxplus.optimization.marginalization.leak import Leak, world_gauge
from boxplus.optimization.marginalization.marginalize import marginalize
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.group import Group
from boxplus.residuals.camera.inverse_depth import InverseDepthReprojection
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.inertial.imu import ImuPreintegration
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.prior import Prior
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.beginning import beginning, covariance_of
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.creep import CornerCreep
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks, most_are_below, motion_px, shared_rows
from boxplus.systems.visual_inertial_odometry.corners.triangulation import mean_parallax, triangulate
from boxplus.systems.visual_inertial_odometry.frame_solver import FrameSolver
from boxplus.systems.visual_inertial_odometry.imu_step import imu_step
from boxplus.systems.visual_inertial_odometry.lines.landmarks import LineLandmarks
from boxplus.systems.visual_inertial_odometry.observations import Fit, Floats, Frame, Ints, Seen
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.start.start import Start, imu_noise

_HUBER = 1.5  # standard deviations
_LEAVING = 2  # keyframes at most, for every one that is new
_MEDIAN_OF_TWO = 1.386  # of χ² with two degrees of freedom
_LAST_INTERVALS = 5
_REST_NS, _REST_PX, _REST_CORNERS = 300_000_000, 0.5, 15
_LEAST_RHO = 0.1  # 1/m, for what is not known to be nearer
_RECUT_NS = 1_000_000
SPARE_NS = 20_000_000  # of IMU samples on both sides of the intervals, where these follow the clocks' offset
_GIVEN = ("_config", "_rig", "_noise", "_gravity", "_gauge")
_BEHIND = -0.02  # 1/m, of a landmark that is not only far


class Window:
    """Frames, landmarks and their problem; see the head of this file.

    Attributes:
        problem: poses `bodies`, velocities and biases `states` [v, b_a, b_g], camera mountings, `points` [x, y, ρ] in the first
            camera of their anchor.
        lines: landmarks that are lines.
        offset: of the clocks, IMU minus camera [s]; `cut_ns` of it is in the intervals of the IMU.
        gap_s: longest time between IMU samples before the newest frame [s].
        last_step: what the IMU measured from the frame before to the newest one; None where it was silent, or at its limit.
        frames: in order of time.
        covariance: (15, 15) of the newest frame, [θ, p, v, b_ω, b_a].
        leak: what the last prior claims to know of position and yaw.
    """

    def __init__(self, config: VioConfig, rig: Rig) -> None:
        self._config, self._rig, self._noise = config, rig, imu_noise(rig, config)
        self._gravity = (0.0, 0.0, -config.gravity)
        self.problem = Problem()
        self.bodies = self.problem.add_variables(BodyPose, np.zeros((0, 7)), name="bodies")
        self.states = self.problem.add_variables(Euclidean(9), np.zeros((0, 9)), name="states")
        self.mountings = self.problem.add_variables(BodyPose, rig.mountings, name="mountings")
        self.points = self.problem.add_variables(Euclidean(3), np.zeros((0, 3)), name="points")
        self.lines = LineLandmarks(self.problem, rig, config.line_sigma)
        if config.extrinsic_estimation:
            sigma = np.repeat([np.radians(config.extrinsic_rotation_sigma_deg), config.extrinsic_translation_sigma], 3)
            self.problem.add_residuals(Prior(BodyPose, rig.mountings, sigma=sigma), self.mountings, name="drawing")
        else:
            self.problem.fix(self.mountings)
        self.offset = self.problem.add_variables(Euclidean(1), [0.0], name="time offset")
        if config.time_offset_estimation:
            self.problem.add_residuals(Prior(Euclidean(1), [0.0], sigma=config.time_offset_sigma), self.offset, name="clock")
        else:
            self.problem.fix(self.offset)
        self.cut_ns, self.gap_s = 0, 0.0
        self._gauge = world_gauge({self.bodies: "world_from_body", self.states: "velocity_first"}, rotation="yaw")
        self.leak: Leak | None = None
        self.covariance = np.zeros((15, 15))
        self.frames: list[Frame] = []
        self._imu: Preintegration | None = None
        self.last_step: Preintegration | None = None
        self._is_clipped = False  # samples before the newest frame reach a limit of the IMU
        self._next: tuple[int, Preintegration] | None = None  # the step from the newest frame that `predict` took, and its end
        self._imu_group: Group | None = None
        self._views: tuple[Group, NDArray[np.intp]] | None = None  # residuals of the observations, and which they are
        self._seen = Seen.none()
        self._solver, self._creep = FrameSolver(), CornerCreep(weigh=not config.refines_mounting)
        self._track: Ints = np.zeros(0, np.int64)  # of each landmark its corner, and the frame it is anchored in
        self._anchor: Ints = np.zeros(0, np.int64)
        self._founded = 0  # landmarks that the last keyframe saw
        self._rho_sigma = np.zeros(0)  # of each landmark [1/m]
        self._free_from: dict[int, int] = {}  # of a corner the first frame whose sight of it is in no prior

    def begin(self, start: Start, seen: list[Tracks], imu: ImuSamples) -> None:
        """The first frames, as a start found them: `seen` are those of `start.frames`."""
        for k, tracks in enumerate(seen):
            state = np.concatenate([start.velocity_world[k], start.accel_bias, start.gyro_bias])
            self._add(tracks, start.T_world_imu[k], state, True, imu)
        self.problem.add_residuals(beginning(start), self.bodies[0], self.states[0], name="beginning")
        self._found_landmarks()
        self._founded = len(self._track)

    def snapshot(self) -> dict[str, object]:
        """All that the next frames depend on beside config and rig, for `vars` of another window; only to be read."""
        self._disconnect()
        self.lines.disconnect()
        return {name: value for name, value in vars(self).items() if name not in _GIVEN}

    def predict(self, time_ns: int, imu: ImuSamples, *, is_clipped: bool = False) -> tuple[Floats, Floats]:
        """Pose (7,) and [v, b_a, b_g] (9,) at a time, by the newest frame and the IMU, which may be at its limit."""
        step, self._is_clipped = self._step(time_ns, imu), is_clipped
        self._next = time_ns, step
        pose, state = step.predict(self.bodies.values[-1], self.states.values[-1], self._gravity)
        return pose[0], state[0]

    def _step(self, time_ns: int, imu: ImuSamples) -> Preintegration:
        """What the IMU measured from the newest frame to a time of the cameras' clock."""
        interval_ns = self.frames[-1].time_ns + self.cut_ns, time_ns + self.cut_ns
        spare_ns = SPARE_NS if self._config.time_offset_estimation else 0
        return imu_step(imu, interval_ns, self.states.values[-1], self._noise, spare_ns)

    def _follow_clock(self) -> None:
        """Cut the IMU's intervals anew where the clocks' offset moved away from that they were cut at."""
        late_ns = round(float(self.offset.values[0, 0]) * 1e9) - self.cut_ns
        if self._imu is not None and abs(late_ns) > _RECUT_NS:
            step = max(min(late_ns, SPARE_NS // 2), -SPARE_NS // 2)
            self._imu = self._imu.shifted(step)
            self.cut_ns += step

    def add(self, tracks: Tracks, pose: Floats, state: Floats, is_keyframe: bool, imu: ImuSamples) -> None:
        """The next frame, at its predicted pose and state; what it saw of landmarks, and for a keyframe new landmarks."""
        self._add(tracks, pose, state, is_keyframe, imu)
        number = self.frames[-1].number
        landmark, row = shared_rows(self._track, tracks.ids)
        camera, k = np.nonzero(np.isfinite(tracks.pixels[row][:, :, 0]).T)
        self._seen.add(np.full(len(k), number), self.points.ids[landmark[k]], camera, tracks.pixels[row[k], camera])
        self.lines.add(number, tracks.lines)
        if is_keyframe:
            self._found_landmarks()
            self._founded = int(np.isin(tracks.ids, self._track).sum())

    def _add(self, tracks: Tracks, pose: Floats, state: Floats, is_keyframe: bool, imu: ImuSamples) -> None:
        if self.frames:
            known = self._next if self._next is not None and self._next[0] == tracks.time_ns else None
            step = self._step(tracks.time_ns, imu) if known is None else known[1]
            self._next = None
            self._imu = step if self._imu is None else self._imu.append(step)
            self.gap_s = float(step.longest_gap_s[0])
            self.last_step = step if self.gap_s <= self._config.max_imu_gap and not self._is_clipped else None
        number = int(self.problem.extend(self.bodies, pose).ids[0])
        self.problem.extend(self.states, state)
        self.frames.append(Frame(number, tracks.time_ns, tracks, is_keyframe))

    def rests(self) -> bool:
        """Whether nothing has moved in the images since the last keyframe or longer, as far as corners can tell."""
        newest = self.frames[-1].tracks
        before = next((f for f in reversed(self.frames[:-1]) if newest.time_ns - f.time_ns > _REST_NS), None)
        moved = np.zeros(0) if before is None else motion_px(before.tracks, newest)
        # All corners of a scene that turns or nears move; noise of a few does not make motion.
        return len(moved) >= _REST_CORNERS and most_are_below(moved, _REST_PX)

    def hold_still(self) -> None:
        """The velocity of the newest frame is zero, as far as corners that stand still say."""
        depth = float(np.median(1.0 / np.maximum(self.points.values[:, 2], _LEAST_RHO))) if len(self.points) else 1.0 / _LEAST_RHO
        sigma = _REST_PX / self._rig.cameras[0].model.fx * depth / (1e-9 * _REST_NS)
        zero = Prior(Euclidean(9), np.zeros(9), information=np.diag(np.repeat([sigma**-2, 0.0], [3, 6])))
        number = self.frames[-1].number
        self.problem.add_residuals(zero, self.states[number], name=f"rest {number}")

    def _found_landmarks(self) -> None:
        """New landmarks for the corners that have none, where what keyframes saw of them gives a depth."""
        newest = self.frames[-1].tracks
        lone = newest.ids[~np.isin(newest.ids, self._track)]
        keyframes = [frame for frame in self.frames if frame.is_keyframe]
        if not keyframes:
            return
        poses = self.bodies.values[[self._row(frame.number) for frame in keyframes]]
        self.lines.found([(frame.number, frame.tracks.lines) for frame in keyframes], poses, self.mountings.values)
        if not len(lone):
            return
        count, cameras = len(lone), newest.pixels.shape[1]
        pixels = np.full((len(keyframes), count, cameras, 2), np.nan)
        rays = np.full((len(keyframes), count, cameras, 3), np.nan)
        free_from = np.array([self._free_from.get(int(k), 0) for k in lone])
        for k, frame in enumerate(keyframes):
            at = np.searchsorted(frame.tracks.ids, lone)
            at[at == len(frame.tracks.ids)] = 0
            there = (frame.tracks.ids[at] == lone) & (frame.number >= free_from) if len(frame.tracks) else np.zeros(count, bool)
            pixels[k, there], rays[k, there] = frame.tracks.pixels[at[there]], frame.tracks.rays[at[there]]
        sigma = self._config.pixel_sigma / self._rig.cameras[0].model.fx
        anchor, rho, good = triangulate(rays, poses, self.mountings.values, sigma)
        chosen = np.flatnonzero(good)
        if not len(chosen):
            return
        bearing = rays[anchor[chosen], chosen, 0, :2]
        ids = self.problem.extend(self.points, np.column_stack([bearing, rho[chosen]])).ids
        numbers = np.array([frame.number for frame in keyframes])
        self._track = np.append(self._track, lone[chosen])
        self._anchor = np.append(self._anchor, numbers[anchor[chosen]])
        there = np.isfinite(pixels[:, chosen][..., 0]) & (anchor[chosen] <= np.arange(len(keyframes))[:, None])[:, :, None]
        of, camera, which = np.nonzero(there.transpose(0, 2, 1))
        self._seen.add(numbers[of], ids[which], camera, pixels[of, chosen[which], camera])

    def wants_keyframe(self, tracks: Tracks, pose: Floats) -> bool:
        """Whether a frame at the predicted pose (7,) shows enough that is new, or little of what is known."""
        last = next(frame for frame in reversed(self.frames) if frame.is_keyframe)
        if tracks.time_ns - last.time_ns > self._config.keyframe_interval * 1e9:
            return True
        # One camera that has not moved yet knows no landmark: then corners that are lost have to be replaced as well.
        known, founded = (self._track, self._founded) if self._founded else (last.tracks.ids, len(last.tracks))
        if len(shared_rows(known, tracks.ids)[0]) < self._config.keyframe_tracked * founded:
            return True
        poses = self.bodies.values[self._row(last.number)], pose
        return mean_parallax(last.tracks, tracks, *poses, self._rig.cameras[0]) > self._config.keyframe_parallax

    def landmarks(self) -> tuple[Ints, Floats, Floats]:
        """Corners (m,), positions (m, 3) in the world and standard deviations of the distance (m,) of the landmarks.

        Those at infinity are left out. The standard deviation is that of the landmark among poses that are known.
        """
        rows = np.flatnonzero(self.points.values[:, 2] > 1e-3)
        points, anchors = self.points.values[rows], self.bodies.values[np.searchsorted(self.bodies.ids, self._anchor[rows])]
        p_camera = np.column_stack([points[:, :2], np.ones(len(rows))]) / points[:, 2:]
        sigma = self._rho_sigma[rows] * np.linalg.norm(p_camera, axis=1) / points[:, 2]
        return self._track[rows], se3.act(anchors, se3.act(self.mountings.values[:1], p_camera)), sigma

    def _row(self, number: int) -> int:
        return int(np.searchsorted(self.bodies.ids, number))

    def solve(self, max_iterations: int | None = None) -> None:
        """Minimise over the window, from where it is; with as many steps as the settings say, if left out."""
        self._follow_clock()
        self._connect(np.arange(len(self._seen.frame)), len(self.frames) - 1)
        self.lines.connect(self.bodies, self.mountings)
        solution = self._solver.solve(self.problem, max_iterations or self._config.max_iterations)
        self.problem.set_values(solution)
        number = self.frames[-1].number
        self.covariance = self._creep.spread * covariance_of(solution, self.bodies[number], self.states[number])

    def _connect(self, rows: NDArray[np.intp], intervals: int) -> None:
        """Residuals of these observations, and of the IMU's first intervals; of no others."""
        self._disconnect()
        seen = self._seen
        if len(rows):
            anchor = self._anchor[self.points.rows_of(seen.landmark[rows])]
            models = [mounted.model for mounted in self._rig.cameras]
            camera, sigma = seen.camera[rows], self._config.pixel_sigma * self._creep.weight
            group = self.problem.add_residuals(
                OnBody(InverseDepthReprojection(models, seen.pixel[rows], camera_of=camera, sigma=sigma)),
                self.bodies[anchor],
                self.mountings[[0]],
                self.bodies[seen.frame[rows]],
                self.mountings[camera],
                self.points[seen.landmark[rows]],
                loss=Huber(_HUBER / self._creep.weight),
                name="corners",
            )
            self._views = (group, rows)
        if self._imu is not None and intervals:
            state = self.states.values[:-1]
            stale = self._imu.is_stale(state[:, 3:6], state[:, 6:])
            if stale.any():
                self._imu = self._imu.reintegrated(state[:, 3:6], state[:, 6:], stale)
            follows = self._config.time_offset_estimation
            residual = ImuPreintegration(
                self._imu if intervals == len(self._imu) else self._imu[:intervals],
                gravity=self._gravity,
                time_offset=follows,
                time_offset_s=1e-9 * self.cut_ns,
            )
            begin, end = slice(0, intervals), slice(1, intervals + 1)
            states = self.bodies[begin], self.states[begin], self.bodies[end], self.states[end]
            self._imu_group = self.problem.add_residuals(residual, *states, *([self.offset[:]] if follows else []), name="imu")

    def _disconnect(self) -> None:
        """Take out the residuals that `_connect` added."""
        views = None if self._views is None else self._views[0]
        self.problem.remove(*(group for group in (views, self._imu_group) if group is not None))
        self._views = self._imu_group = None

    def reject(self, threshold: float) -> Fit:
        """Leave out observations whose residual is larger, and landmarks that too few agree on.

        Args:
            threshold: [standard deviations].
        """
        seen = self._seen
        values = [block.values for block in self.problem.blocks]
        squares = np.zeros(len(seen.frame))
        if self._views is not None:
            group, rows = self._views
            squares[rows] = self._creep.weight**2 * group.squares(values)
        bad = squares > threshold**2
        newest = seen.frame == self.frames[-1].number
        if self._views is not None and self.frames[-1].is_keyframe:
            of_keyframes = np.isin(seen.frame[rows], [frame.number for frame in self.frames if frame.is_keyframe])
            tells = of_keyframes & ~bad[rows] & (seen.camera[rows] == 0)
            residuals, which = self._creep.weight * group.r[tells], rows[tells]
            self._creep.note(residuals, seen.landmark[which], seen.frame[which], len(self._rig.cameras))
        first = newest & (seen.camera == 0)
        # A landmark without what its anchor saw, with nothing but that, or behind the camera, is none.
        row = self.points.rows_of(seen.landmark)
        left = np.bincount(row[~bad], minlength=len(self.points))
        own = (seen.frame == self._anchor[row]) & (seen.camera == 0)
        anchored = np.bincount(row[own & ~bad], minlength=len(self.points))
        gone = (left < 2) | (anchored < 1) | (self.points.values[:, 2] < _BEHIND)
        imu = np.zeros(0) if self._imu_group is None else self._imu_group.squares(values) / 15.0
        spread = float(np.median(squares[newest])) if newest.any() else float("nan")
        fit = Fit(
            agreed=int((first & ~bad).sum()),
            not_agreed=int((first & bad).sum()),
            given_up=self._track[gone],
            reprojection_px=self._config.pixel_sigma * float(np.sqrt(spread / _MEDIAN_OF_TWO)),
            imu_ratio=self._creep.weight * float(np.sqrt(imu[-_LAST_INTERVALS:].mean())) if len(imu) else 0.0,
            lines=self.lines.reject(values, self.frames[-1].number, threshold),
        )
        if bad.any():
            seen.keep(~bad)
        self._rho_sigma = self._inverse_depth_sigmas()
        self._remove_landmarks(gone)
        return fit

    def _inverse_depth_sigmas(self) -> Floats:
        """(m,) of ρ of every landmark, from the information that the residuals just evaluated have about it."""
        information = np.zeros(len(self.points))
        if self._views is not None:
            group, _ = self._views
            squares = (group.jacobians[-1][:, :, 2] ** 2).sum(axis=1)
            information[:] = np.bincount(group.connections[-1].rows, squares, len(self.points))
        return self._creep.weight / np.sqrt(np.maximum(information, 1e-12))

    def _remove_landmarks(self, gone: NDArray[np.bool_]) -> None:
        """Landmarks (m,) that prove to be none, with all that was seen of them."""
        if gone.any():
            ids = self.points.ids[gone]
            self._seen.keep(~np.isin(self._seen.landmark, ids))
            self._disconnect()
            self.problem.remove(self.points[ids])
            self._track, self._anchor, self._rho_sigma = self._track[~gone], self._anchor[~gone], self._rho_sigma[~gone]

    def shrink(self) -> None:
        """Drop frames that are no keyframes and not recent any more; let the oldest keyframe go where there are too many."""
        for frame in [f for f in self.frames[1 : -self._config.recent_frames] if not f.is_keyframe]:
            k = self.frames.index(frame)
            self._disconnect()
            self.lines.drop(frame.number)
            self.problem.remove(self.bodies[frame.number], self.states[frame.number])
            self._seen.keep(self._seen.frame != frame.number)
            if self._imu is not None:
                self._imu = self._imu.merge(k - 1)
            del self.frames[k]
        # A start may bring more keyframes than the window holds; the first to go are linearised where they are known best.
        for _ in range(_LEAVING if self.frames[-1].is_keyframe else 0):
            if sum(f.is_keyframe for f in self.frames) > self._config.keyframes_of(len(self._rig.cameras)):
                self._let_go()

    def _let_go(self) -> None:
        """Marginalise the oldest keyframe and the landmarks it found."""
        oldest, seen = self.frames[0], self._seen
        keyframes = [f.number for f in self.frames if f.is_keyframe]
        spared = keyframes[-self._config.spared_keyframes]
        leaving = self._anchor == oldest.number
        ids, corners = self.points.ids[leaving], self._track[leaving]
        lives = np.isin(corners, self.frames[-1].tracks.ids)
        founds_anew = np.isin(seen.landmark, ids[lives]) & (seen.frame >= spared)
        absorbed = np.isin(seen.landmark, ids) & np.isin(seen.frame, keyframes) & ~founds_anew
        for corner in corners:
            self._free_from.pop(int(corner), None)
        self._free_from |= dict.fromkeys(corners[lives].tolist(), spared)
        self._connect(np.flatnonzero(absorbed), 1)
        lines = self.lines.leave(self.bodies, self.mountings, keyframes, spared, self.frames[-1].tracks.lines)
        variables = [self.bodies[oldest.number], self.states[oldest.number], self.points[ids], lines]
        self.leak = marginalize(self.problem, variables, at=None, gauge=self._gauge).leak
        self._imu_group = self._views = None
        self.lines.forget(lines.ids)
        seen.keep(~np.isin(seen.landmark, ids))
        self._track, self._anchor = self._track[~leaving], self._anchor[~leaving]
        if self._imu is not None:
            self._imu = self._imu[1:]
        del self.frames[0]
