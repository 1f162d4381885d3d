"""Which loop closures agree with each other about how one part of a graph lies to another.

A loop closure Z between a pose a of one part and a pose b of the other puts the second part at X = T_a Z T_b⁻¹ in the frame of
the first. One is believed in turn, and the others are held against it: what is left of them, X T_b against T_a Z, is compared
with their noise, that of the one believed at the lever arm between the two, and the drift of the odometry between their poses.
That is pairwise consistency (Mangelson et al., ICRA 2018) with single numbers in the place of covariances, which a part that is
not placed yet does not have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import se2, se3
from boxplus.systems.pose_graph.problem import edge_parts

_KEEP = 0.999  # of pairs of true loop closures that agree
_TRIED = 300  # loop closures that are believed in turn at most, spread evenly


@dataclass(frozen=True, slots=True)
class Crossings:
    """Loop closures from one part of a graph to another.

    Attributes:
        a, b: (k,) poses in the first and in the second part.
        T_a, T_b: (k, 7) or (k, 3) these poses, each in the frame of its part.
        Z: likewise, the measured pose of b in a.
        variance: (k, 2) of rotation [rad²] and translation [m²], averaged over the axes.
        rank: (n,) place of every pose of the graph along the odometry.
        drift: (2,) what a step of odometry adds to these variances.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    T_a: NDArray[np.float64]
    T_b: NDArray[np.float64]
    Z: NDArray[np.float64]
    variance: NDArray[np.float64]
    rank: NDArray[np.int64]
    drift: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        graph: PoseGraph,
        poses: NDArray[np.float64],
        edges: NDArray[np.int64],
        is_reversed: NDArray[np.bool_],
        rank: NDArray[np.int64],
        odometry: NDArray[np.bool_],
    ) -> Crossings:
        """Of `edges` (k,) of a graph, some of them from the second part to the first, and its odometry (m,) bool."""
        group = se3 if graph.dimension == 3 else se2
        i, j = graph.edges[edges].T
        Z = graph.measurements[edges].copy()
        Z[is_reversed] = group.inverse(Z[is_reversed])
        a, b = np.where(is_reversed, j, i), np.where(is_reversed, i, j)
        variance = _variances(graph.information)
        drift = np.median(variance[odometry], axis=0) if odometry.any() else np.zeros(2)
        return cls(a, b, poses[a], poses[b], Z, variance[edges], rank, drift)

    def __len__(self) -> int:
        return len(self.a)

    @property
    def tried(self) -> NDArray[np.int64]:
        """Those that are believed in turn: all, or as many spread evenly."""
        return np.unique(np.linspace(0, len(self) - 1, min(len(self), _TRIED)).round().astype(np.int64))

    def agreeing(self, one: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(k,) which agree with one of them, and which of these would not were the second part left where it is."""
        group = se3 if self.T_a.shape[1] == 7 else se2
        claimed = group.compose(self.T_a, self.Z)
        X = group.compose(claimed[one : one + 1], group.inverse(self.T_b[one : one + 1]))
        apart = np.maximum(*(np.linalg.norm(p - p[one], axis=1) for p in (_positions(self.T_a), _positions(self.T_b))))
        steps = sum(np.abs(self.rank[x] - self.rank[x[one]]) for x in (self.a, self.b))
        rotation = self.variance[:, 0] + self.variance[one, 0] + steps * self.drift[0]
        lever = apart**2 * (self.variance[:, 0] + self.variance[one, 0] + steps * self.drift[0] / 3.0)
        translation = self.variance[:, 1] + self.variance[one, 1] + steps * self.drift[1] + lever
        back = group.inverse(claimed)
        moved = _off(group.compose(back, group.compose(X.repeat(len(self), 0), self.T_b)))
        still = _off(group.compose(back, self.T_b))
        scale = np.stack([rotation, translation], axis=1) * _limits(self.T_a.shape[1] == 7)
        agree = np.asarray((moved**2 <= scale).all(axis=1))
        # Against three times the tolerance, so that what agrees with anything is no witness.
        return agree, agree & np.asarray((still**2 > 9.0 * scale).any(axis=1))


def _variances(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, 2) variances of rotation and translation, the inverse of the mean information over the axes."""
    diagonal = np.einsum("nii->ni", information)
    precision = np.stack([diagonal[:, part].mean(axis=1) for part in edge_parts(information.shape[1])], axis=1)
    return np.asarray(1.0 / np.maximum(precision, 1e-12 * max(float(precision.max(initial=0.0)), 1e-300)))


def _limits(is_spatial: bool) -> NDArray[np.float64]:
    """Squares of the rotation's and the translation's length that true pairs exceed once in a thousand, for unit variances."""
    return np.array([chi_square_quantile(_KEEP, dof) for dof in ((3, 3) if is_spatial else (1, 2))])


def _positions(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return T[:, 4:] if T.shape[1] == 7 else T[:, 1:]


def _off(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(k, 2) angle [rad] and distance [m] of poses from the identity."""
    if T.shape[1] == 7:
        angle = 2.0 * np.arctan2(np.linalg.norm(T[:, 1:4], axis=1), np.abs(T[:, 0]))
    else:
        angle = np.abs((T[:, 0] + math.pi) % (2.0 * math.pi) - math.pi)
    return np.stack([angle, np.linalg.norm(_positions(T), axis=1)], axis=1)
