"""Whether to believe a frame: how much it saw, whether what it saw agrees, and whether the IMU says the same.

A frame is weak where little was seen, or where what was seen contradicts itself, the calibration or the IMU; lost where nothing
was seen for longer than the IMU holds the pose. A contradiction that lasts is remembered for the whole run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu_saturation import Limit
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.partners import FLAT, LEAST_SHARE, few_are_found
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.estimate import Status
from boxplus.systems.visual_inertial_odometry.observations import Fit

_ENOUGH = 15  # landmarks that agree; fewer leave directions to the IMU
FEWEST_SEEN = 6  # landmarks without which a frame counts as blind
_CORNERS_HOLD = 5.0  # times as long as the IMU alone
_DISAGREE = 0.35  # share of a frame's landmarks that is more than outliers
_UNKNOWN_M = 100.0  # standard deviation of a position that is none
_IMU_RATIO = 1.0  # residuals of the IMU over what its noise explains
_FIT_RATIO = 2.5  # residuals of the corners over what their noise explains
_MEMORY = 0.9  # of the running means, per frame
_SUSTAINED_S = 1.0  # of a contradiction that is no accident
_TORN_M = 0.5  # standard deviation of the position after a gap of the IMU beyond which the way across it was not seen
_DARK = 12.0  # grey values: mean of an image that shows nothing


@dataclass(slots=True)
class Health:
    """Judges frame after frame.

    Attributes:
        contradiction: the first contradiction that lasted for a second, or a gap of the IMU across which too little was seen;
            poses from then on are not to be believed.
    """

    config: VioConfig
    contradiction: str | None = None
    _seen_ns: int = 0
    _agreed_ns: int = 0
    _disagreeing: float = 0.0
    _imu_ratio: float = 0.0
    _fit_ratio: float = 0.0
    _partners: float = 1.0

    def begin(self, time_ns: int) -> None:
        """A start was found."""
        self._seen_ns = self._agreed_ns = time_ns

    def judge(
        self,
        tracks: Tracks,
        fit: Fit,
        rests: bool,
        imu_gap_s: float,
        position_sigma: float,
        among_cameras: str | None = None,
        apart: str | None = None,
        limits: Sequence[Limit] = (),
    ) -> tuple[Status, tuple[str, ...]]:
        """The status of a frame, and why it is not "ok".

        Args:
            rests: the images stand still, so that the pose is held without landmarks.
            imu_gap_s: longest time between IMU samples before the frame [s].
            position_sigma: standard deviation of the position, all axes together [m].
            among_cameras: what corners show to be wrong of the cameras, which explains what else differs; None if nothing.
            apart: how the way of the cameras and the IMU's contradict each other; None where they do not.
            limits: of the IMU, which its samples before the frame reach.
        """
        time_ns, reasons = tracks.time_ns, []
        agreed = fit.agreed + fit.lines.agreed
        if agreed >= FEWEST_SEEN or rests:
            self._seen_ns = time_ns
        blind_s = (time_ns - self._seen_ns) * 1e-9
        if agreed < _ENOUGH and not rests:
            reasons.append(f"{agreed} landmarks agree with the frame, of at least {_ENOUGH}{self._view(tracks)}")
        # Corners without a depth, as one camera has them before it moves, hold the attitude and bound what position does.
        has_corners = agreed + fit.not_agreed < FEWEST_SEEN and len(tracks) >= _ENOUGH
        is_lost = blind_s > self.config.max_blind * (_CORNERS_HOLD if has_corners else 1.0)
        if is_lost:
            reasons.append(
                f"no landmark was seen for {blind_s:.1f} s; the IMU holds the pose for {self.config.max_blind:g} s, its standard "
                f"deviation is {position_sigma:.2f} m by now"
            )
        if position_sigma > _UNKNOWN_M:
            is_lost = True
            reasons.append("what was seen and measured does not determine the pose")
        if imu_gap_s > self.config.max_imu_gap:
            reasons.append(
                f"the IMU was silent for {imu_gap_s:.2f} s, of {self.config.max_imu_gap:g} s at most: only images tell the motion"
            )
            if position_sigma > _TORN_M and self.contradiction is None:
                self.contradiction = (
                    f"a gap of {imu_gap_s:.2f} s in the IMU, and too little was seen across it: the way meanwhile is known to "
                    f"{position_sigma:.1f} m, and the poses before and after it do not belong together"
                )
        reasons += dict.fromkeys(f"{limit.text}: motion beyond it is not measured" for limit in limits)
        told = among_cameras, *self._contradictions(tracks, fit), apart
        contradictions = [text for text in told if text is not None]
        if not contradictions:
            self._agreed_ns = time_ns
        elif (time_ns - self._agreed_ns) * 1e-9 > _SUSTAINED_S and self.contradiction is None:
            self.contradiction = contradictions[0]
        status: Status = "ok"
        if reasons or contradictions:
            status = "lost" if is_lost else "weak"
        return status, (*reasons, *contradictions)

    def _contradictions(self, tracks: Tracks, fit: Fit) -> list[str]:
        """What does not go together, in the mean over the last ten frames or so."""
        seen, new = fit.agreed + fit.not_agreed, 1.0 - _MEMORY
        if seen >= FEWEST_SEEN:
            self._disagreeing += new * (fit.not_agreed / seen - self._disagreeing)
            self._fit_ratio += new * (fit.reprojection_px / self.config.pixel_sigma - self._fit_ratio)
        self._imu_ratio += new * (fit.imu_ratio - self._imu_ratio)
        sentences = []
        if self._disagreeing > _DISAGREE:
            sentences.append(
                f"{100 * self._disagreeing:.0f} % of the landmarks seen are not where they should be: a moving object fills "
                f"much of the view, or cameras and IMU do not belong together as calibrated ({self._calibrated(tracks)})"
            )
        if self._imu_ratio > _IMU_RATIO:
            sentences.append(
                f"the IMU disagrees with the cameras: what is left between them is {self._imu_ratio:.2f} times what its noise "
                f"explains, where {_IMU_RATIO:g} is the most: check its noise, its clock, and how the cameras are mounted"
                f"{', their baseline too' if tracks.pixels.shape[1] > 1 else ''}"
            )
        if self._fit_ratio > _FIT_RATIO:
            sentences.append(
                f"landmarks fit to {self._fit_ratio * self.config.pixel_sigma:.1f} px, where {self.config.pixel_sigma:g} px are "
                "expected: check the calibration of the cameras"
            )
        if tracks.partners is not None:
            self._partners += new * (tracks.partners.share - self._partners)
        if self._partners < LEAST_SHARE:
            sentences.append(few_are_found(self._partners))
        return sentences

    @staticmethod
    def _calibrated(tracks: Tracks) -> str:
        """What of a calibration may be wrong."""
        several = tracks.pixels.shape[1] > 1
        return f"mountings{', the baseline between cameras' if several else ''}, focal lengths, clocks"

    def _view(self, tracks: Tracks) -> str:
        """What the images themselves say about it."""
        brightness, contrast = float(tracks.brightness[0]), float(tracks.contrast[0])
        if np.isnan(brightness):
            return "; the first camera delivered no image"
        if contrast < FLAT or brightness < _DARK:
            what = "dark or covered" if brightness < 2.0 * _DARK else "without texture"
            return f"; the image is {what}: mean {brightness:.0f}, standard deviation {contrast:.1f} of 255"
        return f" ({len(tracks)} corners were followed)"


def position_sigma(covariance: NDArray[np.float64]) -> float:
    """Standard deviation of the position, all axes together, from a covariance (15, 15) in the order of `VioEstimate` [m]."""
    return float(np.sqrt(max(np.trace(covariance[3:6, 3:6]), 0.0)))
