"""How a camera turned between images by the gyroscope, beside corners in both: what else they say can be searched for.

With the rotation R_2_1 known, directions x_1 and x_2 of a corner lie in one plane with the translation t,

    tᵀ (x_2 × R_2_1 x_1) = 0.

What puts directions off by an amount q, known up to that amount, is told by the q with which this fits best, every pair of images
having the t that fits its corners best. A camera that does not turn shows nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.recordings.cameras.info import CameraStream
from boxplus.runs.inspection.cameras.rotation import Alignment, Turns
from boxplus.sensors.inertial.imu import ImuSamples

Floats = NDArray[np.float64]

_MARGIN_S = 0.04  # of IMU samples on both sides of two images
_FEWEST_CORNERS = 40
_MOST_CORNERS = 120
_PARTS = 10
_SURE = 5.0  # standard deviations

FEWEST_PAIRS = 30
"""Of images, that tell something."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownTurn:
    """Two images of a camera.

    Attributes:
        pixels1, pixels2: (N, 2) of the same corners.
        row1, row2: (N,) rows from −½ to ½.
        omega1, omega2: (3,) angular velocity at both images, in the camera [rad/s].
        R_2_1: (3, 3) of the middle rows.
    """

    pixels1: Floats
    pixels2: Floats
    row1: Floats
    row2: Floats
    omega1: Floats
    omega2: Floats
    R_2_1: Floats

    def only(self, kept: NDArray[np.bool_]) -> KnownTurn:
        """The same with some of its corners."""
        corners = {name: getattr(self, name)[kept] for name in ("pixels1", "pixels2", "row1", "row2")}
        return replace(self, **corners)

    def misfits(self, x1: Floats, x2: Floats, readout_s: Floats) -> Floats:
        """Mean square distance of directions (N, 3) from the planes of the best translation, for each readout time (V,) [s].

        The normals of the planes are polynomials of the readout time, of the second degree: n_0 + T n_1 + T² n_2.
        """
        y1, by_row1 = x1 @ self.R_2_1.T, (self.row1[:, None] * np.cross(self.omega1, x1)) @ self.R_2_1.T
        by_row2 = self.row2[:, None] * np.cross(self.omega2, x2)
        n = np.stack([np.cross(x2, y1), np.cross(x2, by_row1) + np.cross(by_row2, y1), np.cross(by_row2, by_row1)])
        powers = readout_s[:, None] ** np.arange(3)
        moments = np.einsum("vi,vj,ijab->vab", powers, powers, np.einsum("ina,jnb->ijab", n, n, optimize=True), optimize=True)
        smallest: Floats = np.linalg.eigvalsh(moments)[:, 0]
        return np.maximum(smallest, 0.0) / len(x1) + 1e-12


def known_turns(
    camera: CameraStream, turns: Turns, imu: ImuSamples, aligned: Alignment, deviations: float = 0.0
) -> list[KnownTurn]:
    """Pairs of images with enough corners; none where there are too few pairs.

    Args:
        deviations: standard deviations by which the offset is another one, -1 to 1: the pairs are the same.
    """
    if camera.model is None:
        return []
    imu = imu.in_order()
    time_s = (imu.time_ns - imu.time_ns[0]) * 1e-9
    gyro = (imu.gyro - aligned.bias) @ aligned.R_imu_camera
    between = np.vstack([np.zeros((1, 3)), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(time_s)[:, None], axis=0)])
    pairs, margin_s, shift_s = [], _MARGIN_S + aligned.offset_std_s, deviations * aligned.offset_std_s
    for begin_ns, end_ns, before, after in zip(turns.begin_ns, turns.end_ns, turns.before, turns.after, strict=True):
        begin, end = ((t - imu.time_ns[0]) * 1e-9 + aligned.offset_s for t in (begin_ns, end_ns))
        if len(before) < _FEWEST_CORNERS or begin - margin_s < time_s[0] or end + margin_s > time_s[-1]:
            continue
        begin, end = begin + shift_s, end + shift_s
        step = max(1, len(before) // _MOST_CORNERS)
        pairs.append(
            KnownTurn(
                before[::step],
                after[::step],
                before[::step, 1] / (camera.height - 1) - 0.5,
                after[::step, 1] / (camera.height - 1) - 0.5,
                _rate(time_s, between, begin),
                _rate(time_s, between, end),
                _rotation(time_s, gyro, begin, end).T,
            )
        )
    return pairs if len(pairs) >= FEWEST_PAIRS else []


def _rate(time_s: Floats, between: Floats, at: float) -> Floats:
    """Mean angular velocity in the 20 ms around an instant."""
    half = 0.01
    turned = [np.array([np.interp(at + side, time_s, between[:, k]) for k in range(3)]) for side in (-half, half)]
    rate: Floats = (turned[1] - turned[0]) / (2.0 * half)
    return rate


def _rotation(time_s: Floats, rate: Floats, begin: float, end: float) -> Floats:
    """R_begin_end of the integrated angular velocity."""
    first, last = np.searchsorted(time_s, (begin, end))
    times = np.concatenate([[begin], time_s[first:last], [end]])
    rates = np.stack([np.interp(times, time_s, rate[:, k]) for k in range(3)], axis=1)
    turned = Rotation.identity()
    for step in 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]:
        turned = turned * Rotation.from_rotvec(step)
    R: Floats = turned.as_matrix()
    return R


def best_of(values: Floats, costs: Floats, independent: float = 1.0) -> tuple[float, float] | None:
    """The value that fits all pairs best, and its standard deviation; None where it lies at an end of those looked at.

    Args:
        values: (V,) evenly spaced; costs: (V, P) misfits of every pair.
        independent: how many of the corners of a pair err each by itself.
    """
    costs = weighed(costs)
    total = costs.sum(axis=1)
    best, step = int(np.argmin(total)), float(values[1] - values[0])
    if not 0 < best < len(values) - 1:
        return None
    curvature = total[best - 1] - 2.0 * total[best] + total[best + 1]
    if not curvature > 0.0:
        return None
    # How far the optimum moves when a part of the pairs is left out says how well it is known, whatever their errors are.
    parts = [optimum(values, costs[:, k::_PARTS].sum(axis=1)) for k in range(_PARTS)]
    std = float(1.4826 * np.median(np.abs(np.array(parts) - np.median(parts)))) / np.sqrt(_PARTS)
    return optimum(values, total), max(std, float(np.sqrt(2.0 / (independent * curvature))) * step)


def end_behind(values: Floats, costs: Floats) -> float | None:
    """The end of the values, 0 among them, behind which lies what fits all pairs best; None where that is not sure.

    Every part of the pairs has to say so by itself, and all of them far more than noise explains that 0 does not fit.
    """
    costs = weighed(costs)
    total = costs.sum(axis=1)
    end = float(values[np.argmin(total)])
    if end not in (values[0], values[-1]) or total[np.argmin(np.abs(values))] - total.min() < _SURE**2:
        return None
    parts = [values[np.argmin(costs[:, k::_PARTS].sum(axis=1))] / end for k in range(_PARTS)]
    return end if min(parts) > 0.5 else None


def weighed(costs: Floats) -> Floats:
    """Costs (V, P) by what is left of each pair at its best, so that none with a wrong corner outvotes the others."""
    least = costs.min(axis=0)
    weighed: Floats = costs / np.maximum(least, np.median(least))
    return weighed


def optimum(values: Floats, total: Floats) -> float:
    best, step = int(np.clip(np.argmin(total), 1, len(values) - 2)), float(values[1] - values[0])
    curvature = total[best - 1] - 2.0 * total[best] + total[best + 1]
    return float(values[best] + 0.5 * step * (total[best - 1] - total[best + 1]) / max(curvature, 1e-30))
