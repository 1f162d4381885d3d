"""Following a pose in the map: the odometry predicts it, and every scan registered to the map corrects it.

The state is T_map_body with the covariance P of its error on the right, and not T_map_world, whose errors of rotation have the
way from the world's origin as their lever. Along a step Z of the odometry T ← T Z and P ← Ad(Z⁻¹) P Ad(Z⁻¹)ᵀ + Q, with Q a random
walk over time and way. A registration gives a pose, and information I that is zero along what its surfaces leave open; with the
innovation ξ = Log(T⁻¹ T_registered), P⁺ = (P⁻¹ + I)⁻¹ and T⁺ = T Exp(P⁺ I ξ). Derivation: docs/localization.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.manifolds import se3
from boxplus.maps.local_maps.registration import Surface, refine
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.localization.place_map import PlaceMap
from boxplus.systems.localization.standing import seen_through, standing
from boxplus.systems.slam.lengths import Lengths, compare_lengths

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

_MOVED = 0.3  # of the reach of the map in memory, after which it is fetched again
_DISTANCE, _STEPS = 0.6, 2  # m of a plane's points, and Gauss-Newton steps
_FEWEST_STANDING = 40
_LOOKED_AT = 8  # points of a scan for each one that is registered
_HALF, _HARDLY = 0.5, 0.1  # of what is asked lies where the map has something
_MAPPED, _ON_MAP = 2.0, 0.3  # m, to the nearest point of the map: it has something there; the point lies on it


@dataclass(frozen=True, slots=True)
class Matched:
    """One scan against the map.

    Attributes:
        share: of the points that stand, and where the map has anything within 2 m, those within 0.3 m of it.
        is_mapped: whether it has anything within 2 m of half of them.
        is_beyond: whether the scan may lie where the map has nothing: it has hardly anything near it, and the scan sees through
            nothing of what stands in the map. Elsewhere than that, what the map has near has to be what is seen.
        innovation: distance of the registration from the prediction, and its limit, in standard deviations; NaN where there was
            none.
        measured: how many directions it determined; 0 where it was not taken.
        lengths: the map's against those of the scan; None where it was not asked for or not taken, or tells nothing of them.
    """

    share: float
    is_mapped: bool
    is_beyond: bool
    innovation: float
    limit: float
    measured: int
    lengths: Lengths | None = None


class Tracker:
    """A pose in the map, from one scan to the next.

    Args:
        T_map_body: (7,) to begin with; covariance: (6, 6) of it, on the right [rad, m].
    """

    def __init__(self, place_map: PlaceMap, T_map_body: Floats, covariance: Floats, config: LocalizationConfig) -> None:
        self._map = place_map
        self._config = config
        self.T_map_body = T_map_body
        self.covariance = covariance
        self._around: Surface | None = None
        self._centre = np.full(3, np.inf)

    @property
    def sigma(self) -> float:
        """Largest standard deviation of the position [m]."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]), 0.0))

    def predict(self, step: Floats, seconds: float) -> None:
        """The odometry moved by `step` (7,), T_before_now, in so many seconds."""
        config, way = self._config, float(np.linalg.norm(step[4:]))
        Ad = se3.adjoint(se3.inverse(step))
        rotation = config.walk_rotation**2 * seconds + config.drift_rotation**2 * way
        position = config.walk_position**2 * seconds + config.drift_position**2 * way
        self.T_map_body = se3.compose(self.T_map_body, step)
        self.covariance = Ad @ self.covariance @ Ad.T + np.diag(np.repeat([rotation, position], 3))

    def correct(self, p_body: Points, R_level_body: Floats, *, with_lengths: bool = False) -> Matched:
        """Register a scan (N, 3) to the map around and take what it says.

        Args:
            R_level_body: (3, 3) to a frame whose z is up, in which what stands is told.
            with_lengths: compare the map's lengths too.
        """
        config = self._config
        points = np.ascontiguousarray(p_body[:: max(len(p_body) // (_LOOKED_AT * config.track_points), 1)])
        points = points[first_per_voxel(points, config.track_voxel)]
        points = np.ascontiguousarray(points[:: max(math.ceil(len(points) / config.track_points), 1)])
        stands = points[standing((points @ R_level_body.T).astype(np.float32))]
        around = self._surroundings()
        if around is None:
            return Matched(0.0, False, True, math.nan, math.nan, 0)
        found = refine(points, around, self.T_map_body, config.registration, distance=_DISTANCE, steps=_STEPS)
        T = self.T_map_body if found is None else found.T_target_source
        asked = stands if len(stands) >= _FEWEST_STANDING else points
        share, mapped = _share(asked, around, T)
        is_mapped = mapped >= _HALF
        is_beyond = mapped < _HARDLY and not self._sees_through(p_body, around)
        if share < config.least_share or not is_mapped:
            return Matched(share, is_mapped, is_beyond, math.nan, math.nan, 0)
        if found is None or len(found.weak) == 6:
            return Matched(share, True, False, math.nan, math.nan, 0)
        xi = se3.log(se3.compose(se3.inverse(self.T_map_body), T))
        innovation, limit = self._innovation(xi, found.covariance, 6 - len(found.weak))
        if innovation > limit:
            return Matched(share, True, False, innovation, limit, 0)
        P = np.linalg.inv(np.linalg.inv(self.covariance) + found.information)
        self.covariance = 0.5 * (P + P.T)
        self.T_map_body = se3.compose(self.T_map_body, se3.exp(self.covariance @ found.information @ xi))
        lengths = compare_lengths(points, around, T, config.registration, distance=_DISTANCE) if with_lengths else None
        return Matched(share, True, False, innovation, limit, 6 - len(found.weak), lengths)

    def _sees_through(self, p_body: Points, around: Surface) -> bool:
        """Whether a scan passes through what stands in the map, in more directions than changes may account for."""
        scan = se3.act(self.T_map_body, p_body.astype(np.float64)).astype(np.float32)
        share = seen_through(scan, around.points[standing(around.points)], self.T_map_body[4:])
        return share > self._config.most_seen_through

    def _innovation(self, xi: Floats, covariance: Floats, measured: int) -> tuple[float, float]:
        S = self.covariance + covariance
        limit = math.sqrt(chi_square_quantile(self._config.innovation, measured))
        return math.sqrt(max(float(xi @ np.linalg.solve(S, xi)), 0.0)), limit

    def _surroundings(self) -> Surface | None:
        """The map around the body; None where there is none."""
        position, reach = self.T_map_body[4:], self._config.track_radius
        if not np.linalg.norm(position - self._centre) < _MOVED * reach:
            points = self._map.points_near(position, (1.0 + _MOVED) * reach)
            self._around = Surface.of(points) if len(points) else None
            self._centre = position.copy()
        return self._around


def _share(points: Points, around: Surface, T_map_body: Floats) -> tuple[float, float]:
    """Share of points that lie on the map, of those that lie where it has something; and of these among all."""
    if not len(points):
        return 0.0, 0.0
    found = around.tree.nearest(se3.act(T_map_body, points.astype(np.float64)), 1, max_distance=_MAPPED)
    is_mapped = found.counts > 0
    on_map = is_mapped & (found.distances[:, 0] <= _ON_MAP)
    return float(np.count_nonzero(on_map)) / max(int(np.count_nonzero(is_mapped)), 1), float(np.mean(is_mapped))
