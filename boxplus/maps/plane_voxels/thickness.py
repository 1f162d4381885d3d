"""How sharp a map is: the thickness of its planes, and their entropy.

Of the same points on the same planes, placed in two ways, λ₁ ≤ λ₂ ≤ λ₃ are the variances along the principal axes of the points
of each plane. The thickness is the root of the mean λ₁ over points, the entropy that of normal distributions, ½ ln |2πe Σ|, its
mean over points. As the points are the same, so is their noise: a difference far below the noise of one point shows.

Source: Razlaw, Droeschel, Holz and Behnke, Evaluation of registration methods for sparse 3D laser scans, ECMR 2015 (mean map
entropy, mean plane variance).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_FEWEST_POINTS = 12.0
_FLOOR = 1e-8  # m², of a variance in an entropy


@dataclass(frozen=True, slots=True)
class Sharpness:
    """How sharp a map is.

    Attributes:
        thickness: root mean square distance of points from their planes, weighted [m]; NaN without any.
        entropy: of the points about the middle of their plane [nats].
        points, planes: how many that rests on.
    """

    thickness: float
    entropy: float
    points: int
    planes: int


def sharpness(clusters: NDArray[np.float64], variance: NDArray[np.float64] | float = 1.0) -> Sharpness:
    """The sharpness of points given by Σ [x; 1][x; 1]ᵀ (P, 4, 4) on each plane, x from near its middle [m].

    Args:
        variance: (P,) that a point on each plane is worth the inverse of: smooth planes say more than rough ones.
    """
    enough = clusters[:, 3, 3] >= _FEWEST_POINTS
    kept, worth = clusters[enough], 1.0 / np.broadcast_to(variance, len(clusters))[enough]
    count = kept[:, 3, 3]
    if not len(kept):
        return Sharpness(float("nan"), float("nan"), 0, 0)
    mean = kept[:, :3, 3] / count[:, None]
    covariance = kept[:, :3, :3] / count[:, None, None] - mean[:, :, None] * mean[:, None, :]
    values = np.linalg.eigvalsh(covariance)
    entropy = 0.5 * np.log(2.0 * np.pi * np.e * np.maximum(values, _FLOOR)).sum(axis=1)
    total = count.sum()
    return Sharpness(
        thickness=float(np.sqrt(np.maximum((worth * count * values[:, 0]).sum() / (worth * count).sum(), 0.0))),
        entropy=float((count * entropy).sum() / total),
        points=int(total),
        planes=len(kept),
    )
