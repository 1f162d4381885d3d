"""Keyframes: scans that stand for those around them, which keep their places relative to them while the keyframes move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.refinement.config import RefinementConfig

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """K keyframes of N scans.

    Attributes:
        scan: (K,) the scan that is the keyframe; the first one is scan 0.
        of_scan: (N,) the keyframe of each scan.
    """

    scan: NDArray[np.int64]
    of_scan: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.scan)


def choose_keyframes(time_ns: NDArray[np.int64], T_world_imu: Floats, config: RefinementConfig) -> Keyframes:
    """Cut the way of N poses (N, 7) into stretches; the keyframe of each is the scan in its middle, of the first the first."""
    begins = [0]
    turn = np.cos(0.5 * np.deg2rad(config.keyframe_rotation_deg))
    for k in range(1, len(time_ns)):
        b = begins[-1]
        is_far = np.linalg.norm(T_world_imu[k, 4:] - T_world_imu[b, 4:]) > config.keyframe_distance
        is_turned = abs(T_world_imu[k, :4] @ T_world_imu[b, :4]) < turn
        if is_far or is_turned or (time_ns[k] - time_ns[b]) * 1e-9 > config.keyframe_seconds:
            begins.append(k)
    ends = np.array([*begins[1:], len(time_ns)])
    scan = (np.array(begins) + ends - 1) // 2
    scan[0] = 0
    return Keyframes(scan, np.repeat(np.arange(len(begins)), ends - np.array(begins)))
