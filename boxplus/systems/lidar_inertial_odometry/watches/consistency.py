"""Whether the LiDAR bears out what the IMU predicts, scan by scan.

The filter corrects what it predicted wrongly, scan after scan, and hides a wrong unit, mounting or clock that way. Cheap sums
over the scans raise a suspicion: corrections of the rotation that grow with the rotation itself, corrections far beyond what
the prediction's covariance allows, points that no longer fit the map. What is behind it is found by comparing the sensors
without the filter (`lidar_inertial_agreement.watch`); a contradiction that lasts is named even where that cannot tell its cause.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import BA, BW, PL, RL, T_BA, T_BW, T_THETA_L, TANGENT, P, R, V, boxminus_into
from boxplus.manifolds.so3 import log_into
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import Twist
from boxplus.systems.lidar_inertial_agreement.shown import Shown
from boxplus.systems.lidar_inertial_agreement.watch import Watch
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.mounted_update import MountedUpdate
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import T_imu_lidar_of
from boxplus.systems.lidar_inertial_odometry.start.scan_span import span_problem
from boxplus.systems.lidar_inertial_odometry.watches.corrections import Corrections
from boxplus.systems.lidar_inertial_odometry.watches.pause import Pause
from boxplus.systems.lidar_inertial_odometry.watches.steady_bias import SteadyBias
from boxplus.systems.lidar_inertial_odometry.watches.stuck_sensor import StuckSensor

_KEEP = 0.96  # of the sums of rotations, from scan to scan
_LEAST_TURN = 20.0 * 0.005**2  # rad², of the faded sum: below it no ratio means anything
_SUSPICIOUS_SHARE = 0.01  # of the squared rotation, corrected
_INNOVATION_KEEP = 0.8
_SUSPICIOUS_INNOVATION, _CONTRADICTED_INNOVATION = 2.0, 25.0  # mean square of the innovation, in variances a direction
_DOUBTED_INNOVATION = 1.0  # most sound runs never exceed 0.2, with several IMU samples a scan; some do for less than two seconds
_CONTRADICTED_STREAK_S, _DOUBTED_STREAK_S = 1.0, 2.0
_FEWEST_SAMPLES = 5  # of the IMU within a scan; between fewer ones the motion is anybody's guess
_ONE_SCAN = 100.0  # no single scan counts for more: it takes several to contradict
_LOST_STREAK = 3
_LEAST_FITTING = 0.6  # of the points with a plane lie on it; 0.92 at least on sound runs
_FASTEST_M_S = 120.0
_FAST_M_S, _THIN_MAP_NS = 8.0, 1_500_000_000
_LARGEST_BIAS = 0.1, 0.7  # rad/s, m/s²: more than an inertial sensor in order has, and as known as three deviations
_MEASUREMENT_SIGMA = np.repeat([1e-3, 0.01], 3)  # rad, m: of a registration, beside the prediction's covariance


@dataclass
class _Streak:
    """How long something has held, scan after scan."""

    since_ns: int | None = None

    def seconds(self, holds: bool, begin_ns: int, now_ns: int) -> float:
        """0 where it does not hold; else the time since `begin_ns` of the first scan in which it did."""
        if not holds:
            self.since_ns = None
            return 0.0
        self.since_ns = begin_ns if self.since_ns is None else self.since_ns
        return (now_ns - self.since_ns) * 1e-9


class Consistency:
    """Follows the scans of one run.

    Args:
        config: of the odometry.
        live: no scan waits for the comparison of the sensors.
    """

    def __init__(self, config: LioConfig, *, live: bool = False) -> None:
        self._min_matched_share = config.min_matched_share
        self._max_imu_gap = config.max_imu_gap
        self._mounting_given = config.T_declared is not None
        self._watch = Watch(config, config.T_declared, live=live)
        self._turned = 0.0
        self._corrected = 0.0
        self._innovation = 0.0
        self._contradicted, self._doubted, self._misfit = _Streak(), _Streak(), _Streak()
        self._innovation_text: str | None = None
        self._unmatched = 0
        self._previous_start_ns: int | None = None
        self._end_ns = 0  # of the scan before
        self._first_biases: NDArray[np.float64] | None = None
        self._steady, self._corrections = SteadyBias(config.gyro_bias_walk), Corrections()
        self._stuck = StuckSensor()
        self._corrected_from_ns: int | None = None
        self._told: set[str] = set()
        self.pause = Pause()

    @property
    def contradiction(self) -> str | None:
        """What makes the estimate not to be trusted; a sentence."""
        found = self._watch.contradiction
        text = found.text if found is not None else self._innovation_text
        return None if text is None else self.pause.preface + text

    @property
    def mounting_borne_out(self) -> bool:
        """Whether the motion has shown the mounting about all axes, and it was the one in use."""
        return self._watch.mounting_borne_out

    @property
    def shown(self) -> tuple[Shown, ...]:
        """What the motion has shown of the sensors so far."""
        return self._watch.shown

    @property
    def lost(self) -> bool:
        """Whether the last scans no longer lie on the map."""
        return self._unmatched >= _LOST_STREAK

    def update(
        self,
        frame: Frame,
        x_before: NDArray[np.float64],
        x_prior: NDArray[np.float64],
        update: MountedUpdate,
        matched_share: float,
        fitting_share: float,
    ) -> list[str]:
        """Take one scan in; returns what is wrong, one sentence each.

        Args:
            frame: the scan and its IMU samples.
            x_before, x_prior: (36,) state at the end of the scan before, and predicted.
            update: what the scan has made of the prediction.
            matched_share: points that lie on the map over points filtered.
            fitting_share: of the points with a plane, those that lie on it.
        """
        posterior = update.posterior
        x = posterior.x
        self._unmatched = self._unmatched + 1 if matched_share < self._min_matched_share else 0
        before = x_before[R : R + 9].reshape(3, 3)
        predicted = _turn(before.T @ x_prior[R : R + 9].reshape(3, 3))
        measured = _turn(before.T @ x[R : R + 9].reshape(3, 3))
        corrected = measured - predicted
        # Of whichever sensor turned more: a gyroscope that claims not to turn is wrong as well.
        self._turned = _KEEP * self._turned + max(float(predicted @ predicted), float(measured @ measured))
        self._corrected = _KEEP * self._corrected + float(corrected @ corrected)
        correction = np.zeros(TANGENT)
        boxminus_into(x, x_prior, correction)
        stuck = self._stuck.update(frame.imu, measured, x_before[BW : BW + 3])
        warnings = self._span(frame) + self._contradicting("stuck", stuck)
        warnings += self._innovate(frame, correction, update)
        warnings += self._fit(frame, fitting_share)
        warnings += self._biases(x, posterior.cov)
        warnings += self._steadiness(frame, update)
        warnings += self._pushes(frame, correction, update)
        suspicious = (
            (self._turned > _LEAST_TURN and self._corrected > _SUSPICIOUS_SHARE * self._turned)
            or self._innovation > _SUSPICIOUS_INNOVATION
            or self._unmatched > 1
        )
        news = self._watch.add(
            frame.scan,
            frame.imu,
            T_imu_lidar_of(x),
            _lidar_twist(x_before, x, frame.duration_s),
            suspicious=suspicious,
            blind=frame.largest_gap_s > self._max_imu_gap,
        )
        if news is not None:
            warnings.append(news)
        self._end_ns = frame.scan.end_ns
        self.pause.update(self._end_ns, self.contradiction is not None)
        if self._unmatched == _LOST_STREAK:
            warnings.append(
                f"only {matched_share:.0%} of the points fit the map, and too few in {_LOST_STREAK} scans in a row: the "
                "estimate has left the map and is not to be trusted"
            )
        return warnings

    def finish(self) -> str | None:
        """No more scans will come; returns a contradiction that is new."""
        news = self._watch.finish()
        self.pause.update(self._end_ns, self.contradiction is not None)
        return news

    def _innovate(self, frame: Frame, correction: NDArray[np.float64], update: MountedUpdate) -> list[str]:
        """The correction of the pose against what the prediction's covariance allows, along the directions that were measured.

        With the mounting known: what the pose of the IMU moves because the mounting does is no contradiction.
        """
        posterior, cov_prior = update.posterior, update.cov_prior
        x, directions = posterior.x, posterior.last.directions
        speed = math.hypot(*x[V : V + 3].tolist())
        if speed > _FASTEST_M_S:
            self._innovation_text = f"the estimate moves at {speed:.0f} m/s, which no platform with a LiDAR does"
            return [self._innovation_text] if self._once("speed") else []
        if not posterior.valid or directions.weak.all():
            self._contradicted, self._doubted = _Streak(), _Streak()
            return []
        off = correction[:6] - update.B_prior[:6] @ correction[T_THETA_L:TANGENT]
        now = _largest_innovation(directions.vectors, directions.weak, directions.lever_arm, off, cov_prior)
        self._innovation = _INNOVATION_KEEP * self._innovation + (1.0 - _INNOVATION_KEEP) * min(now, _ONE_SCAN)
        end_ns = frame.scan.end_ns
        doubted = self._innovation > _DOUBTED_INNOVATION and len(frame.imu) >= _FEWEST_SAMPLES
        told = []
        if self._doubted.seconds(doubted, end_ns, end_ns) > _DOUBTED_STREAK_S and self._once("doubt"):
            told.append(
                f"for {_DOUBTED_STREAK_S:g} s the LiDAR has corrected what the IMU predicts by more than noise explains: "
                "T_imu_lidar, the clocks, a unit or a topic may be wrong (see 'boxplus inspect')"
            )
        lasted = self._contradicted.seconds(self._innovation >= _CONTRADICTED_INNOVATION, end_ns, end_ns)
        if lasted < _CONTRADICTED_STREAK_S or self._innovation_text is not None:
            return told
        self._innovation_text = (
            f"for {lasted:.1f} s the LiDAR has contradicted what the IMU predicts, scan after scan, by "
            f"{np.sqrt(self._innovation):.0f} standard deviations: units, mounting, clocks or topics of the two do not "
            "fit together (see 'boxplus inspect')"
        )
        return [*told, self._innovation_text]

    def _fit(self, frame: Frame, fitting_share: float) -> list[str]:
        """Whether the points near surfaces of the map lie on them: a pose that has gone astray fits some, and misses most."""
        lasted = self._misfit.seconds(fitting_share <= _LEAST_FITTING, frame.scan.start_ns, frame.scan.end_ns)
        if lasted < _CONTRADICTED_STREAK_S or self._innovation_text is not None:
            return []
        self._innovation_text = (
            f"for {lasted:.1f} s only {fitting_share:.0%} of the points near surfaces of the map lie on them: the estimate has "
            "come away from its map; the IMU is not the one of this LiDAR, units, mounting or clocks do not fit together (see "
            "'boxplus inspect'), or most of what is seen moves"
        )
        return [self._innovation_text]

    def _biases(self, x: NDArray[np.float64], covariance: NDArray[np.float64]) -> list[str]:
        """Whether the biases are those of a sensor in order: at a steady turn they take up whatever else is wrong.

        One that was so from the start may be a bad sensor's; none changes by as much during a run.
        """
        if self._first_biases is None:
            self._first_biases = x[BW : BA + 3].copy()
        large = changed = False
        for at, tangent, most in ((BW, T_BW, _LARGEST_BIAS[0]), (BA, T_BA, _LARGEST_BIAS[1])):
            P = covariance[tangent : tangent + 3, tangent : tangent + 3]
            large |= _surely_above(x[at : at + 3], P, most)
            changed |= _surely_above(x[at : at + 3] - self._first_biases[at - BW : at - BW + 3], P, most)
        if not large or not self._once("changed bias" if changed else "bias"):
            return []
        gyro, accel = np.degrees(np.linalg.norm(x[BW : BW + 3])), np.linalg.norm(x[BA : BA + 3])
        text = (
            f"the IMU's biases came to {gyro:.1f} deg/s and {accel:.2f} m/s², more than a sensor in order has: its scale or "
            "T_imu_lidar is wrong, which biases take up as long as the platform turns steadily, or the sensor is bad"
        )
        if changed and self._innovation_text is None:
            self._innovation_text = text
        return [text]

    def _steadiness(self, frame: Frame, update: MountedUpdate) -> list[str]:
        """Whether the gyroscope's bias is where it was known to be."""
        posterior = update.posterior
        # Between few samples the turn is anybody's guess, and a bias takes it up.
        if not posterior.valid or len(frame.imu) < _FEWEST_SAMPLES:
            return []
        whole, known = (P.diagonal()[T_BW : T_BW + 3] for P in (posterior.cov, update.cov))
        bias, by_mounting = posterior.x[BW : BW + 3], np.maximum(whole - known, 0.0)
        turns = frame.imu.gyro - bias
        rate = float(np.sqrt(np.einsum("ni,ni->n", turns, turns)).mean())
        return self._contradicting("steady", self._steady.update(frame.scan.end_ns, bias, known, by_mounting, rate))

    def _pushes(self, frame: Frame, correction: NDArray[np.float64], update: MountedUpdate) -> list[str]:
        """Whether the corrections of the velocity are as white as noise is."""
        # A mounting that is still being found moves what the IMU predicts, and no correction is white.
        sought = not self._mounting_given and not self.mounting_borne_out
        gap = frame.largest_gap_s > self._max_imu_gap or len(frame.imu) < _FEWEST_SAMPLES
        if self._corrected_from_ns is None:  # a map as thick as a scan, metres from the next one, pulls fast ones back and forth
            fast = math.hypot(*update.posterior.x[V : V + 3].tolist()) > _FAST_M_S
            self._corrected_from_ns = frame.scan.end_ns + (_THIN_MAP_NS if fast else 0)
        thin = frame.scan.end_ns < self._corrected_from_ns or self.pause.settles(frame.scan.end_ns)
        # Of a scan off the map nothing is taken up, and the next one wants the same again.
        if sought or gap or thin or self.lost or not update.posterior.valid:
            self._corrections.clear()
            return []
        return self._contradicting("pushes", self._corrections.update(frame.scan.end_ns, correction, update))

    def _contradicting(self, key: str, text: str | None) -> list[str]:
        """A sentence that contradicts the run, told once."""
        if text is None or not self._once(key):
            return []
        if self._innovation_text is None:
            self._innovation_text = text
        return [text]

    def _once(self, key: str) -> bool:
        new = key not in self._told
        self._told.add(key)
        return new

    def _span(self, frame: Frame) -> list[str]:
        """The time a scan takes against the time between scans."""
        scan, previous = frame.scan, self._previous_start_ns
        self._previous_start_ns = scan.start_ns
        span, period = (scan.end_ns - scan.start_ns) * 1e-9, 0.0 if previous is None else (scan.start_ns - previous) * 1e-9
        problem = span_problem(span, period)
        return [problem] if problem is not None and self._once("span") else []


def _surely_above(bias: NDArray[np.float64], P: NDArray[np.float64], most: float) -> bool:
    """Whether a bias (3,) of covariance (3, 3) is longer than `most` by three standard deviations along it."""
    size = math.hypot(*bias.tolist())
    if size <= most:
        return False
    axis = bias / size
    return size - 3.0 * float(np.sqrt(axis @ P @ axis)) > most


def _lidar_twist(x_before: NDArray[np.float64], x: NDArray[np.float64], seconds: float) -> Twist:
    """Mean turn rate and velocity of the LiDAR between two states (36,), in its frame.

    Each has its own mounting: where a scan moves that, it moves the IMU's pose the other way.
    """
    R_before, R_now = (state[R : R + 9].reshape(3, 3) @ state[RL : RL + 9].reshape(3, 3) for state in (x_before, x))
    p_before, p_now = (state[R : R + 9].reshape(3, 3) @ state[PL : PL + 3] + state[P : P + 3] for state in (x_before, x))
    turned = np.empty(3)
    log_into(R_before.T @ R_now, turned)
    return turned / seconds, R_now.T @ (p_now - p_before) / seconds


@kernel
def _largest_innovation(
    vectors: NDArray[np.float64], weak: NDArray[np.bool_], lever_arm: float, off: NDArray[np.float64], cov: NDArray[np.float64]
) -> float:
    """Over the directions (columns of (6, 6)) that are not weak, the largest square of `off` (6,), by the variance there.

    Args:
        cov: (n, n), of the pose first.
    """
    largest, along = 0.0, np.empty(6)
    for direction in range(6):
        if weak[direction]:
            continue
        moved = variance = 0.0
        for i in range(6):
            along[i] = vectors[i, direction] * (lever_arm if i < 3 else 1.0)
            moved += along[i] * off[i]
            variance += (along[i] * _MEASUREMENT_SIGMA[i]) ** 2
        for i in range(6):
            for j in range(6):
                variance += along[i] * cov[i, j] * along[j]
        largest = max(largest, moved * moved / variance)
    return largest


def _turn(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) sine of the angle times the axis of a rotation (3, 3): the rotation vector, for the turns within one scan."""
    M = rotation
    return np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]) * 0.5
