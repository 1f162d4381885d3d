"""Rotations that noise leaves open: along many edges it adds up to turns of which no linear covariance tells the truth.

Where a rotation is known to a fraction of a radian only, what hangs on it lies along a bow and not in an ellipse, and other
minima, in which a loop is wound otherwise, may fit as well as this one.
"""

from __future__ import annotations

import math

import numpy as np

from boxplus.errors import SingularProblemError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.pose_graph.doubts.fit import Fit
from boxplus.systems.pose_graph.doubts.reliability import Reliability
from boxplus.systems.pose_graph.problem import edge_parts

_WIDE = 0.5  # [rad] standard deviation of a rotation, from which on local minima are looked for
_OPEN = 1.0  # [rad] the same, from which on it is told


def are_wide(solution: Solution, poses: Variables, fit: Fit) -> bool:
    """Whether the noise leaves rotations so open that a minimum that fits may be a local one.

    Args:
        poses: the variables. fit: information that is too small by what it says leaves nothing open.
    """
    try:
        P = solution.covariance(poses, is_determined=True)
    except SingularProblemError:
        return False
    turn = edge_parts(P.shape[1])[0]
    return math.sqrt(max(float(np.einsum("nii->ni", P)[:, turn].max()), 0.0)) * _size(fit) > _WIDE


def wide_notes(graph: PoseGraph, known: Reliability, fit: Fit) -> list[str]:
    """A sentence on the rotation that is known worst, where that is hardly."""
    deviations = known.deviations[:, edge_parts(known.deviations.shape[1])[0]].max(axis=1) * _size(fit)
    worst = int(np.argmax(deviations))
    if not deviations[worst] > _OPEN:
        return []
    many = np.count_nonzero(deviations > _OPEN)
    return [
        f"noise adds up along the edges until the rotation of pose {graph.ids[worst]} is known to {deviations[worst]:.2g} rad "
        f"only, and those of {many} poses to {_OPEN:.2g} rad and more: their positions may be far from the truth, farther than "
        "standard deviations say, which hold for small turns, and loops that are wound otherwise may fit as well"
    ]


def _size(fit: Fit) -> float:
    """Of the noise, where it is less than information promises."""
    return math.sqrt(min(fit.chi2 / fit.dof, 1.0)) if fit.is_slack else 1.0
