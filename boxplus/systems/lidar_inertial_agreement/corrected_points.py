"""Points that were corrected for the motion within their scan before they were recorded: their times must not be used again.

Some drivers, and exports of other odometries, deliver clouds as the LiDAR would have seen them at one instant, the end of the
scan or its beginning, and leave the times of the points in. Corrected once more they are bent as much as they were before, the
other way; and as every scan shows the pose of that instant, the clocks seem to be half a scan apart, which no offset mends.

Times that run backwards (they count from the last point, or are the age of a point at the stamp) bend points the other way as
well. They are told from the former by scans that fit better still with the times turned round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, middle_of
from boxplus.systems.lidar_inertial_agreement.rotation import RotationFit, compare_rotations

_CLEARLY = 0.9  # of the misfit, with points left as they are: of corrected ones 0.62 to 0.83, of others 1.16 and more
_DOUBTFUL_S, _DEVIATIONS = 0.008, 2.0  # offset of the clocks that is worth a second look, which decides
_EXPLAINED = 0.8
_INSTANTS = {-0.5: "its beginning", 0.0: "its middle", 0.5: "its end"}  # in lengths of the scan after its middle
_AT_AN_END = 0.25  # of a scan, within which an instant is its beginning, middle or end


@dataclass(frozen=True, slots=True)
class CorrectedPoints:
    """Scans that fit one another as they are, and not when they are corrected for motion.

    Attributes:
        as_they_are, corrected: median misfit of registrations with the points left alone, and moved by their times [m].
        instant_s: after the middle of each scan, when the LiDAR was where they show it, if the clocks run together [s]; None
            where the motion does not show it.
        scan_s: length of a scan [s].
        backwards: median misfit with the points moved by their times turned round, from the last to the first [m].
    """

    as_they_are: float
    corrected: float
    instant_s: float | None
    scan_s: float
    backwards: float

    @property
    def finding(self) -> Finding:
        """What it means to a user."""
        if self.backwards < _CLEARLY * self.as_they_are:
            return Finding(
                "reversed_times",
                f"with the times of their points turned round, from the last to the first, the scans fit one another to "
                f"{self.backwards * 100:.1f} cm, and as the times are to {self.corrected * 100:.1f} cm only: they run backwards, "
                "or say how long before the end of the scan a point was measured; let the driver count them from the first point",
            )
        return Finding(
            "corrected_points",
            f"left as they are the scans fit one another to {self.as_they_are * 100:.1f} cm, and corrected for the motion within "
            f"them to {self.corrected * 100:.1f} cm only: their points have been corrected already{self._instant()}; record them "
            "as they come, or leave the times of the points out (--point-time-field none), with --lidar-time-offset where the "
            "stamp of a message is another instant",
        )

    def _instant(self) -> str:
        if self.instant_s is None:
            return ""
        share = self.instant_s / self.scan_s
        near = [name for place, name in _INSTANTS.items() if abs(share - place) < _AT_AN_END]
        side = "after" if self.instant_s >= 0.0 else "before"
        return f", to {abs(self.instant_s) * 1e3:.0f} ms {side} the middle of each scan{f', {near[0]}' if near else ''}"


def corrected_points(
    path: LidarPath,
    rotation: RotationFit | None,
    scans: Sequence[Scan],
    imu: ImuSamples,
    config: RegistrationConfig,
    guesses: Sequence[Turning],
) -> CorrectedPoints | None:
    """Whether the points were corrected before; None where nothing speaks for it, or the motion bends scans too little to show.

    Args:
        path, rotation: of these scans, corrected by their times, and how they turn against the gyroscope. The scans are
            registered once more only where the clocks seem to be apart.
        scans, imu, config, guesses: that the path was found from.
    """
    if rotation is None or rotation.explained < _EXPLAINED or not len(path):
        return None
    if abs(rotation.offset_s) < max(_DOUBTFUL_S, _DEVIATIONS * rotation.offset_std_s):
        return None
    alone = [replace(scan, time_ns=np.full(len(scan), middle_of(scan))) for scan in scans]
    again = lidar_path(alone, config, guesses)
    if not len(again):
        return None
    as_they_are, corrected = float(np.median(again.misfit)), float(np.median(path.misfit))
    turned = compare_rotations(again, imu, rotation.R_imu_lidar)
    if as_they_are > _CLEARLY * corrected or turned is None or turned.explained < _EXPLAINED:
        return None
    lengths = [scan.end_ns - scan.start_ns for scan in scans]
    instant_s = turned.offset_s if turned.knows_offset else None
    turned_round = [replace(scan, time_ns=scan.start_ns + scan.end_ns - scan.time_ns) for scan in scans]
    back = lidar_path(turned_round, config, guesses)
    backwards = float(np.median(back.misfit)) if len(back) else np.inf
    return CorrectedPoints(as_they_are, corrected, instant_s, float(np.median(lengths)) * 1e-9, backwards)
