"""The rotation between LiDAR and IMU, their time offset, and the gyroscope's unit, by comparing how both turned.

Over the same interval the IMU turns by φ_imu and the LiDAR by φ_lidar, and φ_imu = R_imu_lidar φ_lidar: a rotation between two
sets of vectors (Wahba, SIAM Review 1965), solved by a singular value decomposition (Kabsch 1976, Umeyama 1991). A constant
gyro bias is removed with the means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.sensors.gyro_attitude import GyroAttitude
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.sensors.scan_registration import LidarRotations, ScanRegistration

_LARGEST_OFFSET_S = 0.25
_OFFSET_STEP_S = 0.01
_FEWEST_INTERVALS = 10
_ROUNDS = 4
_DETERMINED_DEG = 8.0
_WELL_KNOWN_DEG = 0.7
_SCANS_BETWEEN_LOOKS = 15
_FEWEST_SCANS_TO_STOP = 45
_OFFSET_KNOWN_S = 0.01
_REGISTRATION_LAG_S = 0.003
"""What registration against a map of the last scans lags by, measured on recordings with known offset."""
_IDENTITY_WEIGHT = 1e-3


@dataclass(frozen=True, slots=True)
class RotationAlignment:
    """What the comparison of LiDAR and gyroscope shows.

    Attributes:
        R_imu_lidar: (3, 3) float64, LiDAR coordinates to IMU coordinates. Where the motion does not determine it, the
            rotation closest to identity that fits.
        std_deg: (3,) float64, ascending: standard deviations of R_imu_lidar about its three principal axes [deg].
        axes: (3, 3) float64, those axes in the IMU frame, one a column.
        observable_axes: about how many of these axes it is known to 8 degrees (a start for online refinement).
        residual_deg: median difference of the two rotations per interval after alignment [deg].
        excitation_deg_s: (3,) float64, descending: standard deviations of the rotation rate along its principal axes.
        time_offset_s: add this to the LiDAR's times to bring them to the IMU's clock [s].
        time_offset_std_s: its standard deviation; infinite when the motion does not show it.
        gyro_scale: rotation of the gyroscope per rotation of the LiDAR: 1 when both are in rad, 57.3 for a gyro in deg/s.
        gyro_bias: (3,) float64, what the gyroscope shows without rotation [rad/s, or its own unit].
        intervals: number of scan pairs used.
        text: one or two sentences with the above.
    """

    R_imu_lidar: NDArray[np.float64]
    std_deg: NDArray[np.float64]
    axes: NDArray[np.float64]
    observable_axes: int
    residual_deg: float
    excitation_deg_s: NDArray[np.float64]
    time_offset_s: float
    time_offset_std_s: float
    gyro_scale: float
    gyro_bias: NDArray[np.float64]
    intervals: int
    text: str


def estimate_rotation_extrinsic(scans: Sequence[Scan], imu: ImuSamples) -> RotationAlignment:
    """Estimate R_imu_lidar, the time offset and the gyroscope's scale from a stretch with motion.

    Scans are registered until the rotation is known to 0.7 degrees; the rest is not looked at.

    Args:
        scans: consecutive scans, about 10 s with rotation about at least two axes.
        imu: the samples of the same stretch.

    Raises:
        InputError: fewer than ten scan pairs could be registered within the IMU's samples.
    """
    registration = ScanRegistration()
    for number, scan in enumerate(scans, start=1):
        registration.add(scan)
        if number % _SCANS_BETWEEN_LOOKS == 0 and number >= _FEWEST_SCANS_TO_STOP:
            found = align_rotations(registration.rotations(), imu)
            if found.std_deg[-1] < _WELL_KNOWN_DEG:
                return found
    return align_rotations(registration.rotations(), imu)


def align_rotations(lidar: LidarRotations, imu: ImuSamples) -> RotationAlignment:
    """As `estimate_rotation_extrinsic`, with rotations of the LiDAR already known.

    Raises:
        InputError: fewer than ten intervals lie within the IMU's samples.
    """
    finite = np.isfinite(imu.gyro).all(axis=1)
    order = np.argsort(imu.time_ns[finite], kind="stable")
    attitude = GyroAttitude(imu.time_ns[finite][order], imu.gyro[finite][order])
    covered = attitude.covers(lidar.begin_ns, _LARGEST_OFFSET_S) & attitude.covers(lidar.end_ns, _LARGEST_OFFSET_S)
    begin_ns, end_ns, phi_lidar = lidar.begin_ns[covered], lidar.end_ns[covered], lidar.rotation[covered]
    if len(begin_ns) < _FEWEST_INTERVALS:
        raise InputError(
            f"at least {_FEWEST_INTERVALS} scan pairs within the IMU samples, to compare rotations",
            f"{len(begin_ns)} ({lidar.failed} scans could not be registered)",
            "give a longer stretch in a place with walls or other planes",
        )
    step_s = (end_ns - begin_ns)[:, None] * 1e-9
    rate_lidar = phi_lidar / step_s

    # First the unit: a gyroscope in deg/s taken for rad/s turns several times around between two scans.
    plain_rate = (attitude.integral(end_ns) - attitude.integral(begin_ns)) / step_s
    scale = 180.0 / np.pi if 7.6 < _fit(plain_rate, rate_lidar).scale < 430.0 else 1.0
    attitude = attitude.scaled(1.0 / scale)

    offset_s, offset_std_s = _time_offset(attitude, begin_ns, end_ns, rate_lidar)
    used_offset = offset_s if offset_std_s < _OFFSET_KNOWN_S else 0.0
    fit = _fit(_mean_rate(attitude, begin_ns, end_ns, used_offset), rate_lidar)
    residual_deg = float(np.degrees(np.median(np.linalg.norm(fit.residual * step_s, axis=1))))
    std_deg = np.minimum(np.degrees(fit.std), 180.0)
    observable = int((std_deg < _DETERMINED_DEG).sum())
    excitation = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(rate_lidar.T))[::-1], 0.0)))
    text = _describe(fit.scale * scale, residual_deg, std_deg, observable, excitation, offset_s, offset_std_s, len(begin_ns))
    return RotationAlignment(
        R_imu_lidar=fit.R,
        std_deg=std_deg,
        axes=fit.axes,
        observable_axes=observable,
        residual_deg=residual_deg,
        excitation_deg_s=excitation,
        time_offset_s=offset_s,
        time_offset_std_s=offset_std_s,
        gyro_scale=fit.scale * scale,
        gyro_bias=fit.bias * scale,
        intervals=len(begin_ns),
        text=text,
    )


def _mean_rate(
    attitude: GyroAttitude, begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64], offset_s: float
) -> NDArray[np.float64]:
    """(K, 3) rotation of the IMU over the LiDAR's intervals, shifted by the offset, per second."""
    shift = round(offset_s * 1e9)
    turned = np.swapaxes(attitude.at(begin_ns + shift), 1, 2) @ attitude.at(end_ns + shift)
    return so3.log(turned) / ((end_ns - begin_ns)[:, None] * 1e-9)


@dataclass(frozen=True, slots=True)
class _Fit:
    """rate_imu ≈ scale R rate_lidar + bias."""

    R: NDArray[np.float64]
    bias: NDArray[np.float64]
    scale: float
    residual: NDArray[np.float64]
    std: NDArray[np.float64]
    axes: NDArray[np.float64]
    cost: float


def _fit(rate_imu: NDArray[np.float64], rate_lidar: NDArray[np.float64]) -> _Fit:
    """Kabsch with robust weights (Geman-McClure on the scale of the median residual)."""
    weight = np.ones(len(rate_imu))
    for _ in range(_ROUNDS):
        total = weight.sum()
        mean_imu = weight @ rate_imu / total
        mean_lidar = weight @ rate_lidar / total
        a, b = rate_imu - mean_imu, rate_lidar - mean_lidar
        H = (a * weight[:, None]).T @ b / total
        U, _, Vt = np.linalg.svd(H + _IDENTITY_WEIGHT * np.trace((b * weight[:, None]).T @ b) / total * np.eye(3))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        turned = b @ R.T
        power = float((weight[:, None] * b**2).sum())
        scale = float((weight[:, None] * a * turned).sum()) / power if power > 0.0 else 1.0
        # A scale that is no unit is noise: only 57.3 is applied, and that before this function is called for good.
        residual = a - (scale if scale > 7.6 else 1.0) * turned
        norm = np.linalg.norm(residual, axis=1)
        sigma = max(1.4826 * float(np.median(norm)) / 1.5, 1e-6)
        weight = 1.0 / (1.0 + (norm / (4.0 * sigma)) ** 2) ** 2
    information = (
        weight[:, None, None] * (np.einsum("ni,ni->n", a, a)[:, None, None] * np.eye(3) - a[:, :, None] * a[:, None, :])
    ).sum(0)
    variance = float((weight[:, None] * residual**2).sum()) / max(3.0 * weight.sum() - 6.0, 1.0)
    strength, axes = np.linalg.eigh(information)
    std = np.sqrt(variance / np.maximum(strength[::-1], 1e-12))
    cost = float((np.minimum(norm, 6.0 * sigma) ** 2).sum())
    return _Fit(R, mean_imu - R @ mean_lidar, scale, residual, std, axes[:, ::-1], cost)


def _time_offset(
    attitude: GyroAttitude, begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64], rate_lidar: NDArray[np.float64]
) -> tuple[float, float]:
    """Offset with the least misfit, and its standard deviation from the curvature of the misfit."""
    steps = round(_LARGEST_OFFSET_S / _OFFSET_STEP_S) - 1
    offsets = np.arange(-steps, steps + 1) * _OFFSET_STEP_S
    costs = np.array([_fit(_mean_rate(attitude, begin_ns, end_ns, offset), rate_lidar).cost for offset in offsets])
    best = int(np.argmin(costs))
    if not 2 <= best < len(offsets) - 2:
        return float(offsets[best]), np.inf
    near = slice(best - 2, best + 3)
    curvature, slope, _ = np.polyfit(offsets[near] - offsets[best], costs[near], 2)
    if curvature <= 0.0:
        return float(offsets[best]), np.inf
    offset_s = float(offsets[best] - np.clip(0.5 * slope / curvature, -_OFFSET_STEP_S, _OFFSET_STEP_S))
    freedom = max(3 * len(begin_ns) - 7, 1)
    return offset_s, float(np.hypot(np.sqrt(costs[best] / freedom / curvature), _REGISTRATION_LAG_S))


def _describe(
    scale: float,
    residual_deg: float,
    std_deg: NDArray[np.float64],
    observable: int,
    excitation: NDArray[np.float64],
    offset_s: float,
    offset_std_s: float,
    count: int,
) -> str:
    known = {3: "known about all three axes", 2: "known about two axes only", 1: "known about one axis only", 0: "not determined"}
    rates = ", ".join(f"{value:.1f}" for value in excitation)
    offset = (
        f"time offset {offset_s * 1e3:+.1f} ± {offset_std_s * 1e3:.1f} ms"
        if np.isfinite(offset_std_s)
        else "time offset not determined"
    )
    advice = "" if observable == 3 else "; turn about more axes to determine the rest"
    return (
        f"over {count} scan pairs with rotation rates of {rates} deg/s (rms along the principal axes) gyroscope and LiDAR "
        f"differ by {residual_deg:.2f} deg a pair, ratio {scale:.3g}, {offset}; the rotation is {known[observable]} "
        f"(std {std_deg[0]:.2f}, {std_deg[1]:.2f}, {std_deg[2]:.2f} deg){advice}"
    )
