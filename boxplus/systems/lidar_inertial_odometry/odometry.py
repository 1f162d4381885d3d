"""LiDAR-inertial odometry: FAST-LIO2 (Xu et al., IEEE T-RO 2022), corrected as in docs/lidar_inertial_odometry.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus._stopwatch import Stopwatch
from boxplus.filtering.nav_state import TANGENT, G, NavState, P, V
from boxplus.filtering.pose_covariance.map_datum import SHARED_ERRORS, MapDatum
from boxplus.filtering.propagation import FOLLOWED, NODE, propagate_interval, transition
from boxplus.filtering.uncertain_instant import UncertainInstant
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import PlaneMeasurement, sees_one_way
from boxplus.maps.sliding_box import SlidingBox
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_saturation import Saturation
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import AFTER_GAP, BEFORE_START, Frame, Sequencer, joined_imu
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import align
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import WAITED, Estimate, Prediction
from boxplus.systems.lidar_inertial_odometry.imu_gap import begins_blind, guessed_until, imu_words, mean_motion, with_turn_rate
from boxplus.systems.lidar_inertial_odometry.long_gap import LONGEST_GAP_S, after_gap, gap_text, with_unknown_pose
from boxplus.systems.lidar_inertial_odometry.map_cell import map_cell_for
from boxplus.systems.lidar_inertial_odometry.mounted_update import mounted_update
from boxplus.systems.lidar_inertial_odometry.mounting.excitation import RotationExcitation
from boxplus.systems.lidar_inertial_odometry.mounting.mounting_drift import MountingDrift
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import MOUNTING, UnknownMounting, mounting_known
from boxplus.systems.lidar_inertial_odometry.observed_noise import ObservedNoise
from boxplus.systems.lidar_inertial_odometry.outcome import Outcome
from boxplus.systems.lidar_inertial_odometry.resumption import GUESSED_S, after_pause, before_pause, resumption, usual_distance
from boxplus.systems.lidar_inertial_odometry.snapshots import Snapshots
from boxplus.systems.lidar_inertial_odometry.standstill import Standstill
from boxplus.systems.lidar_inertial_odometry.start.first_scan import deskew_first
from boxplus.systems.lidar_inertial_odometry.start.search import StartSearch
from boxplus.systems.lidar_inertial_odometry.start.start import Start
from boxplus.systems.lidar_inertial_odometry.unshown_motion import UnshownMotion
from boxplus.systems.lidar_inertial_odometry.watches.consistency import Consistency
from boxplus.systems.lidar_inertial_odometry.watches.long_baseline import LongBaseline
from boxplus.systems.lidar_inertial_odometry.watches.pause import is_pause
from boxplus.systems.lidar_inertial_odometry.watches.weak_spell import WeakSpell
from boxplus.systems.lidar_inertial_odometry.well_placed import well_placed

_BLIND_PASSES, _BLIND_STRIDE, _BLIND_STEPS = 3, 8, 2
_BLIND_WEIGHT = 0.01  # of the points' information, where they are corrected for motion to decimetres only
_GAP_DENSITY = np.array([0.5**2, 3.0**2, 1e-4**2, 1e-3**2])  # nothing is known of the motion across a gap of the IMU
_SATURATED_DENSITY = np.array([0.1**2, 1.0**2, 1e-4**2, 1e-3**2])  # what a clipped sample hides


class LidarInertialOdometry(Snapshots):
    """Estimates the pose of an IMU from its samples and the scans of a LiDAR rigidly attached to it.

    Push IMU samples and scans in the order in which they arrive; each call returns the estimates that have become ready
    (a scan waits until IMU samples cover it, and the first scans until the start is found). Call `flush` at the end.

    Args:
        config: the settings; every one has a default.
        live: no scan waits for the comparison of the sensors; when a contradiction is told depends on the machine then, no pose.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     odometry = bp.LidarInertialOdometry(bp.LioConfig(T_imu_lidar=recording.info.T_imu_lidar.tolist()))
        ...     for event in recording:
        ...         estimates = odometry.push_scan(event) if isinstance(event, bp.Scan) else odometry.push_imu(event)
        >>> (estimates + odometry.flush())[-1].status
        'ok'
    """

    def __init__(self, config: LioConfig | None = None, *, live: bool = False) -> None:
        self.config, self._live = as_settings(LioConfig, config), live
        self.map, self._arrivals = IkdTree(cell_size=self.config.map_cell), FirstArrivals(self.config.map_cell)
        self.start: Start | None = None
        self.start_problem: str | None = None  # why there was none sooner
        self._sequencer = Sequencer()
        self._search = StartSearch(self.config)
        self._time_ns = 0  # of the state
        self._voxel_filter = VoxelFilter(self.config.scan_voxel, self.config.max_points)
        self._box, self._excitation = SlidingBox(self.config.box_side, self.config.detection_range), RotationExcitation()
        self._standstill: Standstill | None = None
        self._unshown, self._weak_spell = UnshownMotion(), WeakSpell(self.config.weak_threshold)
        self._consistency, self._long_baseline = Consistency(self.config, live=self._live), LongBaseline(self.config)
        self._saturation = Saturation()
        self._warnings: list[str] = []
        self._x_before: NDArray[np.float64] = np.zeros(0)
        self._motion: NDArray[np.float64] = np.zeros((2, 3))  # turn rate and velocity over the last scan
        self._points = np.zeros((0, 3), np.float32)  # the thinned scan
        self._guessed_ns = -1  # after a pause: of scans that begin until then the velocity is guessed
        self._one_way = False  # whether the LiDAR sees one way
        self._x: NDArray[np.float64] = np.zeros(0)
        self._cov: NDArray[np.float64] = np.zeros((TANGENT, TANGENT))
        self._datum = MapDatum(NavState.identity().pack(), self._cov, SHARED_ERRORS, FOLLOWED)
        self._mounting, self._noise = UnknownMounting(NavState.identity().pack(), self.config), ObservedNoise(self.config)
        self._mounting_drift: MountingDrift | None = None
        self._gap: str | None = None

    @property
    def counters(self) -> Mapping[str, int]:
        """What could not be used before it reached the filter, by reason."""
        return Counter({reason: count for reason, count in self._sequencer.rejected.items() if count})

    @property
    def contradiction(self) -> str | None:
        """What makes the estimate not to be trusted, whatever its status: sensors that contradict each other, a gap."""
        return self._consistency.contradiction or self._gap

    @property
    def consistency(self) -> Consistency:
        """How the LiDAR bears out the IMU since the start, and what the motion has shown of both."""
        return self._consistency

    @property
    def time_steps(self) -> list[str]:
        """Where the times of a sensor stepped back for good, and how much of it was left out: one sentence each."""
        return self._sequencer.time_steps

    def push_imu(self, samples: ImuSamples) -> list[Estimate]:
        """Take IMU samples; returns the estimates that became ready.

        Raises:
            InputError: no ImuSamples, or arrays of other shapes or types than it says.
        """
        self._sequencer.add_imu(samples)
        return self._advance(self._sequencer.frames())

    def push_scan(self, scan: Scan) -> list[Estimate]:
        """Take a scan; returns the estimates that became ready.

        Raises:
            InputError: no Scan, arrays of other shapes or types than it says, or points from outside of its time.
        """
        self._sequencer.add_scan(scan)
        return self._advance(self._sequencer.frames())

    def flush(self) -> list[Estimate]:
        """No more data will come: process what still waits for IMU samples."""
        estimates = self._advance(self._sequencer.frames(flush=True))
        while self.start is None and self._search.frames:  # once more, where a gap follows the start
            estimates += self._try_start()
            if self.start is None:
                self._search.give_up()
                self._note_search()
        self._consistency.finish()
        return estimates

    def predict(self) -> Prediction | None:
        """The state now: the last posterior, carried through all IMU samples since. None before the start.

        For control, at the rate of the IMU: call it after `push_imu`. The filter itself is not touched; when the next scan
        arrives, its estimate replaces what was predicted over the same time.
        """
        if self.start is None:
            return None
        imu = self._sequencer.imu_since(self._time_ns)
        x, cov = self._x.copy(), self._cov.copy()
        newest = max(int(imu.time_ns[-1]), self._time_ns) if len(imu) else self._time_ns
        if newest > self._time_ns:
            self._carry(x, cov, imu, newest, self._noise.density)
        return Prediction(newest, NavState.unpack(x), self._unshown.widened(cov, newest))

    def _advance(self, frames: list[Frame]) -> list[Estimate]:
        estimates: list[Estimate] = []
        for frame in frames:
            if self.start is not None and frame.duration_s > LONGEST_GAP_S:
                frame = self._interrupt(frame)
            elif self.start is not None and is_pause(frame):
                frame = self._resume(frame)
            if self.start is not None:
                estimates.append(self._process(frame))
                continue
            self._search.frames.append(frame)
            if self._search.due:
                estimates += self._try_start()
        return estimates

    def _resume(self, frame: Frame) -> Frame:
        """After a pause of both sensors: from where its scan fits the map and nowhere else, or from a new start."""
        self._consistency.pause.begin(frame)
        held, begin, density = (self._x.copy(), self._cov.copy(), self._time_ns), after_pause(frame), self._noise.density
        usual_m, (imu, paused_ns) = usual_distance(self._points, self._x, self.map), before_pause(frame)
        self._carry(self._x, self._cov, imu, paused_ns, density)
        x, cov, self._time_ns = self._x.copy(), self._cov.copy(), begin.begin_ns
        p_lidar = self._voxel_filter(self._deskew(begin, density)[0])[0]
        again = resumption(x, usual_m, self._x, p_lidar, self.map, frame.scan, (frame.scan.end_ns - paused_ns) * 1e-9)
        if again.x is None:
            self._x[:], self._cov[:], self._time_ns = held
            if frame.duration_s >= GUESSED_S:
                return self._interrupt(frame, again.text)
            self._warnings.append(f"{again.text}: its motion is held")
            return frame
        self._warnings.append(again.text)
        self._x[:], self._cov[:], self._guessed_ns = again.x, cov + np.diag(again.variances), frame.scan.end_ns
        return begin

    def _interrupt(self, frame: Frame, why: str = "") -> Frame:
        """Nothing says how the platform moved since the last scan: back to the search for a start, with a new map."""
        self._consistency.finish()
        self._gap = " ".join(filter(None, [self._gap, self._consistency.contradiction, gap_text(frame.duration_s, why)]))
        self._consistency, self._long_baseline = Consistency(self.config, live=self._live), LongBaseline(self.config)
        self.start, self._standstill = None, None
        self.map, self._arrivals = IkdTree(cell_size=self.config.map_cell), FirstArrivals(self.config.map_cell)
        self._box, self._excitation = SlidingBox(self.config.box_side, self.config.detection_range), RotationExcitation()
        return after_gap(frame)

    def _try_start(self) -> list[Estimate]:
        """Find the first state, then process every scan that waited for it, but for those before it."""
        found = self._search.find()
        self._note_search()
        if found is None:
            return []
        if self._gap is not None:
            found = replace(found, state=replace(found.state, p_world_imu=self._x[P : P + 3].copy()))
        self.start, (first, *rest), self._search = found, self._search.frames, StartSearch(self.config)
        self._x, self._cov, self._time_ns = found.state.pack(), found.covariance.copy(), found.time_ns
        self._motion = np.stack([np.zeros(3), found.state.v_world_imu])
        known = self._cov if self.config.extrinsic_estimation == "off" else mounting_known(self._cov)[0]
        self._datum = MapDatum(self._x, known if self._gap is None else with_unknown_pose(known), SHARED_ERRORS, FOLLOWED)
        self._mounting = UnknownMounting(self._x, self.config)
        self._mounting_drift = None if self.config.extrinsic_estimation == "off" else MountingDrift(self._x)
        self._unshown = UnshownMotion(found.unshown_axes, found.time_ns, self._x[P : P + 3], found.doubted, found.warning)
        self._weak_spell = WeakSpell(self.config.weak_threshold, None if len(found.unshown_axes) else found.time_ns)
        if found.kind == "static":
            self._standstill = Standstill(joined_imu([first, *rest]), found.state.p_world_imu)
        p_lidar = deskew_first(first, found.state, self.config)
        if self._gap is None:  # for good: what flies high sees the ground only, and may do so in rings
            self._one_way = all(sees_one_way(frame.scan.p_lidar) for frame in (first, *rest))
        self._insert(found.state.to_world(self._thinned(p_lidar)[1]))
        self._warnings = [] if self._gap is None else [self._gap]
        return [self._estimate(first, p_lidar), *self._advance(rest)]

    def _note_search(self) -> None:
        """Scans that no start will begin with, and why."""
        self._sequencer.rejected[AFTER_GAP if self._gap else BEFORE_START] += self._search.forgotten
        self._search.forgotten, self.start_problem = 0, self._search.problem or self.start_problem

    def _process(self, frame: Frame) -> Estimate:
        """One scan, line by line as in docs/lidar_inertial_odometry.md."""
        clock = Stopwatch()
        if begins_blind(frame, self.config.max_imu_gap):
            frame = self._see_motion(frame)
        p_lidar, passed = self._propagate(frame)
        if self._standstill is not None and self._standstill.active:
            passed = self._standstill.update(frame.imu, frame.duration_s, self._x, self._cov, passed)
        clock.lap("propagate and deskew")
        self._slide_map()
        clock.lap("slide map")
        points, map_points = self._thinned(p_lidar)
        clock.lap("voxel filter")
        measurement, x_prior = self._measurement(frame, points), self._x.copy()
        stamped = UncertainInstant(measurement, mean_motion(self._x_before, x_prior, frame.duration_s), self.config.stamp_noise)
        update = mounted_update(self._x, self._cov, stamped, self.config, self._unshown, turns=self._excitation.sufficient)
        posterior, cov_prior = update.posterior, update.cov_prior
        on_map, fitting = (measurement.on_map_share, measurement.fitting_share) if posterior.valid else (0.0, 1.0)
        directions = posterior.last.directions if posterior.valid else None
        clock.lap("update")
        self._warnings += self._consistency.update(frame, self._x_before, x_prior, update, on_map, fitting)
        clock.lap(WAITED)
        taken = posterior.valid and not self._is_astray(frame, on_map)
        if taken:
            self._x, self._cov = posterior.x, posterior.cov
        correction = update.correction(measurement, stamped, self._arrivals, self._datum.new_share) if taken else None
        self._datum.follow(self._x, cov_prior, update.cov if taken else cov_prior, correction, passed)
        if self._mounting_drift is not None:
            after = self._x, update.B if taken else update.B_prior
            self._mounting_drift.follow((x_prior, update.B_prior), after, self._cov[MOUNTING, MOUNTING], correction)
        self._motion = mean_motion(self._x_before, self._x, frame.duration_s)
        state = NavState.unpack(self._x)
        map_points_world = state.to_world(map_points)
        self._unshown.look(map_points_world, state.p_world_imu, self.config.map_cell, directions)
        if taken:
            placed, shared = (self._x, points, map_points_world), (self._datum, self._mounting_drift)
            drift = self._long_baseline.follow(self._time_ns, *placed, *shared)
            self._warnings += drift.warnings if drift is not None else []
        clock.lap("update")
        # Where the map has been left for good, a new one begins at the predicted pose.
        if taken or len(self.map) == 0 or self._consistency.lost:
            p_began = self.start.state.p_world_imu if self.start is not None else state.p_world_imu
            self._insert(well_placed(map_points_world, state, update.cov if taken else cov_prior, p_began))
        clock.lap("map insertion")
        stands = self._standstill is not None and self._standstill.active and not len(self._unshown.axes)
        status = self._weak_spell.status(frame.scan.end_ns, posterior.last.directions, taken, stands=stands)
        return self._estimate(frame, p_lidar, Outcome(measurement, posterior, taken, cov_prior, update.cov, status), clock.laps)

    def _see_motion(self, frame: Frame) -> Frame:
        """Within a gap of the IMU: the frame and the state with the turn rate and velocity at which its points fit the map."""
        x, cov, seconds = self._x.copy(), self._cov.copy(), (frame.scan.end_ns - self._time_ns) * 1e-9
        self._guessed_ns = guessed_until(frame, self._guessed_ns)
        for _ in range(_BLIND_PASSES):
            points = self._voxel_filter(self._deskew(frame, self._noise.density)[0])[0][::_BLIND_STRIDE].copy()
            measurement = PlaneMeasurement(points, self.map, self.config, with_extrinsic=False)
            fits = align(self._x, measurement, self.config, steps=_BLIND_STEPS) is not None
            # Half of it from the scan before: without this damping an error of a pose comes back with the opposite sign.
            motion = 0.5 * (self._motion + mean_motion(x, self._x, seconds))
            self._x[:], self._cov[:] = x, cov
            if not fits:
                break
            frame = replace(frame, imu=with_turn_rate(frame, motion[0], x))
            self._x[V : V + 3] = motion[1]
        return frame

    def _propagate(self, frame: Frame) -> tuple[NDArray[np.float32], NDArray[np.float64] | None]:
        """Forward to the end of the scan; every point is moved to that instant. With how errors go on, where the IMU tells."""
        self._x_before = self._x.copy()
        saturated = dict.fromkeys(limit.text for limit in self._saturation.update(frame.imu))
        self._warnings += [f"{text}: motion beyond it is not measured, covariance widened" for text in saturated]
        density = self._noise.update(frame.imu)
        if saturated:
            density = np.maximum(density, _SATURATED_DENSITY)
        p_lidar, nodes = self._deskew(frame, density)
        seconds, self._time_ns = (frame.scan.end_ns - self._time_ns) * 1e-9, frame.scan.end_ns
        self._excitation.add(nodes)
        return p_lidar, None if self._is_blind(frame) else transition(nodes, seconds, self._x[G : G + 3])

    def _deskew(self, frame: Frame, density: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """State and covariance move to the end of the scan; returns its points as seen from there, and the nodes."""
        scan = frame.scan
        nodes = self._carry(self._x, self._cov, frame.imu, scan.end_ns, density)
        p_lidar = np.empty_like(scan.p_lidar)
        deskew_into(scan.p_lidar, scan.time_ns, self._time_ns, nodes, len(nodes), self._x, p_lidar)
        return p_lidar, nodes

    def _carry(
        self, x: NDArray[np.float64], cov: NDArray[np.float64], imu: ImuSamples, until_ns: int, density: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Propagate x (36,) and cov (24, 24) in place from the last posterior to `until_ns`; returns the nodes."""
        nodes = np.zeros((len(imu) + 3, NODE))
        times, until, longest = (imu.time_ns - self._time_ns) * 1e-9, (until_ns - self._time_ns) * 1e-9, self.config.max_imu_gap
        count = propagate_interval(x, cov, times, imu.gyro, imu.accel, until, density, longest, _GAP_DENSITY, nodes)
        return nodes[:count]

    def _slide_map(self) -> None:
        state = NavState.unpack(self._x)
        for low, high in self._box.follow(state.p_world_imu + state.R_world_imu @ state.p_imu_lidar):
            self.map.delete_box(low, high)
            self._arrivals.forget_map()

    def _thinned(self, p_lidar: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Centroids and representatives of a scan; the map's cells become those that suit it."""
        voxel, (self._points, map_points) = self._voxel_filter.voxel_size, self._voxel_filter(p_lidar)  # so ordered: it adapts
        self.map.cell_size = map_cell_for(self._points, voxel, self.config)
        return self._points, map_points

    def _measurement(self, frame: Frame, points: NDArray[np.float32]) -> PlaneMeasurement:
        weight, asked = _BLIND_WEIGHT if self._is_blind(frame) else 1.0, self.config.extrinsic_estimation != "off"
        return PlaneMeasurement(
            points, self.map, self.config, with_extrinsic=asked, weight=weight, confirm=True, bend_sparse=self._one_way
        )

    def _is_blind(self, frame: Frame) -> bool:
        return frame.largest_gap_s > self.config.max_imu_gap or frame.begin_ns <= self._guessed_ns

    def _is_astray(self, frame: Frame, on_map: float) -> bool:
        """Whether what fits the map may fit it by chance: after a gap of the IMU nothing but the points says where it is."""
        return self._consistency.lost or (self._is_blind(frame) and on_map < self.config.min_matched_share)

    def _insert(self, p_world: NDArray[np.float64]) -> None:
        self._datum.insert(*self._arrivals.insert_into(self.map, p_world, self._time_ns))
        self._datum.creep(self._cov, self._x)
        if self._mounting_drift is not None:
            self._mounting_drift.insert(self._datum.new_share)

    def _estimate(
        self,
        frame: Frame,
        p_lidar: NDArray[np.float32],
        outcome: Outcome | None = None,
        timing_s: Mapping[str, float] | None = None,
    ) -> Estimate:
        """What is said of a scan; without an outcome it is the first one, which is exact by definition."""
        warnings, self._warnings = [*self._warnings, *self._unshown.words(self._time_ns)], []
        pose = self._unshown.widened(self._datum.pose_covariance(self._x), self._time_ns)
        return Estimate(
            time_ns=frame.scan.end_ns,
            state=NavState.unpack(self._x),
            covariance=self._unshown.widened(self._cov, self._time_ns),
            pose_covariance=self._mounting.widened(pose, self._x),
            status=outcome.status if outcome else "ok" if self._gap is None else "lost",
            weak_directions=outcome.weak_directions if outcome else (),
            lidar_share=outcome.lidar_share if outcome else np.zeros(6),
            points_raw=len(frame.scan) + sum(frame.scan.rejected.values()),
            points_filtered=outcome.measurement.points if outcome else 0,
            points_used=outcome.points_used if outcome else 0,
            rejected=outcome.rejected if outcome else {},
            residual_rms=outcome.posterior.last.residual_rms if outcome else 0.0,
            iterations=outcome.posterior.steps if outcome else 0,
            converged=outcome.posterior.converged if outcome else True,
            warnings=(*warnings, *imu_words(frame, self.config.max_imu_gap)),
            timing_s=dict(timing_s or {}),
            p_lidar=p_lidar,
            intensity=frame.scan.intensity,
            lidar=frame.scan.lidar,
        )
