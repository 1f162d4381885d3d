"""One scan against the map: the most likely motion from the end of the scan before to the end of this one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import strong_covariance
from boxplus.filtering.iterated_update import Information
from boxplus.filtering.pose_covariance.correction import Correction
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.systems.lidar_odometry.motion import DOF, MotionBetween, nav_state

_PARTS = 10  # of a scan; the points of one share the derivative of their motion
_CONVERGED = 1e-3  # rad and m, of velocities over the scan
_LAST_POSE = slice(DOF, DOF + 6)
_LEAST_GAIN = 1e-6
_WEAK_WEIGHT = 0.3  # of what points say along weak directions: more than nothing, as a constant velocity drifts


@dataclass(frozen=True, slots=True)
class ScanPoints:
    """The points that a scan is measured with, in order of time.

    Attributes:
        p_lidar: (n, 3) float32, as seen, LiDAR frame [m]; time_ns: (n,) int64, absolute.
        weight: of their information, since neighbours share what is wrong with their surface.
    """

    p_lidar: NDArray[np.float32]
    time_ns: NDArray[np.int64]
    weight: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """The outcome of one scan.

    Attributes:
        motion: from the state at the end of the scan before to the one at the end of this scan; the prior's where not `valid`.
        cov: (24, 24) covariance of both states.
        valid: whether enough points matched.
        last: what the points said at the last iterate.
        measurement: the scan on the map.
        cov_expected: (6, 6) covariance of the last pose that a filter of the pose alone, with the same gain and outcome, would
            have had before the scan; correction: by the scan. Both for `MapDatum`.
        steps: Gauss-Newton steps taken; converged: whether the last one was small.
    """

    motion: MotionBetween
    cov: NDArray[np.float64]
    valid: bool
    last: Information
    measurement: PlaneMeasurement
    cov_expected: NDArray[np.float64]
    correction: Correction | None
    steps: int
    converged: bool


def align(
    prior: MotionBetween,
    cov_prior: NDArray[np.float64],
    points: ScanPoints,
    tree: IkdTree,
    config: RegistrationConfig,
    max_steps: int,
) -> Alignment:
    """The minimum of the points' distances from the map and of the prior's cost, by Gauss-Newton over both states.

    Args:
        prior: as expected; cov_prior: (24, 24) of both states.
        points: of the scan.
        tree: the map.
        config: noise, gates, threads.
        max_steps: most steps.
    """
    seconds = (points.time_ns - prior.first.time_ns) * 1e-9
    edges = np.linspace(min(seconds[0], 0.0), max(prior.seconds, seconds[-1]), _PARTS + 1)
    bounds = [0, *np.searchsorted(seconds, edges[1:-1]).tolist(), len(seconds)]
    middles = 0.5 * (edges[1:] + edges[:-1])
    at_end = np.empty_like(points.p_lidar)
    information = np.linalg.inv(cov_prior)
    motion, steps, converged = prior, 0, False
    measurement: PlaneMeasurement | None = None
    while True:
        x = nav_state(motion.last).pack()
        nodes = motion.nodes(edges)
        deskew_into(points.p_lidar, points.time_ns, prior.first.time_ns, nodes, len(nodes), x, at_end)
        if measurement is None:
            measurement = PlaneMeasurement(at_end, tree, config, with_extrinsic=False, weight=points.weight, confirm=True)
        said, A_parts, b_parts = measurement.in_parts(x, bounds, rematch=steps == 0 or measurement.has_moved(x))
        if said.used < config.min_points:
            expected = cov_prior[_LAST_POSE, _LAST_POSE]
            return Alignment(prior, cov_prior, False, said, measurement, expected, None, steps, False)
        keep = said.directions.weakened(_WEAK_WEIGHT)
        J = motion.jacobians(middles)
        H, gradient = _normal_equations(keep @ J, A_parts, b_parts)
        deviation = information @ np.concatenate([motion.first.minus(prior.first), motion.last.minus(prior.last)])
        if steps == max_steps or (converged and not measurement.has_moved(x)):
            break
        delta = -np.linalg.solve(H + information, gradient + deviation)
        motion = MotionBetween(motion.first.plus(delta[:DOF]), motion.last.plus(delta[DOF:]))
        steps += 1
        scale = np.tile(np.repeat([1.0, motion.seconds], 6), 2)
        converged = bool(np.abs(delta * scale).max() < _CONVERGED)
    strong = said.directions.weakened()
    A, gradient = _normal_equations(strong @ J, A_parts, b_parts)
    cov = np.linalg.inv(A + information)
    gain = cov[_LAST_POSE] @ (A_parts[:, :6, :6] @ strong @ J).sum(axis=0).T @ strong
    noise = cov[_LAST_POSE] @ A @ cov[:, _LAST_POSE]
    # cov = (I - G) expected (I - G)^T + noise; the gain of what is determined well comes close to one.
    rest = np.linalg.inv(np.eye(6) - (1.0 - _LEAST_GAIN) * gain)
    expected = rest @ (cov[_LAST_POSE, _LAST_POSE] - noise) @ rest.T
    # How far the weak directions have moved the estimate: whether they or the prior is right, nobody knows.
    moved = cov @ (gradient + deviation)
    cov = cov + np.outer(moved, moved)
    expected += np.outer(moved[_LAST_POSE], moved[_LAST_POSE])
    alone = strong_covariance(said.A, said.directions)
    scatter = measurement.scatter(x)
    correction = Correction(gain, scatter * noise, scatter * alone, alone, said.directions.lever_arm, measurement.facing)
    return Alignment(motion, cov, True, said, measurement, expected, correction, steps, converged)


def _normal_equations(
    J: NDArray[np.float64], A_parts: NDArray[np.float64], b_parts: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A (24, 24) and b (24,) of both states, from those of the parts' poses and their derivatives (n, 6, 24)."""
    flat = J.reshape(-1, 2 * DOF)
    return flat.T @ (A_parts[:, :6, :6] @ J).reshape(-1, 2 * DOF), flat.T @ b_parts[:, :6].ravel()
