"""Odometry of a LiDAR without an IMU, continuous in time (docs/lidar_odometry.md).

The motion between two scans is what an IMU would measure; without one it is a cubic between two states of pose and velocity,
which the points of a scan measure each at its own time, and a prior holds together: accelerations are white noise, of a
density that the run itself tells (Barfoot, Tong, Särkkä, RSS 2014). Everything else is as in `LidarInertialOdometry`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus._stopwatch import Stopwatch
from boxplus.filtering.nav_state import T_V, TANGENT
from boxplus.filtering.pose_covariance.map_datum import SHARED_ERRORS, MapDatum
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.sliding_box import SlidingBox
from boxplus.sensors.checked import checked_imu
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import AFTER_GAP, BEFORE_START, Sequencer
from boxplus.systems.lidar_inertial_odometry.config import LidarOdometryConfig, LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate, Status, WeakDirection
from boxplus.systems.lidar_inertial_odometry.snapshots import Snapshots
from boxplus.systems.lidar_inertial_odometry.watches.long_baseline import LongBaseline
from boxplus.systems.lidar_inertial_odometry.watches.weak_spell import WeakSpell
from boxplus.systems.lidar_odometry.alignment import Alignment, ScanPoints, align
from boxplus.systems.lidar_odometry.motion import DOF, VELOCITY, MotionBetween, MotionState, joint_prior, nav_state
from boxplus.systems.lidar_odometry.observed_density import ObservedDensity
from boxplus.systems.lidar_odometry.passing import PassingWatch
from boxplus.systems.lidar_odometry.start import LidarStart, find_lidar_start

_START_S = 0.5
_LONGEST_START_SCANS = 30
_LONGEST_GAP_S = 1.0  # nothing holds a velocity for longer
_MOST_STEPS = 10
_LEAST_FITTING = 0.8  # of the points with a plane lie on it; 0.95 at least on sound runs
_LOST_STREAK = 3
_UNKNOWN = np.diag([np.pi] * 3 + [1e4] * 3) ** 2  # of the pose against the first one: any turn, kilometres
_SHOWN = 2.0  # times the threshold at which a direction that was open counts as measured again
_INDEPENDENT_M = 0.2  # between points whose errors are independent
_LONGEST_WEAK_S = 2.0  # an open direction may be predicted, as steady as the platform moves
_MADE_GOOD = 0.5  # of that time by a time in which every direction is shown: noise shows one now and then
_NODES = 13  # within a scan


class LidarOdometry(Snapshots):
    """Estimates the pose of a LiDAR from its scans alone.

    Push scans in the order in which they arrive; each call returns the estimates that have become ready (the first scans wait
    until their motion is found). Call `flush` at the end. The LiDAR is the body: `T_world_imu` of an estimate is its pose, and
    the world is its frame at the end of the first scan, as nothing says where down is.

    Args:
        config: the settings; in a `LioConfig`, as a run has it, those of the IMU must have their defaults.

    Raises:
        InputError: a setting of the IMU or of its mounting is given.

    Example:
        >>> odometry = bp.LidarOdometry()
        >>> with bp.open_recording("flight.bag") as recording:
        ...     estimates = [e for event in recording if isinstance(event, bp.Scan) for e in odometry.push_scan(event)]
        >>> estimates[-1].status
        'ok'
    """

    def __init__(self, config: LidarOdometryConfig | None = None) -> None:
        config = as_settings(LidarOdometryConfig, config)
        self.config = config.of_lidar_alone() if isinstance(config, LioConfig) else config
        self.map = IkdTree(cell_size=self.config.map_cell, rebuild="incremental")
        self.start: LidarStart | None = None
        self.start_problem: str | None = None  # why there was none sooner
        self._sequencer = Sequencer()
        self._waiting: list[Scan] = []
        self._until_shown = self.config.model_copy(update={"weak_threshold": _SHOWN * self.config.weak_threshold})
        self._next_try = 0
        self._voxel_filter = VoxelFilter(self.config.scan_voxel, self.config.max_points)
        self._box = SlidingBox(self.config.box_side, self.config.detection_range)
        self._weak_spell = WeakSpell(self.config.weak_threshold)
        self._density = ObservedDensity()
        self._state = MotionState(0, np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        self._cov: NDArray[np.float64] = np.eye(DOF)
        self._datum = MapDatum(nav_state(self._state).pack(), self._cov, SHARED_ERRORS)
        self._untaken = 0
        self._open = False
        self._judged_ns: int | None = None
        self._weak_s = 0.0
        self._longest_weak_s = 0.0
        self._passing = PassingWatch()
        self._arrivals, self._long_baseline = FirstArrivals(self.config.map_cell), LongBaseline(self.config, with_imu=False)
        self._gap: str | None = None
        self._last_position = np.zeros(3)
        self._warnings: list[str] = []

    @property
    def counters(self) -> Mapping[str, int]:
        """What could not be used before it reached the odometry, by reason."""
        return Counter({reason: count for reason, count in self._sequencer.rejected.items() if count})

    @property
    def contradiction(self) -> str | None:
        """What makes the estimate not to be trusted, whatever its status: where the way was lost, or a direction was open."""
        open_text = None
        if self._longest_weak_s > _LONGEST_WEAK_S:
            open_text = (
                f"for {self._longest_weak_s:.1f} s, less half of the time between in which every direction seemed shown, the "
                "scans left a direction open, and without an IMU nothing else tells how far the LiDAR went along it"
            )
        return "; ".join(filter(None, [self._gap, self._passing.contradiction, open_text])) or None

    @property
    def time_steps(self) -> list[str]:
        """Where the times of the LiDAR stepped back for good, and how much of it was left out: one sentence each."""
        return self._sequencer.time_steps

    def push_imu(self, samples: ImuSamples) -> list[Estimate]:
        """Samples take no part; they are counted."""
        self._sequencer.rejected["IMU sample, which takes no part"] += len(checked_imu(samples))
        return []

    def push_scan(self, scan: Scan) -> list[Estimate]:
        """Take a scan; returns the estimates that became ready."""
        self._sequencer.add_scan(scan)
        return self._advance(self._sequencer.take_scans())

    def flush(self) -> list[Estimate]:
        """No more data will come: process what still waits for a start."""
        return self._try_start(final=True) if self.start is None and self._waiting else []

    def _advance(self, scans: list[Scan]) -> list[Estimate]:
        estimates: list[Estimate] = []
        for scan in scans:
            since_s = (scan.end_ns - self._state.time_ns) * 1e-9
            if self.start is not None and (since_s > _LONGEST_GAP_S or self._untaken >= _LOST_STREAK):
                self._interrupt(scan, since_s)
            if self.start is not None:
                estimates.append(self._process(scan))
                continue
            self._waiting.append(scan)
            seconds = (scan.end_ns - self._waiting[0].start_ns) * 1e-9
            if seconds >= _START_S and len(self._waiting) >= self._next_try:
                estimates += self._try_start()
        return estimates

    def _interrupt(self, scan: Scan, since_s: float) -> None:
        """Nothing says how the LiDAR moved since the last scan that fitted: a new start, with a new map."""
        why = (
            f"{self._untaken} scans in a row did not fit the map"
            if self._untaken >= _LOST_STREAK
            else f"no scan for {since_s:.1f} s, longer than {_LONGEST_GAP_S:g} s"
        )
        text = (
            f"{why}: where the LiDAR went meanwhile is not known; a new start and a new map begin at the last position, and the "
            "poses before and after do not belong together"
        )
        self._gap = text if self._gap is None else f"{self._gap}; {text}"
        self.start, self._next_try, self._untaken = None, 0, 0
        self._last_position = self._state.p_world_lidar
        self.map = IkdTree(cell_size=self.config.map_cell, rebuild="incremental")
        self._box = SlidingBox(self.config.box_side, self.config.detection_range)
        self._arrivals, self._long_baseline = FirstArrivals(self.config.map_cell), LongBaseline(self.config, with_imu=False)
        self._density = ObservedDensity()
        self._passing.restart()
        self._judged_ns = None

    def _try_start(self, *, final: bool = False) -> list[Estimate]:
        """Find the first state, then process every scan that waited for it."""
        found = find_lidar_start(self._waiting, self.config)
        if isinstance(found, str):
            self.start_problem = found
            keep = 0 if final else _LONGEST_START_SCANS
            forgotten = max(len(self._waiting) - keep, min(1, len(self._waiting)))
            self._sequencer.rejected[AFTER_GAP if self._gap else BEFORE_START] += forgotten
            del self._waiting[:forgotten]
            self._next_try = len(self._waiting) + 1 + len(self._waiting) // 3
            return []
        self.start = found
        self._state, self._cov = found.motion.last, found.covariance.copy()
        if self._gap is None:
            self._datum = MapDatum(nav_state(self._state).pack(), self._cov, SHARED_ERRORS)
        else:
            self._state = replace(self._state, p_world_lidar=self._last_position)
            unknown = self._cov.copy()
            unknown[:6, :6] += _UNKNOWN
            self._datum = MapDatum(nav_state(self._state).pack(), unknown, SHARED_ERRORS)
        (first, *rest), self._waiting = self._waiting, []
        p_lidar = _deskewed(first, found.motion)
        self._insert(nav_state(self._state).to_world(self._voxel_filter(p_lidar)[1]))
        self._warnings = [text for text in (self._gap, found.warning) if text]
        return [self._estimate(first, p_lidar), *self._advance(rest)]

    def _process(self, scan: Scan) -> Estimate:
        """One scan: predict, measure every point at its own time, add what was seen to the map."""
        clock = Stopwatch()
        prior = MotionBetween(self._state, self._state.predicted(scan.end_ns))
        cov_prior = joint_prior(self._state, self._cov, prior.seconds, self._density.value)
        points = self._thinned(scan, prior)
        clock.lap("deskew and voxel filter")
        for low, high in self._box.follow(prior.last.p_world_lidar):
            self.map.delete_box(low, high)
            self._arrivals.forget_map()
        clock.lap("slide map")
        found = align(prior, cov_prior, points, self.map, self._until_shown if self._open else self.config, _MOST_STEPS)
        taken = found.valid and found.measurement.fitting_share >= _LEAST_FITTING
        taken = taken and found.measurement.on_map_share >= self.config.min_matched_share
        motion, cov = (found.motion, found.cov) if taken else (prior, cov_prior)
        if taken:
            self._density.update(motion, cov)
            self._open = bool(found.last.directions.weak.any())
        self._untaken = 0 if taken else self._untaken + 1
        self._state, self._cov = motion.last, cov[DOF:, DOF:]
        x = nav_state(self._state).pack()
        if taken:
            self._datum.follow(x, found.cov_expected, self._cov, found.correction)
        else:
            self._datum.follow(x, self._cov, self._cov)
        clock.lap("align")
        p_lidar = _deskewed(scan, motion)
        points_map = p_lidar[self._voxel_filter.representatives]
        p_world = nav_state(self._state).to_world(points_map)
        if taken or len(self.map) == 0:
            self._insert(p_world)
        clock.lap("map insertion")
        if taken:
            self._watch(scan, x, points_map, p_world, found)
        clock.lap("watch")
        return self._estimate(scan, p_lidar, found, taken, cov_prior[DOF:, DOF:], clock.laps)

    def _watch(
        self,
        scan: Scan,
        x: NDArray[np.float64],
        p_lidar: NDArray[np.float32],
        p_world: NDArray[np.float64],
        found: Alignment,
    ) -> None:
        """What speaks against the estimate x (36,) after a scan that fitted the map; its points (n, 3) as the map has them."""
        drift = self._long_baseline.follow(self._state.time_ns, x, p_lidar, p_world, self._datum)
        self._warnings += drift.warnings if drift is not None else []
        text = self._passing.add(scan, self._state, found.last.directions, self.map)
        self._warnings += [text] if text is not None else []

    def _thinned(self, scan: Scan, motion: MotionBetween) -> ScanPoints:
        """Means over voxels of the points as seen, and of their times; the voxels are those of the motion that is expected."""
        self._voxel_filter(_deskewed(scan, motion))
        since = (scan.time_ns - scan.start_ns).astype(np.float64)
        means = self._voxel_filter.means(np.column_stack([scan.p_lidar, since]))
        means = means[np.argsort(means[:, 3], kind="stable")]
        share = float(np.clip(self._voxel_filter.voxel_size / _INDEPENDENT_M, 0.0, 1.0)) ** 2
        return ScanPoints(means[:, :3].astype(np.float32), scan.start_ns + np.rint(means[:, 3]).astype(np.int64), share)

    def _insert(self, p_world: NDArray[np.float64]) -> None:
        self._datum.insert(*self._arrivals.insert_into(self.map, p_world, self._state.time_ns))

    def _status(self, scan: Scan, found: Alignment, taken: bool) -> Status:
        status = self._weak_spell.status(scan.end_ns, found.last.directions, taken)
        since_s = 0.0 if self._judged_ns is None else (scan.end_ns - self._judged_ns) * 1e-9
        self._judged_ns = scan.end_ns
        if status == "weak":
            self._weak_s += since_s
        elif status == "ok":
            self._weak_s = max(0.0, self._weak_s - _MADE_GOOD * since_s)
        self._longest_weak_s = max(self._longest_weak_s, self._weak_s)
        return status

    def _estimate(
        self,
        scan: Scan,
        p_lidar: NDArray[np.float32],
        found: Alignment | None = None,
        taken: bool = True,
        cov_prior: NDArray[np.float64] | None = None,
        timing_s: Mapping[str, float] | None = None,
    ) -> Estimate:
        """What is said of a scan; without an alignment it is the first one, which is exact by definition."""
        state, warnings = nav_state(self._state), tuple(self._warnings)
        self._warnings = []
        covariance = np.zeros((TANGENT, TANGENT))
        own, nav = np.r_[0:6, VELOCITY], np.r_[0:6, T_V : T_V + 3]
        covariance[np.ix_(nav, nav)] = self._cov[np.ix_(own, own)]
        measured = found is not None and taken
        rejected = dict(found.measurement.rejected()) if found else {}
        if found and not taken:
            rejected["scan without an update"] = found.last.used
        share = np.zeros(6)
        if measured and cov_prior is not None:
            share = np.clip(1.0 - self._cov.diagonal()[:6] / cov_prior.diagonal()[:6], 0.0, 1.0)
        status: Status = "ok" if self._gap is None else "lost"
        return Estimate(
            time_ns=scan.end_ns,
            state=state,
            covariance=covariance,
            pose_covariance=self._datum.pose_covariance(state.pack()),
            status=self._status(scan, found, taken) if found else status,
            weak_directions=WeakDirection.all_of(found.last.directions) if found and taken else (),
            lidar_share=share,
            points_raw=len(scan) + sum(scan.rejected.values()),
            points_filtered=found.measurement.points if found else 0,
            points_used=found.last.used if found and taken else 0,
            rejected=rejected,
            residual_rms=found.last.residual_rms if found else 0.0,
            iterations=found.steps if found else 0,
            converged=found.converged if found else True,
            warnings=warnings,
            timing_s=dict(timing_s or {}),
            p_lidar=p_lidar,
            intensity=scan.intensity,
            lidar=scan.lidar,
        )


def _deskewed(scan: Scan, motion: MotionBetween) -> NDArray[np.float32]:
    """The points (N, 3) as the LiDAR at the end of the motion would have seen them."""
    nodes = motion.nodes(np.linspace(0.0, motion.seconds, _NODES))
    out = np.empty_like(scan.p_lidar)
    deskew_into(scan.p_lidar, scan.time_ns, motion.first.time_ns, nodes, len(nodes), nav_state(motion.last).pack(), out)
    return out
