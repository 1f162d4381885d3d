"""From a recording and what the odometry made of it to what refinement works on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import quaternion
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame, Sequencer
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.observed_noise import ObservedNoise
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.planes.point_store import PointStore
from boxplus.systems.refinement.planes.slices import Slice, cut, slices_that_fit
from boxplus.systems.refinement.unshown import after_unshown, open_steps

_LEAST_FOUND = 0.9  # of the odometry's scans, that the recording has
_MOST_OTHERS = 0.5  # of these, that have another number of points


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRows:
    """What the odometry said of R scans.

    Attributes:
        time_ns: (R,) int64, ascending; states: R of them; status: (R,) text.
        covariance: (R, 6, 6) of the poses, [θ, p], relative to the first one; None where nothing is known of it, which is enough
            as long as every scan is "ok".
        unmeasured: (R, 3, 3) sums of t tᵀ over the directions that each scan left open, t the part of a direction that moves
            along the world's axes; None: nobody knows, and any may be.
        points: (R,) of each scan, those that could not be used included; None: nobody knows.

    Raises:
        InputError: a covariance is missing or not finite.
    """

    time_ns: NDArray[np.int64]
    states: list[NavState]
    status: NDArray[np.str_]
    covariance: NDArray[np.float64] | None = None
    unmeasured: NDArray[np.float64] | None = None
    points: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        again = "run the odometry again: what it was not shown no refinement can tell"
        if self.covariance is None:
            if (not_ok := int(np.count_nonzero(self.status != "ok"))) > 0:
                raise InputError(
                    "a covariance of every pose, as some scans are weak or lost",
                    f"none, with {not_ok} of {len(self.status)} scans weak or lost",
                    again,
                )
            return
        unknown = np.flatnonzero(~np.isfinite(self.covariance).all(axis=(1, 2)))
        if len(unknown):
            at = f"{len(unknown)} with NaN or infinity, the first of the scan at {self.time_ns[unknown[0]]} ns"
            raise InputError("a finite covariance of every pose", at, again)

    @classmethod
    def of(cls, estimates: Sequence[Estimate]) -> OdometryRows:
        """What an odometry said, scan after scan."""
        moves = [[direction.moves for direction in e.weak_directions] for e in estimates]
        return cls(
            np.array([e.time_ns for e in estimates], dtype=np.int64),
            [e.state for e in estimates],
            np.array([e.status for e in estimates], dtype=np.str_),
            np.array([e.pose_covariance for e in estimates]).reshape(-1, 6, 6),
            np.array([sum((np.outer(t, t) for t in own), np.zeros((3, 3))) for own in moves]).reshape(-1, 3, 3),
            np.array([e.points_raw for e in estimates], dtype=np.int64),
        )

    @property
    def is_unshown(self) -> NDArray[np.bool_]:
        """(R,) see `unshown.after_unshown`."""
        return after_unshown(self.status)

    @property
    def open_steps(self) -> NDArray[np.float64]:
        """(R, 3, 3), see `unshown.open_steps`; zero where nothing is known of the covariance."""
        if self.covariance is None:
            return np.zeros((len(self.time_ns), 3, 3))
        R = np.stack([state.R_world_imu for state in self.states])
        T = np.hstack([quaternion.from_matrix(R), [state.p_world_imu for state in self.states]])
        any_ = np.broadcast_to(np.eye(3), (len(T), 3, 3))
        return open_steps(self.status, T, self.covariance, any_ if self.unmeasured is None else self.unmeasured)


def collect(
    events: Iterable[Scan | ImuSamples],
    rows: OdometryRows,
    odometry: LioConfig,
    config: RefinementConfig,
    store: PointStore | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> FinishedRun:
    """Go through a recording once more and keep what refinement needs.

    Args:
        events: of the recording.
        rows: of the odometry over it, and its settings `odometry`.
        store: where the points go; None for memory.
        should_stop: asked between events; True ends the reading, and what was read so far is returned.

    Raises:
        InputError: the recording is another one than the odometry went over, or too short to refine.
    """
    return _Collector(rows, odometry, config, store if store is not None else PointStore()).run(events, should_stop)


class _Collector:
    def __init__(self, rows: OdometryRows, odometry: LioConfig, config: RefinementConfig, store: PointStore) -> None:
        self._rows, self._config, self._store = rows, config, store
        self._max_gap_s = odometry.max_imu_gap
        self._number = {int(t): k for k, t in enumerate(rows.time_ns)}
        self._noise = ObservedNoise(odometry)
        self._densities: list[NDArray[np.float64]] = []
        self._imu: list[ImuSamples] = []
        self._time_ns: list[int] = []
        self._T: list[NDArray[np.float64]] = []
        self._state: list[NDArray[np.float64]] = []
        self._is_end: list[bool] = []
        self._open_of_row = rows.open_steps
        self._open: list[NDArray[np.float64]] = []
        self._row: list[int] = []
        self._newest: NDArray[np.float32] | None = None  # points of the latest slice, to which the next one adds
        self._next = 0
        self._others = 0  # scans with the time of one that the odometry went over, and not its points

    def run(self, events: Iterable[Scan | ImuSamples], should_stop: Callable[[], bool]) -> FinishedRun:
        sequencer = Sequencer()
        for event in events:
            if should_stop():
                break
            if isinstance(event, Scan):
                sequencer.add_scan(event)
            else:
                sequencer.add_imu(event)
            self._take(sequencer.frames())
        else:
            self._take(sequencer.frames(flush=True))
        return self._finished()

    def _take(self, frames: list[Frame]) -> None:
        for frame in frames:
            self._imu.append(frame.imu)
            self._densities.append(self._noise.update(frame.imu))
            number = self._number.get(frame.scan.end_ns)
            if number is None or number < self._next:
                continue
            self._next = number + 1
            if self._rows.points is not None:
                self._others += len(frame.scan) + sum(frame.scan.rejected.values()) != self._rows.points[number]
            follows = number > 0 and bool(self._time_ns) and self._time_ns[-1] == frame.begin_ns == self._rows.time_ns[number - 1]
            before = self._rows.states[number - 1] if follows else None
            if self._time_ns and before is None:
                raise InputError(
                    "a run without a break", f"none of the scan before that at {frame.scan.end_ns} ns", "refine its parts"
                )
            after = self._rows.states[number]
            count = slices_that_fit(frame.imu.time_ns, frame.duration_s, self._config.slices)
            for part in cut(frame, before, after, count, self._max_gap_s, self._config.max_points):
                self._time_ns.append(part.time_ns)
                self._T.append(part.T_world_imu)
                self._state.append(np.concatenate([part.v_world, after.bias_accel, after.bias_gyro]))
                self._is_end.append(part.is_end)
                self._open.append(self._open_of_row[number])
                self._row.append(number)
                self._keep(part, is_placed=self._rows.status[number] != "lost")

    def _keep(self, part: Slice, *, is_placed: bool) -> None:
        """Its points and, where it is known where they belong, those it has for the slice before, which is whole then."""
        if self._newest is not None:
            self._store.append(np.concatenate([self._newest, part.p_lidar_before]) if is_placed else self._newest)
        self._newest = part.p_lidar if is_placed else part.p_lidar[:0]

    def _finished(self) -> FinishedRun:
        if self._newest is not None:
            self._store.append(self._newest)
        found, asked = sum(self._is_end), len(self._rows.time_ns)
        if found < max(_LEAST_FOUND * asked, 2):
            raise InputError(
                f"the recording that the odometry went over, with {asked} scans",
                f"{found} of them",
                "give the recording with --recording, read with the same options as for the odometry",
            )
        if self._others > _MOST_OTHERS * found:  # simulations, and clocks that begin anew with each recording, share their times
            raise InputError(
                "the recording that the odometry went over",
                f"another number of points in {self._others} of the {found} scans that have its times",
                "give the recording with --recording, read with the same options as for the odometry",
            )
        last = self._rows.states[self._next - 1]
        imu = ImuSamples.joined(self._imu)
        time_ns, first = np.unique(imu.time_ns, return_index=True)
        gyro, accel, gyro_walk, accel_walk = np.sqrt(np.median(self._densities, axis=0)).tolist()
        return FinishedRun(
            time_ns=np.array(self._time_ns, dtype=np.int64),
            T_world_imu=np.stack(self._T),
            velocity_bias=np.stack(self._state),
            gravity_world=last.gravity_world,
            T_imu_lidar=np.concatenate([quaternion.from_matrix(last.R_imu_lidar[None])[0], last.p_imu_lidar]),
            points=self._store.arrays(),
            imu=ImuSamples(time_ns, imu.gyro[first], imu.accel[first]),
            noise=ImuNoise(gyro=gyro, accel=accel, gyro_walk=gyro_walk, accel_walk=accel_walk),
            is_end=np.array(self._is_end),
            open_steps=np.stack(self._open),
            is_unshown=self._rows.is_unshown[self._row],
            covariance=None if self._rows.covariance is None else self._rows.covariance[self._row],
        )
