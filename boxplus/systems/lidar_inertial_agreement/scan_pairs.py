"""Which scans of a path are compared with a gyroscope: neighbours, or scans that are farther apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath

_LONGEST_GAP_NS = 200_000_000
_SEEN_RAD = 0.01  # of a registration, about its least known axis
_LONG_S, _SEEN_LONG_RAD = 0.4, 0.05  # where most registrations know less: intervals over which that is as good a rate
_MOST = 0.5


@dataclass(frozen=True, slots=True)
class ScanPairs:
    """Poses `first` and `last` (K,) of a path between which rotations are compared.

    Attributes:
        overlap: how many of the intervals lie over each other, on average.
        covered: share of the path that they span.
        jitter: what of the rates between them changes from scan to scan without a trend [rad/s].
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    overlap: float
    covered: float
    jitter: float


def scan_pairs(path: LidarPath, imu: ImuSamples, attitude: GyroAttitude) -> ScanPairs:
    """Neighbouring scans; where most of them do not know their attitudes well enough, scans that are farther apart."""
    known = np.linalg.eigvalsh(path.information[:, :3, :3])[:, 0]
    # A first pose defines the frame of its segment; of every other one all three rotations must have been seen.
    begins = np.append(True, path.segment[1:] != path.segment[:-1])
    seen = (known > 1.0 / _SEEN_RAD**2) | begins
    first = np.arange(max(len(path) - 1, 0))
    near = _covered(path, imu, attitude, first[seen[1:]], 1, 1)
    if near.covered > _MOST or len(path) < 3:
        return near
    count = max(round(_LONG_S / (float(np.median(np.diff(path.time_ns))) * 1e-9)), 2)
    seen = (known > 1.0 / _SEEN_LONG_RAD**2) | begins
    stride = count // 2
    first = np.arange(0, max(len(path) - count, 0), stride)
    far = _covered(path, imu, attitude, first[seen[first] & seen[first + count]], count, stride)
    return far if far.covered > _MOST else near


def _covered(
    path: LidarPath, imu: ImuSamples, attitude: GyroAttitude, first: NDArray[np.intp], count: int, stride: int
) -> ScanPairs:
    """Poses `count` scans apart, within a segment and where the gyroscope covers what is between.

    They begin with `first` (K,), some of every `stride`-th pose.
    """
    first = first[path.segment[first] == path.segment[first + count]]
    begin_ns, end_ns = path.time_ns[first], path.time_ns[first + count]
    inside = attitude.covers(begin_ns, 0.0) & attitude.covers(end_ns, 0.0) & ~_across_gap(imu.time_ns, begin_ns, end_ns)
    first = first[inside]
    neighbours = first if count == 1 else np.flatnonzero(path.segment[1:] == path.segment[:-1])
    spanned = np.zeros(max(len(path) - 1, 1), dtype=bool)
    spanned[first[:, None] + np.arange(count)] = True
    return ScanPairs(first, first + count, count / stride, float(spanned.mean()), _jitter(path, neighbours) / count)


def _jitter(path: LidarPath, first: NDArray[np.intp]) -> float:
    """What of the turn rates from each of some scans to the next changes without a trend [rad/s]."""
    step_s = (path.time_ns[first + 1] - path.time_ns[first])[:, None] * 1e-9
    rate = so3.log(np.swapaxes(path.R_path_lidar[first], 1, 2) @ path.R_path_lidar[first + 1]) / step_s
    second = np.diff(rate, n=2, axis=0) / np.sqrt(6.0)
    return float(np.sqrt(np.median((second**2).sum(axis=1)))) if len(second) else 0.0


def _across_gap(time_ns: NDArray[np.int64], begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of the intervals [begin, end] (K,) lie, in part, between samples that are too far apart to be integrated over."""
    gap = np.flatnonzero(np.diff(time_ns) > _LONGEST_GAP_NS)
    across: NDArray[np.bool_] = np.zeros(len(begin_ns), dtype=np.bool_)
    for left, right in zip(time_ns[gap], time_ns[gap + 1], strict=True):
        across |= (begin_ns < right) & (end_ns > left)
    return across
