"""Whether the LiDAR rests against what it sees.

The hypothesis that all velocities are zero, twice: against the path that registration finds, and, where that path creeps or
turns in a way that noisy surfaces only seem to determine, by how well the last scans fit the first ones unmoved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.scan_pattern import recurs
from boxplus.systems.lidar_inertial_agreement.lidar_path.shifted_scans import cost_of, shifts_show, unmoved_map
from boxplus.systems.lidar_inertial_agreement.lidar_path.shown_turns import shown_turns
from boxplus.systems.lidar_inertial_agreement.lidar_path.surfaces import SeenSurfaces

_DETERMINED_M_S = 0.15  # standard deviation of the speed along an axis
_SLOW_M_S, _SLOW_RAD_S = 0.03, 0.01
_NEAR_M = 0.03
_SWING_RAD = 0.06  # a turn to and fro that is none of registrations' noise
_DEVIATIONS = 3.0
_POSE_SIGMA_M = 0.004
_CREEP_M_S, _CREEP_RAD_S = 0.15, 0.25
_AS_WELL = 1.1  # times the cost
_COMPARED, _POINTS = 3, 3000
_MOST_MAP_POINTS = 5000
_LOOKED_AT = 5  # scans, where each one sees something else


@dataclass(frozen=True, slots=True)
class Rest:
    """The hypothesis that all velocities are zero, against a path of the LiDAR alone.

    Attributes:
        at_rest: whether it fits, along and about the axes that the scene determines.
        open_axes: (K, 3) unit axes along which the scene does not show it, in the frame of the path's first pose.
        open_turns: (L, 3) unit axes about which it does not show it, likewise.
        speed: along the determined axes [m/s].
        turn_rate: about the determined axes [rad/s].
    """

    at_rest: bool
    open_axes: NDArray[np.float64]
    open_turns: NDArray[np.float64]
    speed: float
    turn_rate: float

    @property
    def determined(self) -> bool:
        """Whether the scene shows all of it."""
        return not len(self.open_axes) and not len(self.open_turns)


def judge_rest(path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig) -> Rest:
    """Test a path and the scans it was found from; a path of a single pose is undetermined along every axis."""
    last = np.flatnonzero(path.segment == path.segment[-1])
    seconds = (path.time_ns[last] - path.time_ns[last[0]]) * 1e-9
    if len(last) < 2:
        return Rest(False, np.eye(3), np.eye(3), 0.0, 0.0)
    p = path.p_path_lidar[last]
    values, vectors = np.linalg.eigh(path.information[last, 3:, 3:])
    capped = np.where(values > 0.0, 1.0 / (1.0 / np.maximum(values, 1e-9) + _POSE_SIGMA_M**2), 0.0)
    weight = np.einsum("nij,nj,nkj->nik", vectors, capped, vectors)
    # p = v t from the first pose, which defines the frame.
    H = np.einsum("n,nij->ij", seconds**2, weight)
    b = np.einsum("n,nij,nj->i", seconds, weight, p)
    information, axes = np.linalg.eigh(H)
    std = 1.0 / np.sqrt(np.maximum(information, 1e-12))
    seen = std < _DETERMINED_M_S
    along = axes[:, seen]
    speeds = (along.T @ b) / information[seen]
    ends = np.abs(along.T @ p[-min(3, len(p) - 1) :].mean(axis=0))
    turned = so3.log(path.R_path_lidar[last[0]].T @ path.R_path_lidar[last])
    shown_turn, not_shown_turn = shown_turns(path)
    rate = float(np.linalg.norm(shown_turn.T @ turned[-1])) / float(seconds[-1])
    near = _NEAR_M + _DEVIATIONS * std[seen] * seconds[-1]
    slow = (np.abs(speeds) < _SLOW_M_S + _DEVIATIONS * std[seen]).all() and (ends < near).all()
    speed = float(np.linalg.norm(speeds))
    creeps = speed < _CREEP_M_S and rate < _CREEP_RAD_S
    # What swings to and fro may end as it began.
    swings = (np.abs(p @ along) > 2.0 * near).any() or np.linalg.norm(turned @ shown_turn, axis=1).max() > _SWING_RAD
    at_rest = bool(not swings and ((slow and rate < _SLOW_RAD_S) or (creeps and _fits_unmoved(path, scans, config))))
    shown = seen.copy()
    if at_rest and seen.any():  # noise may seem to show an axis, and more of it than of one that is shown
        shown[seen] = faces(path, scans, config, axes[:, seen].T)
    open_axes = axes[:, ~shown].T
    if at_rest and len(open_axes) == 1 and len(last) == len(scans) and shifts_show(scans, open_axes[0], config):
        open_axes = open_axes[:0]
    return Rest(at_rest, open_axes, not_shown_turn.T, speed, rate)


def faces(path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig, axes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Along which unit axes (K, 3), in the frame of the path's first pose, surfaces that face them would show a motion: (K,)."""
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    voxel_filter = VoxelFilter(config.map_cell, _MOST_MAP_POINTS)

    def placed(points: NDArray[np.float32], k: int) -> NDArray[np.float64]:
        return np.asarray(points.astype(np.float64) @ path.R_path_lidar[k].T + path.p_path_lidar[k])

    for k, scan in enumerate(scans):
        tree.insert(placed(voxel_filter(scan.p_lidar)[1], k), downsample=True)
    if not recurs(scans):
        some = np.unique(np.linspace(0, len(scans) - 1, _LOOKED_AT).round().astype(int))
        seen = SeenSurfaces(tree, np.concatenate([placed(voxel_filter(scans[k].p_lidar)[0], k) for k in some]))
        return np.array([seen.face(axis) for axis in axes])
    p_lidar = voxel_filter(scans[-1].p_lidar)[0]
    information = PlaneMeasurement(p_lidar, tree, config, with_extrinsic=False).at(path.packed(-1), rematch=True)
    seen, ratio_along = SeenSurfaces(tree, placed(p_lidar, -1)), information.directions.ratio_along
    return np.array([seen.face_for_rings(path.p_path_lidar[-1], axis, ratio_along(axis)) for axis in axes])


def _fits_unmoved(path: LidarPath, scans: Sequence[Scan], config: RegistrationConfig) -> bool:
    """Whether the last scans fit the first ones without any motion as well as with the one that was found."""
    voxel_filter = VoxelFilter(max(config.scan_voxel, config.map_cell), _POINTS)
    tree = unmoved_map(scans[:_COMPARED], voxel_filter, config)
    unmoved, moved = 0.0, 0.0
    for k in range(1, min(_COMPARED, len(scans) - 1) + 1):
        points = voxel_filter(scans[-k].p_lidar)[0]
        for found in (False, True):
            x = path.packed(-k) if found else NavState.identity().pack()
            measurement = PlaneMeasurement(points, tree, config, with_extrinsic=False)
            fit = measurement.at(x, rematch=True)
            # A point that matches nothing counts as far off: a scan that has moved away fits what is left of it.
            cost = cost_of(fit, measurement.on_map_share, config)
            unmoved, moved = (unmoved, moved + cost) if found else (unmoved + cost, moved)
    return unmoved <= _AS_WELL * moved
