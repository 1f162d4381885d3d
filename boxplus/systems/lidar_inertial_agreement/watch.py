"""The agreement of both sensors, watched while an estimator runs.

Every few seconds the last scans are registered without the IMU and compared with it (`compare_sensors`), on a thread beside the
estimator; the verdict is taken up a fixed number of scans later, and waited for, so that the run does not depend on the machine;
live, where a scan must not wait, at the first scan after these at which it is there. Where the estimator itself has a suspicion
the comparison comes at once, and its verdict sooner.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.hypotheses import (
    contradictions,
    judges,
    judges_clocks,
    judges_rotation,
    judges_scale,
    least_scale,
    shows_mounting,
    slope_of,
)
from boxplus.systems.lidar_inertial_agreement.lengths import FEWEST_SLOPES, lengths_known, lengths_of_many
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import thinned
from boxplus.systems.lidar_inertial_agreement.mounting_in_use import mounting_in_use, shows_about
from boxplus.systems.lidar_inertial_agreement.mountings import Turn, mounting_of_many, turn_from
from boxplus.systems.lidar_inertial_agreement.shown import Shown, ShownByMotion
from boxplus.systems.lidar_inertial_agreement.stretches import Stretches

_DRIFT_S, _DRIFT_DEVIATIONS = 0.012, 4.0
_WINDOW_S = 4.0
_FEWEST_SCANS = 20
_MOST_POINTS = 6000
_TAKEN_UP_AFTER, _TAKEN_UP_EARLY = 40, 10  # scans, and when the estimator suspects something
_UNDECIDED_EVERY_S = 4.0  # until the motion has once shown enough
_DECIDED_EVERY_S = (8.0, 8.0, 16.0, 20.0)
_SUSPECTED_EVERY_S = 2.0
_MOST_SLOPES = 6  # that are asked for sooner than what is decided
_OF_ACCELERATIONS = ("length_scale", "force_sign")  # causes that leave rotations as they are


class Watch:
    """Follows the scans and samples of one run.

    Args:
        config: of the odometry.
        T_declared: T_imu_lidar (4, 4) as given; None where it is estimated while running.
        live: take a verdict up when it is there instead of waiting for it.

    Attributes:
        contradiction: what the newest comparison that could decide found wrong; None while the sensors agree.
        mounting_borne_out: whether rotations have shown the mounting about all axes, and it was the one in use.
    """

    def __init__(self, config: RegistrationConfig, T_declared: NDArray[np.float64] | None, *, live: bool = False) -> None:
        self.contradiction: Finding | None = None
        self.mounting_borne_out = False
        self._config = config.model_copy(update={"threads": 1})
        self._T_declared, self._live = T_declared, live
        self._scans: deque[Scan] = deque()
        self._imu: deque[ImuSamples] = deque()
        self._expected: deque[Twist] = deque()
        self._pool: ThreadPoolExecutor | None = None
        self._pending: Future[Agreement] | None = None
        self._scans_since = 0
        self._due_ns: int | None = None
        self._suspected_ns = 0
        self._take_up_after = _TAKEN_UP_AFTER
        self._decided = 0
        self._doubted = False
        self._scale: Finding | None = None  # of the gyroscope, said once
        self._scale_was_right = False
        self._astray: Finding | None = None
        self._blind_ns: int | None = None  # end of the newest scan within which samples are missing
        self._T_last: NDArray[np.float64] | None = None
        self._T_compared: NDArray[np.float64] = np.eye(4)
        self._first_with_clocks: Agreement | None = None
        self._slopes: Stretches[tuple[float, float]] = Stretches()
        self._turns: Stretches[Turn] = Stretches()
        self._shown = ShownByMotion(None if T_declared is None else T_declared[:3, :3])

    @property
    def shown(self) -> tuple[Shown, ...]:
        """What the motion has shown of the sensors so far, part by part."""
        return self._shown.parts(self._slopes.said, self.contradiction)

    def add(
        self,
        scan: Scan,
        imu: ImuSamples,
        T_imu_lidar: NDArray[np.float64],
        expected: Twist,
        *,
        suspicious: bool = False,
        blind: bool = False,
    ) -> str | None:
        """Take a scan and its samples in; returns a new contradiction, a sentence, or None.

        Args:
            scan, imu: in order of time.
            T_imu_lidar: (4, 4) in use now.
            expected: how the estimator believes that the LiDAR moved within the scan.
            suspicious: whether to compare now, whenever the next comparison is due.
            blind: samples are missing within the scan: as long as it is among the last ones nothing is compared.
        """
        self._T_last = T_imu_lidar
        self._scans.append(thinned(scan, _MOST_POINTS))
        self._imu.append(imu)
        self._expected.append(expected)
        while self._scans[-1].end_ns - self._scans[0].start_ns > _WINDOW_S * 1e9 and len(self._scans) > _FEWEST_SCANS:
            self._scans.popleft()
            self._imu.popleft()
            self._expected.popleft()
        if self._due_ns is None:
            self._due_ns = scan.start_ns + round(_WINDOW_S * 1e9)
        self._scans_since += 1
        news = None
        taken_up = self._pending is not None and self._scans_since >= self._take_up_after
        if self._pending is not None and taken_up and not (self._live and not self._pending.done()):
            news = self._take_up(self._pending.result())
            self._pending = None
        if blind:
            self._blind_ns = scan.end_ns
        if len(self._scans) < _FEWEST_SCANS or self._blind:
            return news
        # What has been named need not be looked for again at once.
        early = suspicious and self.contradiction is None and scan.end_ns >= self._suspected_ns
        if self._pending is None and (scan.end_ns >= self._due_ns or early):
            self._suspected_ns = scan.end_ns + round(_SUSPECTED_EVERY_S * 1e9)
            self._take_up_after = _TAKEN_UP_EARLY if early else _TAKEN_UP_AFTER
            if self._pool is None:
                self._pool = ThreadPoolExecutor(1, thread_name_prefix="boxplus-watch")
            self._pending = self._pool.submit(self._comparison(T_imu_lidar))
            self._scans_since = 0
        return news

    def finish(self) -> str | None:
        """No more scans will come: take up what is still under way, and compare the last scans if nothing has decided yet.

        A gyroscope's scale that was found once, and never found right, is said: no other comparison will.
        """
        news = None
        if self._pending is not None:
            news = self._take_up(self._pending.result())
            self._pending = None
        if not self._decided and len(self._scans) >= _FEWEST_SCANS and not self._blind and self._T_last is not None:
            news = self._take_up(self._comparison(self._T_last)()) or news
        if self._scale is not None and not self._scale_was_right and self.contradiction is None:
            self.contradiction, news = self._scale, self._scale.text
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
        return news

    @property
    def _blind(self) -> bool:
        """Whether samples are missing within one of the last scans."""
        return self._blind_ns is not None and self._scans[0].end_ns <= self._blind_ns

    def _comparison(self, T_imu_lidar: NDArray[np.float64]) -> Callable[[], Agreement]:
        scans, expected, config = list(self._scans), list(self._expected), self._config
        imu = ImuSamples.joined(self._imu)
        T_declared = self._T_declared
        T_expected = self._T_compared = T_imu_lidar.copy()
        return lambda: compare_sensors(scans, imu, config, T_expected=T_expected, T_declared=T_declared, expected=expected)

    def _take_up(self, agreement: Agreement) -> str | None:
        self._shown.add(agreement)
        findings = contradictions(agreement, self._T_declared)
        if self._T_declared is None and not findings:
            findings = [finding for finding in [mounting_in_use(agreement, self._T_compared)] if finding is not None]
        other_mounting = self._by_all_stretches(agreement, findings)
        if other_mounting is not None or (shows_mounting(agreement) and not findings):
            self.mounting_borne_out = other_mounting is None
        # Registrations that went astray turn like nothing else either: once is not enough to part two sensors.
        doubted, self._doubted = self._doubted, bool(findings) and findings[0].cause == "not_together"
        if self._doubted and not doubted:
            findings = []
        drift = self._drift(agreement)
        if drift is not None:
            findings.insert(0, drift)
        found = self._with_lengths(agreement, findings)
        findings = self._without_single_scale(agreement, found)
        held_back = len(findings) < len(found)
        if other_mounting is not None and not any(finding.cause == "extrinsic" for finding in findings):
            findings.append(other_mounting)
        if agreement.astray is not None:
            self._astray = agreement.astray
            findings.append(agreement.astray)
        decisive = bool(findings) or judges_rotation(agreement)
        end_ns = int(agreement.path.time_ns[-1]) if len(agreement.path) else 0
        wait, news = _UNDECIDED_EVERY_S, None
        if decisive:
            asks_lengths = 0 < len(self._slopes.said) < _MOST_SLOPES and not lengths_known(self._slopes.said)
            if not asks_lengths and not held_back:
                wait = _DECIDED_EVERY_S[min(self._decided, len(_DECIDED_EVERY_S) - 1)]
            self._decided += 1
            named = self.contradiction
            if findings and (named is None or findings[0].cause != named.cause):
                self.contradiction = news = findings[0]
            elif findings and findings[0].axis is not None:
                self.contradiction = findings[0]  # a mounting that is being corrected: about the axis it is off now
            elif not findings and not held_back and named is not None and _clears(named, agreement):
                self.contradiction = self._astray  # a position once lost is not found again by moving rightly
        self._due_ns = end_ns + round(wait * 1e9)
        return None if news is None else news.text

    def _drift(self, agreement: Agreement) -> Finding | None:
        """Clocks that run at different speeds: the offset of two comparisons differs."""
        if agreement.rotation is None or not judges_clocks(agreement.rotation):
            return None
        if self._first_with_clocks is None:
            self._first_with_clocks = agreement
            return None
        return clock_drift(self._first_with_clocks, agreement)

    def _by_all_stretches(self, agreement: Agreement, findings: list[Finding]) -> Finding | None:
        """What all stretches so far say together of a mounting that was given; the newest is one where nothing else is off."""
        rotation = agreement.rotation
        sound = all(finding.cause in _OF_ACCELERATIONS for finding in findings)
        if self._T_declared is not None and rotation is not None and sound and judges_rotation(agreement):
            self._turns.add(agreement, turn_from(rotation, self._T_declared[:3, :3]))
        return mounting_of_many(self._turns.said)

    def _without_single_scale(self, agreement: Agreement, findings: list[Finding]) -> list[Finding]:
        """The findings, without a gyroscope's scale that was not found before, or was found right since.

        Such a scale is wrong all the time. Beside traffic that went along as it sped up, the rings of a car made its turns twice
        what they were, once; comparisons that do not show a scale say nothing of it.
        """
        scale = next((finding for finding in findings if finding.cause == "gyro_scale"), None)
        if scale is not None:
            before, self._scale = self._scale, scale
            known = before is not None or (self.contradiction is not None and self.contradiction.cause == scale.cause)
            return findings if known else [finding for finding in findings if finding is not scale]
        rotation = agreement.rotation
        if rotation is not None and judges_scale(rotation) and abs(rotation.scale - 1.0) < least_scale(rotation):
            self._scale, self._scale_was_right = None, True
        return findings

    def _with_lengths(self, agreement: Agreement, findings: list[Finding]) -> list[Finding]:
        """The findings, with what all stretches so far say of the lengths.

        Four seconds of a walk show a tenth hardly, many stretches together do. And a factor is the same in all of them: one that
        only the newest asks for, against the others, is a path that lags behind.
        """
        if agreement.in_feet is not None or any(finding.cause != "length_scale" for finding in findings):
            return findings
        slope = slope_of(agreement)
        if slope is not None:
            self._slopes.add(agreement, slope)
        if len(self._slopes.said) < FEWEST_SLOPES:
            return findings
        lengths = lengths_of_many(self._slopes.said)
        return [] if lengths is None else [lengths]


def _clears(finding: Finding, agreement: Agreement) -> bool:
    """Whether a comparison that found nothing wrong would have found this."""
    return judges(finding.cause, agreement) if finding.axis is None else shows_about(agreement, finding.axis)


def clock_drift(earlier: Agreement, later: Agreement) -> Finding | None:
    """Clocks that run at different speeds, or one that steps: both comparisons show the offset, and it differs."""
    before, after = earlier.rotation, later.rotation
    if before is None or after is None or not judges_clocks(before) or not judges_clocks(after):
        return None
    change, known = after.offset_s - before.offset_s, float(np.hypot(before.offset_std_s, after.offset_std_s))
    if abs(change) < max(_DRIFT_S, _DRIFT_DEVIATIONS * known):
        return None
    seconds = float(later.path.time_ns[-1] - earlier.path.time_ns[-1]) * 1e-9
    return Finding(
        "clock_drift",
        f"within {seconds:.0f} s the offset of the LiDAR's clock to the IMU's changed by {change * 1e3:+.0f} ± "
        f"{known * 1e3:.0f} ms: the clocks drift apart or one of them steps; synchronise them",
    )
