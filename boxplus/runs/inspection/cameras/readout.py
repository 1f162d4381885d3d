"""Are all rows of an image taken at once? The time from the first to the last row, from corners and the gyroscope.

Row v of a rolling shutter is taken τ(v) = T (v / (H − 1) − ½) after the middle row. Directions y of a corner in two images,
turned by the gyroscope from the instants of their rows to those of the middle rows, lie with the translation t in one plane:
the epipolar constraint of the images' middle rows, with the known rotation R_2_1,

    r = tᵀ (y_2 × R_2_1 y_1) = 0,    y_k = Exp(τ(v_k) ω_k) x_k,

ω_k the angular velocity in the camera at image k. For every T the direction t of each pair of images is the one that fits its
corners best; T is where the sum over all pairs is least. A camera that does not turn shows nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.rotation import Alignment, Turns
from boxplus.sensors.imu import ImuSamples

Floats = NDArray[np.float64]

_SEARCH_S, _STEP_S = 0.04, 0.002
_FEWEST_PAIRS, _FEWEST_CORNERS = 30, 40
_MOST_CORNERS = 120
_SMALL_S = 0.004
_SURE = 5.0
_PARTS = 10


@dataclass(frozen=True, slots=True)
class Readout:
    """Time from the first to the last row [s], negative from below, and its standard deviation."""

    time_s: float
    std_s: float


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Unit vectors (N, 3) of corners in both images, rows from −½ to ½, rates at both images, R_2_1 of the middle rows."""

    x1: Floats
    x2: Floats
    row1: Floats
    row2: Floats
    omega1: Floats
    omega2: Floats
    R_2_1: Floats


def estimate_readout(camera: CameraStream, turns: Turns, imu: ImuSamples, aligned: Alignment) -> Readout | None:
    """The readout time, or None where there are too few corners, or nothing that turns."""
    pairs = _pairs(camera, turns, imu, aligned)
    if len(pairs) < _FEWEST_PAIRS:
        return None
    times = np.arange(-_SEARCH_S, _SEARCH_S + 0.5 * _STEP_S, _STEP_S)
    costs = np.array([[_misfit(pair, time) for pair in pairs] for time in times])
    # Pairs are weighed by what is left of them at their best, so that none with a wrong corner outvotes the others.
    scale = np.maximum(costs.min(axis=0), np.median(costs.min(axis=0)))
    total = (costs / scale).sum(axis=1)
    best = int(np.argmin(total))
    if not 0 < best < len(times) - 1:
        return None
    curvature = total[best - 1] - 2.0 * total[best] + total[best + 1]
    if not curvature > 0.0:
        return None
    time = times[best] + 0.5 * _STEP_S * (total[best - 1] - total[best + 1]) / curvature
    # How far the optimum moves when a part of the pairs is left out says how well it is known, whatever their errors are.
    parts = [_optimum(times, (costs / scale)[:, k::_PARTS].sum(axis=1)) for k in range(_PARTS)]
    std = float(1.4826 * np.median(np.abs(np.array(parts) - np.median(parts)))) / np.sqrt(_PARTS)
    floor = float(np.sqrt(2.0 / curvature)) * _STEP_S
    return Readout(float(time), max(std, floor))


def _optimum(times: Floats, total: Floats) -> float:
    best = int(np.clip(np.argmin(total), 1, len(times) - 2))
    curvature = total[best - 1] - 2.0 * total[best] + total[best + 1]
    return float(times[best] + 0.5 * _STEP_S * (total[best - 1] - total[best + 1]) / max(curvature, 1e-30))


def _pairs(camera: CameraStream, turns: Turns, imu: ImuSamples, aligned: Alignment) -> list[_Pair]:
    if camera.model is None:
        return []
    order = np.concatenate([[True], np.diff(np.maximum.accumulate(imu.time_ns)) > 0])
    time_s = (imu.time_ns[order] - imu.time_ns[0]) * 1e-9
    gyro = (imu.gyro[order] - aligned.bias) @ aligned.R_imu_camera
    between = np.vstack([np.zeros((1, 3)), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(time_s)[:, None], axis=0)])
    pairs = []
    for begin_ns, end_ns, before, after in zip(turns.begin_ns, turns.end_ns, turns.before, turns.after, strict=True):
        begin, end = ((t - imu.time_ns[0]) * 1e-9 + aligned.offset_s for t in (begin_ns, end_ns))
        if len(before) < _FEWEST_CORNERS or begin - _SEARCH_S < time_s[0] or end + _SEARCH_S > time_s[-1]:
            continue
        step = max(1, len(before) // _MOST_CORNERS)
        x1, _ = camera.model.bearings(before[::step])
        x2, _ = camera.model.bearings(after[::step])
        pairs.append(
            _Pair(
                x1,
                x2,
                before[::step, 1] / (camera.height - 1) - 0.5,
                after[::step, 1] / (camera.height - 1) - 0.5,
                _rate(time_s, between, begin),
                _rate(time_s, between, end),
                _rotation(time_s, gyro, begin, end).T,
            )
        )
    return pairs


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


def _misfit(pair: _Pair, readout_s: float) -> float:
    """Mean square distance of the corners from the planes of the best translation, in directions."""
    y1 = pair.x1 + readout_s * pair.row1[:, None] * np.cross(pair.omega1, pair.x1)
    y2 = pair.x2 + readout_s * pair.row2[:, None] * np.cross(pair.omega2, pair.x2)
    normals = np.cross(y2, y1 @ pair.R_2_1.T)
    smallest = float(np.linalg.eigvalsh(normals.T @ normals)[0])
    return max(smallest, 0.0) / len(normals) + 1e-12


def check_readout(camera: CameraStream, turns: Turns, imu: ImuSamples, aligned: Alignment) -> list[Evidence]:
    """A finding about the shutter of this camera."""
    key = f"{camera.name}_shutter"
    found = estimate_readout(camera, turns, imu, aligned)
    if found is None:
        return [Evidence(key, "unchecked", "ok", "the camera turns too little, or too few corners agree: rows are not compared")]
    text = "time from the first to the last row by which corners agree best with the gyroscope, "
    text += f"standard deviation {found.std_s * 1e3:.1f} ms"
    value, stated = f"{found.time_s * 1e3:+.1f} ms", f"; {camera.readout_s * 1e3:+.1f} ms as stated" if camera.readout_s else ""
    text += stated
    if abs(found.time_s - camera.readout_s) > max(_SMALL_S, _SURE * found.std_s):
        text += ": check line_delay" if stated else ": a rolling shutter is suspected; state it as line_delay in the camchain"
        text += ", what takes rows for taken at other times than they were errs by what moves meanwhile"
        return [Evidence(key, value, "warning", text)]
    return [Evidence(key, value, "ok", text)]
