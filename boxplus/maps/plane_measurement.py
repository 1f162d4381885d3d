"""The LiDAR measurement: a scan against the map, point to plane, as information about the state.

Derivation: docs/lidar_inertial_odometry.md, sections 5 to 7.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel, run_chunks
from boxplus.filtering.degeneracy import PoseDirections, pose_directions, threshold_for
from boxplus.filtering.iterated_update import Information
from boxplus.filtering.nav_state import PACKED, TANGENT, boxminus_into
from boxplus.filtering.plane_information import (
    FEW_NEIGHBOURS,
    GATED,
    MEASURED_DOF,
    NOT_A_PLANE,
    ONE_LINE,
    UNCONFIRMED,
    USED,
    accumulate_parts,
    shared_information,
)
from boxplus.filtering.pose_covariance.plane_scatter import plane_scatter
from boxplus.filtering.small_linalg import cholesky_inverse_into
from boxplus.maps.curved_patches import FILLED_CELLS, MEAN_LEVERAGE, ONE_WAY, PATCH, SPARSE_CELLS, bend_planes
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH
from boxplus.maps.plane_confirmation import CONFIRMING, DENSE_CELLS, LEVERAGE, confirm_planes
from boxplus.maps.plane_matching import MANY, NEIGHBOURS, PLANE, match_planes, settle_normals
from boxplus.maps.registration_config import RegistrationConfig

_CHUNK = 1024
_ASKED = 1000  # points of a scan, of what they rest on
_UNTOLD = 1e-3  # of the mean information: directions that have less are hardly told
_SAME_NEIGHBOURS = 0.05  # cells of the map a point may move and keep its neighbours
REASONS = {
    FEW_NEIGHBOURS: "fewer than five map points near",
    NOT_A_PLANE: "neighbours not on a plane",
    GATED: "too far from the plane",
    ONE_LINE: "neighbours along one scan line",
    UNCONFIRMED: "much hangs on it, and its surroundings are no plane",
}


class PlaneMeasurement:
    """One scan against one map; keeps neighbours and planes from iteration to iteration.

    Args:
        p_lidar: (n, 3) float32, motion-compensated points, LiDAR frame; who knows the motion better moves them in place.
        tree: the map, which must not change while the measurement lives.
        config: noise, gates and threads.
        with_extrinsic: whether the extrinsic is measured.
        weight: factor of the information, below 1 where the points are not where they seem.
        confirm: whether planes on which something hangs are held against more of the map: false ones are refused
            (`plane_confirmation`), curved ones bent (`curved_patches`).
        bend_sparse: whether more of them are, where the map is sparser: for a sensor that sees one way (`sees_one_way`), and
            those who have a prediction; registrations that nothing else steadies do without.

    Attributes:
        weight: as given.
        lever_arm: root mean square distance of the points from the LiDAR [m], 0.1 at least.
        facing: (3,) mean of the unit vectors towards the points, LiDAR frame: zero all around, 0.9 long in a cone of 70 degrees.
    """

    def __init__(
        self,
        p_lidar: NDArray[np.float32],
        tree: IkdTree,
        config: RegistrationConfig,
        *,
        with_extrinsic: bool,
        weight: float = 1.0,
        confirm: bool = False,
        bend_sparse: bool = False,
    ) -> None:
        n = len(p_lidar)
        self._p_lidar = p_lidar
        self._tree = tree
        self._cell = tree.cell_size or config.map_cell
        self._config = config
        self._with_extrinsic = with_extrinsic
        self.weight = weight
        self._confirm = confirm
        self._neighbours = np.zeros((n, NEIGHBOURS, 3), dtype=np.float32)
        self._reach = np.zeros((n, 4), dtype=np.float32)
        self._planes = np.zeros((n, PLANE))
        self._fate = np.zeros(n, dtype=np.uint8)
        self._matched = False
        self._matched_at = np.zeros(PACKED)
        self._pull = np.zeros(MEASURED_DOF)
        self._about_pose = np.zeros((6, 6))  # A of the last iterate
        self._directions: PoseDirections
        self.facing: NDArray[np.float64] = np.zeros(3)
        self.lever_arm = max(_spread_into(p_lidar, self.facing) if n else 1.0, 0.1)
        self._bend_sparse = bend_sparse

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        """The information at the packed state x (36,); `rematch` searches the neighbours anew."""
        return self.in_parts(x, (0, self.points), rematch=rematch)[0]

    def in_parts(
        self, x: NDArray[np.float64], bounds: Sequence[int], *, rematch: bool
    ) -> tuple[Information, NDArray[np.float64], NDArray[np.float64]]:
        """The same, with what each of successive parts of the points says: A (m, 12, 12) and b (m, 12).

        Args:
            bounds: (m + 1,) the first point of each part, and the number of points; the first is 0.
        """
        edges = np.array(bounds, dtype=np.int64)
        matches = rematch or not self._matched
        if matches:
            self._match(x)
        if matches and self._confirm:
            A, _, _, _, sums = self._sums(x, edges, criterion=False)
            self._look_closer(x, A.sum(axis=0), int(sums[0]))
        A, b, pull, noise, sums = self._sums(x, edges, criterion=matches)
        self._about_pose = A.sum(axis=0)[:6, :6]
        if matches:  # in between the planes stay, and what they can tell
            self._pull = pull
            threshold = threshold_for(self._config.weak_threshold, int(sums[0]))
            self._directions = pose_directions(self._about_pose, noise, self.lever_arm, threshold)
        used = int(sums[0])
        rms = float(np.sqrt(max(sums[1], 0.0) / used)) if used else 0.0
        A, b = A * self.weight, b * self.weight
        return Information(A.sum(axis=0), b.sum(axis=0), self._pull * self.weight, self._directions, used, rms), A, b

    def scatter(self, x: NDArray[np.float64]) -> float:
        """Of the variance that the information states, what the residuals at x (36,) bear out, 0.05 to 1: `plane_scatter`.

        All of it where a weight says that points are not where they seem: that is an error they share, and no residual shows.
        """
        return 1.0 if self.weight < 1.0 else float(plane_scatter(x, self._p_lidar, self._planes, self._fate, self._about_pose))

    def renewal(self, x: NDArray[np.float64], arrivals: FirstArrivals, share: float) -> NDArray[np.float64]:
        """F (6, 6): of a shift of the map against the pose at x (36,), what this scan sees if only the last one's points shift.

        With the information A of all planes and A' of what rests on these points, F = A⁻¹A'. Rings that wander over a floor stand
        on what the scan before has left there; along other directions, where all is known, a hundredth of the points is new.

        Args:
            arrivals: of the map.
            share: of the map that is new, for directions of which nothing tells.
        """
        asked = slice(None, None, max(self.points // _ASKED, 1))
        rests_on = self._neighbours[asked].reshape(-1, 3) + self._tree.origin
        is_new = arrivals.are_newest(rests_on).reshape(-1, NEIGHBOURS)
        A, newest = shared_information(x, self._p_lidar[asked], self._planes[asked], self._fate[asked], is_new)
        scale = np.repeat([self.lever_arm**2, 1.0], 3)
        little = np.diag(_UNTOLD * max(float(np.mean(A.diagonal() / scale)), 1e-12) * scale)
        return np.asarray(np.linalg.solve(A + little, newest + share * little), dtype=np.float64)

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        """Whether the points have moved far enough since the last search for some to have other neighbours."""
        delta = np.zeros(TANGENT)
        boxminus_into(x, self._matched_at, delta)
        turned, moved, turned_on_it, moved_on_it = (math.hypot(*delta[k : k + 3]) for k in (0, 3, 18, 21))
        return (turned + turned_on_it) * self.lever_arm + moved + moved_on_it > _SAME_NEIGHBOURS * self._cell

    @property
    def points(self) -> int:
        """Points of the scan."""
        return len(self._p_lidar)

    @property
    def on_map_share(self) -> float:
        """Share of the points that lie on the map, those counted that lie among map points of one scan line only."""
        on_map = np.count_nonzero(self._fate == USED) + np.count_nonzero(self._fate >= ONE_LINE)
        return on_map / max(self.points, 1)

    @property
    def fitting_share(self) -> float:
        """Share of the points with a plane that lie on it, by the gate; 1 where no point has one."""
        used, gated = np.count_nonzero(self._fate == USED), np.count_nonzero(self._fate == GATED)
        return used / (used + gated) if used + gated else 1.0

    def rejected(self) -> Mapping[str, int]:
        """Points that were not used, by reason."""
        counts = np.bincount(self._fate, minlength=6)
        return {reason: int(counts[fate]) for fate, reason in REASONS.items() if counts[fate]}

    def _sums(self, x: NDArray[np.float64], bounds: NDArray[np.int64], *, criterion: bool) -> tuple[NDArray[np.float64], ...]:
        """What `accumulate_parts` adds up over planes: A, b, pull, noise and sums."""
        parts = len(bounds) - 1
        A, b, pull = np.zeros((parts, MEASURED_DOF, MEASURED_DOF)), np.zeros((parts, MEASURED_DOF)), np.zeros(MEASURED_DOF)
        noise, sums = np.zeros((6, 6)), np.zeros(2)
        point, stored = self._config.range_sigma**2, self._config.map_sigma**2
        accumulate_parts(
            x, self._p_lidar, self._planes, self._fate, bounds, point, stored, self._with_extrinsic, criterion,
            A, b, pull, noise, sums,
        )  # fmt: skip
        return A, b, pull, noise, sums

    def _look_closer(self, x: NDArray[np.float64], information: NDArray[np.float64], used: int) -> None:
        """Refuse planes on which too much hangs (`plane_confirmation`), bend those that are none (`curved_patches`).

        Args:
            x: (36,) packed state.
            information: (12, 12) of all planes, from so many points `used`.
        """
        config = self._config
        covariance, work = np.empty((2, 6, 6))
        if not cholesky_inverse_into(np.ascontiguousarray(information[:6, :6]), covariance, work):
            return  # nothing at all measures some direction
        mean_leverage = 6.0 / max(used, 1)
        confirm_planes(
            self._tree.view(),
            self._tree.origin,
            x,
            self._p_lidar,
            covariance,
            LEVERAGE * mean_leverage,
            config.max_neighbour_distance**2,
            (DENSE_CELLS * self._cell) ** 2,
            config.plane_threshold,
            self._planes,
            self._fate,
            np.zeros(CONFIRMING, dtype=np.float32),
            np.zeros(STACK_DEPTH + CONFIRMING, dtype=STACK),
        )
        cells = SPARSE_CELLS if self._bend_sparse else FILLED_CELLS
        which, bent = np.empty(self.points, dtype=np.int64), np.empty((self.points, PLANE))
        count = bend_planes(
            self._tree.view(),
            self._tree.origin,
            x,
            self._p_lidar,
            covariance,
            MEAN_LEVERAGE * mean_leverage,
            (cells * self._cell) ** 2,
            self._cell,
            config.map_sigma**2,
            self._planes,
            self._fate,
            which,
            bent,
            np.zeros(PATCH, dtype=np.float32),
            np.zeros(STACK_DEPTH + PATCH, dtype=STACK),
        )
        self._planes[which[:count]] = bent[:count]

    def _match(self, x: NDArray[np.float64]) -> None:
        view, origin, config = self._tree.view(), self._tree.origin, self._config
        warm = self._matched

        def work(_: int, begin: int, end: int) -> None:
            match_planes(
                view,
                origin,
                x,
                self._p_lidar,
                begin,
                end,
                config.max_neighbour_distance**2,
                config.plane_threshold,
                warm,
                self._neighbours,
                self._reach,
                self._planes,
                self._fate,
                np.zeros(NEIGHBOURS, dtype=np.float32),
                np.zeros(STACK_DEPTH + MANY, dtype=STACK),
            )

        run_chunks(work, len(self._p_lidar), _CHUNK, config.threads)
        self._matched = True
        settle_normals(x, self._p_lidar, config.plane_threshold, self._planes, self._fate)
        self._matched_at = x.copy()


def sees_one_way(points: NDArray[np.float32]) -> bool:
    """Whether a scan (n, 3), LiDAR frame, finite, is of a sensor that sees one way: all within a cone of some 130 degrees."""
    facing = np.zeros(3)
    if len(points):
        _spread_into(points, facing)
    return math.hypot(*facing) > ONE_WAY


@kernel
def _spread_into(p_lidar: NDArray[np.float32], facing: NDArray[np.float64]) -> float:
    """Root mean square distance of points (n, 3); `facing` (3,), zero, receives the mean of the unit vectors towards them."""
    total = 0.0
    for n in range(len(p_lidar)):
        x, y, z = np.float64(p_lidar[n, 0]), np.float64(p_lidar[n, 1]), np.float64(p_lidar[n, 2])
        squared = x * x + y * y + z * z
        total += squared
        share = 1.0 / (math.sqrt(max(squared, 1e-12)) * len(p_lidar))
        facing[0] += share * x
        facing[1] += share * y
        facing[2] += share * z
    return math.sqrt(total / len(p_lidar))
