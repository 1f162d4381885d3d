"""The speed at which a track begins: two scans that were taken at speed fit each other at several.

The first was taken as it came. At 8 m/s it and the next are distorted alike, and fit each other where they are: where rest does
not fit well, both are tried at speed. Which of the speeds is right later scans tell (`lidar_motion`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import GOOD_MISFIT_M
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.scan_fit import ScanFit, ScanFitter, Standing

_FIRST_SPEEDS = 5.0, 10.0  # m/s, both ways along every axis
_SETTLES, _SETTLED_M_S, _SAME_RATE = 4, 0.3, 0.05  # rounds; m/s and rad/s between two motions that are one
_MOST_RIVALS, _RIVAL_COST = 3, 1.3  # and times the least cost


def first_fits(
    fitter: ScanFitter,
    at: Standing,
    first: Scan,
    scan: Scan,
    middle_ns: int,
    step_s: float,
    expected: Twist | None,
    *,
    search: bool,
) -> list[tuple[ScanFit, IkdTree]]:
    """The fits of a second scan, the best one first, each with the map that the first scan makes at its motion.

    Args:
        at: with the map that the first scan makes as it came.
        first, scan: the two.
        middle_ns, step_s, expected: of the second, as for `ScanFitter`.
        search: whether other speeds are tried where rest does not fit well.
    """
    best = fitter.best(at, scan, middle_ns, step_s, expected)
    if best is not None:
        at = replace(at, tree=fitter.map_of(first, best.rate, best.velocity), rate=best.rate, velocity=best.velocity)
        best = fitter.best(at, scan, middle_ns, step_s, expected)
    found = [] if best is None else [(best, at.tree)]
    if expected is not None or not search or (best is not None and best.misfit < GOOD_MISFIT_M):
        return found
    rate = (fitter.turning(middle_ns, step_s) or [at.rate])[0]
    tried: list[NDArray[np.float64]] = []
    for velocity in (speed * axis for speed in _FIRST_SPEEDS for axis in np.vstack([np.eye(3), -np.eye(3)])):
        settled = _settled(fitter, at.x, first, scan, middle_ns, step_s, rate, velocity, tried)
        if settled is not None:
            found.append(settled)
    rivals: list[tuple[ScanFit, IkdTree]] = []
    for fit, tree in sorted(found, key=lambda one: one[0].cost):
        if all(fit.cost < _RIVAL_COST * other.cost and not _same_motion(fit, other) for other, _ in rivals):
            rivals.append((fit, tree))
    return rivals[: 1 + _MOST_RIVALS]


def _settled(
    fitter: ScanFitter,
    x: NDArray[np.float64],
    first: Scan,
    scan: Scan,
    middle_ns: int,
    step_s: float,
    rate: NDArray[np.float64],
    velocity: NDArray[np.float64],
    tried: list[NDArray[np.float64]],
) -> tuple[ScanFit, IkdTree] | None:
    """The fit at one speed, and the map that the first scan makes at the speed that is found; None where it fails.

    Args:
        tried: speeds at which others went on; those of this one are added, and it ends where it comes to one of them.
    """
    found: tuple[ScanFit, IkdTree] | None = None
    for _ in range(_SETTLES):
        if any(np.abs(velocity - other).max() < _SETTLED_M_S for other in tried):
            return None
        tried.append(velocity)
        tree = fitter.map_of(first, rate, velocity)
        fit = fitter.fit(tree, x, scan, middle_ns, step_s, rate, velocity)
        if fit is None:
            return None
        found = fit, tree
        if np.abs(fit.velocity - velocity).max() < _SETTLED_M_S:
            break
        rate, velocity = fit.rate, fit.velocity
    return found


def _same_motion(fit: ScanFit, other: ScanFit) -> bool:
    """Whether two fits of a scan say about the same."""
    faster, turning = fit.velocity - other.velocity, fit.rate - other.rate
    return bool(np.abs(faster).max() < _SETTLED_M_S and np.abs(turning).max() < _SAME_RATE)
