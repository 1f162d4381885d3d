"""Positions by satellite that a run was laid onto the Earth by, as measurements of keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.antenna_position import AntennaPosition
from boxplus.residuals.gravity_direction import GravityDirection
from boxplus.residuals.prior import Prior
from boxplus.systems.georeference.attachment import poses_between
from boxplus.systems.refinement.keyframes import Keyframes
from boxplus.systems.refinement.outside.evidence import Receiver, RunFixes
from boxplus.systems.refinement.state import RefinedState

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FixVariables:
    """What fixes bring into a problem: T_enu_world, lever arm and delay."""

    world: Variables
    arm: Variables
    delay: Variables

    @property
    def blocks(self) -> tuple[Variables, Variables, Variables]:
        """All of it."""
        return self.world, self.arm, self.delay

    def receiver(self, solution: Solution, sigma: Mapping[Variables, Floats]) -> Receiver:
        """What they came to, with standard deviations where these are known."""
        known = all(block in sigma for block in self.blocks)
        deviations = np.concatenate([sigma[block] for block in self.blocks]) if known else np.full(10, np.nan)
        return Receiver(solution[self.world][0], solution[self.arm][0], float(solution[self.delay][0, 0]), deviations)


def add_fixes(
    problem: Problem, poses: Variables, fixes: RunFixes, time_ns: NDArray[np.int64], state: RefinedState, keyframes: Keyframes
) -> FixVariables:
    """Fixes against keyframes, each at the place that the scans give it relative to the nearest one.

    Args:
        poses: of the keyframes. time_ns: (N,) of the scans.
    """
    receiver = fixes.start if state.receiver is None else state.receiver
    world = problem.add_variables(SE3, receiver.T_enu_world, name="T_enu_world")
    arm = problem.add_variables(Euclidean(3), receiver.lever, name="lever_arm")
    delay = problem.add_variables(Euclidean(1), [receiver.delay_s], name="delay")
    inside, follows, T, v_world = poses_between(time_ns, state.T_world_imu, fixes.time_ns)
    rows = np.flatnonzero(inside & follows)
    scan = np.clip(np.searchsorted(time_ns, fixes.time_ns[rows]), 0, len(time_ns) - 1)
    key = keyframes.of_scan[scan]
    T_key = state.T_world_imu[keyframes.scan[key]]
    v_key = np.einsum("nji,nj->ni", quaternion.to_matrix(T_key[:, :4]), v_world[rows])
    residual = AntennaPosition(
        fixes.p_enu[rows], se3.compose(se3.inverse(T_key), T[rows]), v_key, covariance=fixes.covariance[rows]
    )
    every = np.zeros(len(rows), dtype=np.intp)
    problem.add_residuals(residual, world[every], poses[key], arm[every], delay[every], name="fixes", carry_over=True)
    up = -state.gravity_direction[None]
    problem.add_residuals(GravityDirection(up, sigma=fixes.vertical_sigma), world, name="vertical")
    problem.add_residuals(Prior(Euclidean(1), [0.0], sigma=fixes.delay_sigma), delay, name="delay")
    if fixes.lever_sigma is None:
        problem.fix(arm)
    else:
        problem.add_residuals(Prior(Euclidean(3), np.zeros(3), sigma=fixes.lever_sigma), arm, name="lever arm")
    return FixVariables(world, arm, delay)
