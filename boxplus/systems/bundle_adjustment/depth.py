"""Whether the images tell how far the points are: the standard deviation of each along its viewing ray, against its distance.

Between cameras that only turn, or hardly move apart for the distance of the scene, rays are parallel within their noise, and any
depth explains them. With the curvature H of a point's own residuals, (H⁻¹) along the ray is its variance were the cameras exact;
the true one is larger. That is enough to know where nothing is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.examination import Watch
from boxplus.systems.bundle_adjustment.parallax import parallax_ratio
from boxplus.systems.bundle_adjustment.sightings import Sightings, names_text

_SINGULAR = 1e-13  # determinant of H, as a share of the product of its diagonal, that is rounding
_VAGUE = 0.1  # standard deviation over distance that makes it worth asking whether the cameras move apart
TURNING = 3.0  # least of `parallax_ratio` for cameras that do; it is 1 to 2 where they only turn

NOT_APART = "the cameras do not move apart: their rotations are measured, depths and positions are not"


@dataclass(frozen=True, slots=True)
class DepthUncertainty:
    """Standard deviation of every point along the ray from its nearest camera.

    Attributes:
        cameras_move_apart: False where cameras that only turn explain the images as well (`parallax`).
        ratio: (n,) standard deviation over distance, infinite where nothing measures the depth, NaN where no residual
            is of the point.

    Example:
        >>> depth = bp.adjust_bundle(bp.read_reconstruction("scene.txt.bz2")).depth
        >>> bool((depth.ratio < 0.1).all())  # every depth is known to a tenth
        True
    """

    ratio: NDArray[np.float64]
    cameras_move_apart: bool

    @property
    def undetermined(self) -> NDArray[np.int64]:
        """Numbers of the points whose standard deviation exceeds their distance."""
        return np.flatnonzero(self.ratio > 1.0).astype(np.int64)

    def notes(self, reconstruction: Reconstruction) -> list[str]:
        """A sentence, where depths are not determined."""
        said = []
        if not self.cameras_move_apart:
            said.append(
                "the cameras do not move apart: images that only turn explain what was seen as well, so that the points' depth "
                "along their viewing rays and the cameras' positions are not determined"
            )
        numbers = self.undetermined
        if len(numbers):
            seen = int(np.count_nonzero(~np.isnan(self.ratio)))
            names = names_text(numbers, getattr(reconstruction, "point_ids", None))
            said.append(
                f"the depth along the viewing ray is not determined for {len(numbers)} of {seen} points, its standard deviation "
                f"exceeds the distance even were the cameras exact: {names}"
            )
        return said


def depth_uncertainty(
    problem: Problem,
    solution: Solution,
    points: Variables,
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    watch: Watch,
) -> DepthUncertainty:
    """From the residuals at the solution, their losses' weights included.

    Args:
        used: (k,) observations of `adjusted` that were adjusted.
    """
    n = len(points)
    H, times = np.zeros((6, n)), np.zeros(n)
    for group in problem.groups:
        group.linearize(solution.values, 1)
        slot = next((s for s, c in enumerate(group.connections) if c.block is points), None)
        if slot is None:
            continue
        J, of = group.jacobians[slot], group.connections[slot].rows
        times += np.bincount(of, minlength=n)
        J = np.where(group.valid[:, None, None], J, 0.0)
        for k, (a, b) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
            H[k] += np.bincount(of, (J[:, :, a] * J[:, :, b]).sum(axis=1), n)
    sightings = Sightings.of(adjusted)
    ray = sightings.points[sightings.point_of] - sightings.centers[sightings.camera_of]
    length = np.linalg.norm(ray, axis=1)
    order = np.lexsort((length, sightings.point_of))
    first = order[np.diff(sightings.point_of[order], prepend=-1) > 0]
    d, distance = np.zeros((n, 3)), np.full(n, np.nan)
    seen = sightings.point_of[first]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance[seen] = length[first]
        d[seen] = ray[first] / length[first, None]
        xx, xy, xz, yy, yz, zz = H
        # dᵀ adj(H) d / det H, from the entries.
        cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant = xx * cxx + xy * cxy + xz * cxz
        x, y, z = d.T
        along = cxx * x * x + cyy * y * y + czz * z * z + 2.0 * (cxy * x * y + cxz * x * z + cyz * y * z)
        variance = np.where(determinant > _SINGULAR * xx * yy * zz, along / determinant, np.inf)
        ratio = np.sqrt(np.maximum(variance, 0.0)) / distance
    ratio = np.where(np.isnan(distance) | (times == 0), np.nan, ratio)
    known = ratio[~np.isnan(ratio)]
    apart = True
    if len(known) and np.median(known) > _VAGUE:
        apart = parallax_ratio(adjusted, used, config, loss, solution.cost, watch) > TURNING
    return DepthUncertainty(ratio, apart)
