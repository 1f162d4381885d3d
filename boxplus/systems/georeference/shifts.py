"""What a shift of the fixes along a given shape would explain of a fit, without fitting again.

Fixes are measured at z + S d and not at z: S (N, 2, m) is how each of them goes along with m numbers d. About the solution, with
errors e, their information W and the Hessian H of all that is estimated (poses held by odometry and loops, T_enu_map, lever arm,
delay), d is eliminated from the other side:

    A = Sᵀ W S − Bᵀ H⁻¹ B,   B = Jᵀ W S,   d = −A⁻¹ Sᵀ W e,   cov d = A⁻¹,   the cost falls by dᵀ A d,

so that what the odometry may have drifted, by its covariance, is no shift of the fixes. J are the derivatives of
`boxplus/residuals/antenna_position.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables

Floats = NDArray[np.float64]

_DETERMINED = 1e-6  # of what fixes alone say of a shift, to be left when all else is free


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """d (m,) with its covariance (m, m), and by how much it lowers the cost."""

    size: Floats
    covariance: Floats
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """What is needed to ask it.

    Attributes:
        p_enu: (N, 3) where the antenna is by the fit [m]. errors: (N, 3) predicted less measured [m].
        information: (N, 3, 3) as the fixes were believed, zero where they are not used.
        blocks: of the problem, in its order; jacobians: (N, 3, dof) of the errors by each, rows: (N,) which of it.
    """

    p_enu: Floats
    errors: Floats
    information: Floats
    solution: Solution
    blocks: tuple[Variables, ...]
    jacobians: tuple[Floats, ...]
    rows: tuple[NDArray[np.intp], ...]

    def along(self, shape: Floats) -> Shift | None:
        """The shift along a shape (N, 2, m) on the ground; None where nothing tells it.

        Raises:
            SingularProblemError: an unobservable direction of the problem goes along with it.
        """
        S = np.concatenate([shape, np.zeros((len(shape), 1, shape.shape[2]))], axis=1)
        WS = self.information @ S
        alone = np.einsum("nam,nak->mk", S, WS)
        A = alone.copy()
        B = [self._slopes(WS[:, :, k]) for k in range(S.shape[2])]
        for k, slopes in enumerate(B):
            moved = self.solution.response(slopes, is_determined=True)
            A[:, k] -= [sum(float((own * x).sum()) for own, x in zip(other, moved, strict=True)) for other in B]
        A = 0.5 * (A + A.T)
        if np.linalg.eigvalsh(A)[0] <= _DETERMINED * np.linalg.eigvalsh(alone)[-1]:
            return None
        g = -np.einsum("nam,na->m", WS, self.errors)
        covariance = np.linalg.inv(A)
        size = covariance @ g
        return Shift(size, covariance, float(g @ size))

    def _slopes(self, WS: Floats) -> list[Floats]:
        """Jᵀ W S of every block (n, dof), for one column (N, 3) of W S."""
        slopes = []
        for block, jacobian, rows in zip(self.blocks, self.jacobians, self.rows, strict=True):
            slope = np.zeros((len(block), jacobian.shape[2]))
            np.add.at(slope, rows, np.einsum("nab,na->nb", jacobian, WS))
            slopes.append(slope)
        return slopes
