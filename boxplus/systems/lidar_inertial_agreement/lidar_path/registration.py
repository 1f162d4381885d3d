"""One registration: a scan against a map of those before it, point to plane."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections, strong_step
from boxplus.filtering.nav_state import TANGENT, NavState, boxplus_into
from boxplus.filtering.propagation import N_P, N_R, N_TIME, N_V, N_W, NODE
from boxplus.manifolds import so3
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan

GOOD_MISFIT_M = 0.06  # of a registration that needs no second start
FEWEST_USED = 60  # points on planes, or a scan is not registered
_STEPS = 12
SETTLED = 2e-4  # rad and m of the last step
_SIGMA_FLOOR = np.repeat([3e-4, 3e-3], 3)  # rad, m: surfaces are no planes, and neighbouring points share their errors

_ENOUGH = 2.5 * FEWEST_USED  # points of a thinned scan: not all of them lie on planes
_LEAST_CELL = 4.0  # range_sigma: of points closer together noise makes planes
_ASKED = 6  # scans of a stretch
_NODES = 21  # within a scan, of a known turning
_HELD_M = 0.09  # standard deviation of a position along the way, where what changes between scans shows it
_STIFF = 1e6  # times the information, along what is held
_LEAST_GAIN = 2.0  # surfaces fill cells of half the size with four times as many points, unless these are few


Turning = Callable[[NDArray[np.int64]], NDArray[np.float64]]
"""Attitudes (N, 3, 3) R_any_lidar of the LiDAR at times (N,) ns."""


def with_cells_for(scan: Scan, config: RegistrationConfig) -> RegistrationConfig:
    """The settings with cells that leave enough of a scan, where everything is near.

    A wall at arm's length fills a cone of view with sixty cells of 25 cm, which no registration can stand on.
    """
    cell, points = config.map_cell, len(VoxelFilter(config.map_cell)(scan.p_lidar)[0])
    while points < _ENOUGH and 0.5 * cell >= _LEAST_CELL * config.range_sigma:
        finer = len(VoxelFilter(0.5 * cell)(scan.p_lidar)[0])
        if finer < _LEAST_GAIN * points:
            break
        cell, points = 0.5 * cell, finer
    if cell == config.map_cell:
        return config
    return config.model_copy(update={"map_cell": cell, "scan_voxel": min(config.scan_voxel, cell)})


def with_cells_for_all(scans: Sequence[Scan], config: RegistrationConfig) -> RegistrationConfig:
    """The same for a stretch of scans: what the nearest of some of them asks for."""
    some = {round(k) for k in np.linspace(0, len(scans) - 1, _ASKED)} if scans else set()
    return min((with_cells_for(scans[k], config) for k in some), key=lambda found: found.map_cell, default=config)


def align(
    x: NDArray[np.float64],
    measurement: PlaneMeasurement,
    config: RegistrationConfig,
    *,
    steps: int = _STEPS,
    held: NDArray[np.float64] | None = None,
    settled: float = SETTLED,
) -> PoseDirections | None:
    """Gauss-Newton on the pose alone, without the weak directions; x (36,) is replaced. None when too few points match.

    Along a unit axis `held` (3,), frame of the map, the position stays where it is. The last step is below `settled` [rad and m].
    """
    delta = np.zeros(TANGENT)
    directions: PoseDirections | None = None
    for step in range(steps):
        information = measurement.at(x, rematch=step == 0 or measurement.has_moved(x))
        if information.used < config.min_points:
            return None
        directions = information.directions
        A = information.A
        if held is not None:
            A = A.copy()
            A[3:6, 3:6] += _STIFF * float(np.trace(A[3:6, 3:6])) * np.outer(held, held)
        delta[:6] = strong_step(A, information.b, directions)
        boxplus_into(x, delta, x)
        if np.abs(delta).max() < settled:
            break
    return directions


def honest_information(A: NDArray[np.float64], directions: PoseDirections, misfit: float) -> NDArray[np.float64]:
    """The information (6, 6) of a registration, nothing along weak directions, and nowhere more than floor and misfit allow."""
    scale = np.array([1.0 / directions.lever_arm] * 3 + [1.0] * 3)
    # Orthonormal, in units of the lever arm, and across all that is weak.
    strong = np.linalg.qr(directions.vectors[:, directions.weak], mode="complete")[0][:, directions.weak.sum() :]
    covariance = np.linalg.inv(strong.T @ (A * np.outer(scale, scale)) @ strong)
    # The floor is a variance of its own, added in the coordinates of the strong directions.
    floor = strong.T @ np.diag((max(misfit / GOOD_MISFIT_M, 1.0) * _SIGMA_FLOOR / scale) ** 2) @ strong
    reduced = np.linalg.inv(covariance + floor)
    back = strong / scale[:, None]
    honest: NDArray[np.float64] = back @ reduced @ back.T
    return honest


def with_held(information: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information (6, 6) of a registration whose position was held along a unit axis (3,): of the scan nothing along it."""
    across = np.eye(6)
    across[3:, 3:] -= np.outer(axis, axis)
    held: NDArray[np.float64] = across @ information @ across
    held[3:, 3:] += np.outer(axis, axis) / _HELD_M**2
    return held


def middle_of(scan: Scan) -> int:
    """When a path has its pose of a scan [ns]."""
    return (scan.start_ns + scan.end_ns) // 2


def thinned(scan: Scan, most: int) -> Scan:
    """Every n-th point, so that at most `most` stay."""
    stride = -(-len(scan) // most)
    if stride <= 1:
        return scan
    lidar = None if scan.lidar is None else scan.lidar[::stride].copy()
    return Scan(scan.p_lidar[::stride].copy(), scan.time_ns[::stride].copy(), None, scan.start_ns, scan.end_ns, lidar=lidar)


def nodes_within(
    scan: Scan, at_ns: int, rate: NDArray[np.float64], velocity: NDArray[np.float64], turning: Turning | None
) -> NDArray[np.float64]:
    """Nodes (n, NODE) of the motion within a scan, relative to the LiDAR at `at_ns`, to undistort it with.

    Args:
        rate, velocity: (3,) in the LiDAR's frame at `at_ns`; the rate is not used where `turning` tells how it turned.
    """
    time_ns = np.linspace(scan.start_ns, scan.end_ns, _NODES, dtype=np.int64) if turning is not None else np.array([at_ns])
    nodes = np.zeros((len(time_ns), NODE))
    seconds = (time_ns - at_ns) * 1e-9
    nodes[:, N_TIME] = seconds
    nodes[:, N_P : N_P + 3] = seconds[:, None] * velocity
    nodes[:, N_V : N_V + 3] = velocity
    if turning is None:
        nodes[:, N_R : N_R + 9] = np.eye(3).ravel()
        nodes[:, N_W : N_W + 3] = rate
        return nodes
    R_any = turning(np.append(time_ns, at_ns))
    nodes[:, N_R : N_R + 9] = (R_any[-1].T @ R_any[:-1]).reshape(-1, 9)
    rates = so3.log(np.swapaxes(R_any[:-2], 1, 2) @ R_any[1:-1]) / np.maximum(np.diff(seconds), 1e-9)[:, None]
    nodes[:-1, N_W : N_W + 3] = rates
    nodes[-1, N_W : N_W + 3] = rates[-1]
    return nodes


def undistorted(scan: Scan, nodes: NDArray[np.float64], at_ns: int) -> NDArray[np.float32]:
    """The points (N, 3) as seen at `at_ns` by a LiDAR that moves through `nodes`."""
    out = np.empty_like(scan.p_lidar)
    deskew_into(scan.p_lidar, scan.time_ns, at_ns, nodes, len(nodes), _AT_REST, out)
    return out


_AT_REST = NavState.identity().pack()
