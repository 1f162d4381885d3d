"""Fixes attached to local maps: where in its local map the odometry has the IMU at the instant of a fix."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.held import HELD, Hold, held, longest_hold
from boxplus.systems.slam.graph import MapGraph

Floats = NDArray[np.float64]

_LONGEST_GAP_NS = 1_000_000_000  # between poses of the odometry that still say where the IMU is between them
_HEIGHT_FACTOR = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class AttachedFixes:
    """N fixes that an odometry says where they were made.

    Attributes:
        time_ns: (N,) of the fixes, in the clock of the odometry.
        lat_lon_alt: (N, 3) [°, °, m]; covariance: (N, 3, 3) east, north, up [m²], what was unknown filled in.
        map_of: (N,) number of the local map; T_map_imu: (N, 7) in its frame; v_map: (N, 3) velocity there [m/s].
        drift: (N,) standard deviation of an axis by which the odometry drifted from the local map's pose to the fix [m].
        half_of: (N,) number of the half of a local map, before or after its pose: in one the drift is shared.
        walked: (N,) variance of an axis that the odometry gained by drifting at random since the first local map [m²].
        left_out: fixes that are not among them, by reason.
        hold: the longest stretch in which the receiver repeated a position while the odometry moved; None where there is none.
    """

    time_ns: NDArray[np.int64]
    lat_lon_alt: Floats
    covariance: Floats
    map_of: NDArray[np.intp]
    T_map_imu: Floats
    v_map: Floats
    drift: Floats
    half_of: NDArray[np.intp]
    walked: Floats
    left_out: Counter[str]
    hold: Hold | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def sigma(self) -> Floats:
        """(N,) standard deviation of a horizontal axis [m]."""
        return np.sqrt(0.5 * (self.covariance[:, 0, 0] + self.covariance[:, 1, 1]))

    @property
    def frame(self) -> EnuFrame:
        """East, north and up at the median of the fixes, which a few wrong ones do not move."""
        lla = self.lat_lon_alt.copy()
        lla[:, 1] = lla[0, 1] + (lla[:, 1] - lla[0, 1] + 180.0) % 360.0 - 180.0
        lat, lon, alt = np.median(lla, axis=0).tolist()
        return EnuFrame(lat, (lon + 180.0) % 360.0 - 180.0, alt)


def attach(
    fixes: GnssFixes,
    graph: MapGraph,
    time_ns: NDArray[np.int64],
    T_odo_imu: Floats,
    config: GeoreferenceConfig,
) -> AttachedFixes:
    """Attach fixes to the local maps nearest in time.

    Args:
        fixes: any number. graph: of the local maps, at least one.
        time_ns: (K,) ascending, T_odo_imu: (K, 7) of the odometry.
    """
    left_out = Counter(fixes.rejected)
    t = fixes.time_ns + round(config.time_offset_s * 1e9)
    inside, follows, T_odo, v_odo = poses_between(time_ns, T_odo_imu, t)
    _count(left_out, "outside of the odometry's time", ~inside)
    _count(left_out, "in a gap of the odometry", inside & ~follows)
    known = np.flatnonzero(inside & follows)
    is_held = held(fixes.lat_lon_alt[known], T_odo[known, 4:])
    _count(left_out, HELD, is_held)
    hold = longest_hold(t[known], fixes.lat_lon_alt[known], T_odo[known, 4:], is_held)
    keep = known[~is_held]
    chosen = keep[_one_each(t[keep], config.interval)]
    if len(keep) > len(chosen):
        left_out["one of several within the interval"] = len(keep) - len(chosen)
    t, T_odo, v_odo = t[chosen], T_odo[chosen], v_odo[chosen]
    map_of = np.argmin(np.abs(graph.time_ns[None, :] - t[:, None]), axis=1)
    T_map_odo = se3.inverse(graph.T_odo[map_of])
    v_map = np.einsum("nab,nb->na", quaternion.to_matrix(T_map_odo[:, :4]), v_odo)
    covariance = _filled(fixes.covariance[chosen], config)
    is_after = t > graph.time_ns[map_of]
    drift, walked = _drifts(graph, map_of, is_after, T_odo[:, 4:])
    return AttachedFixes(
        time_ns=t,
        lat_lon_alt=fixes.lat_lon_alt[chosen],
        covariance=covariance,
        map_of=map_of,
        T_map_imu=se3.compose(T_map_odo, T_odo),
        v_map=v_map,
        drift=drift,
        half_of=2 * map_of + is_after,
        walked=walked,
        left_out=left_out,
        hold=hold,
    )


def _drifts(graph: MapGraph, map_of: NDArray[np.intp], is_after: NDArray[np.bool_], p_odo: Floats) -> tuple[Floats, Floats]:
    """`drift` and `walked` of fixes at p_odo (N, 3): of a step from map to map the part that the way has of its way."""
    if len(graph.T_odo) < 2:
        return np.zeros(len(p_odo)), np.zeros(len(p_odo))
    of_step = np.linalg.eigvalsh(graph.covariances[1:, 3:, 3:])[:, -1]
    p_map = graph.T_odo[:, 4:]
    step = np.clip(np.where(is_after, map_of, map_of - 1), 0, len(of_step) - 1)
    way = np.linalg.norm(p_odo - p_map[map_of], axis=1)
    whole = np.linalg.norm(p_map[step + 1] - p_map[step], axis=1)
    of_way = of_step[step] * way / np.maximum(whole, np.maximum(way, 1e-9))
    of_map = np.concatenate([[0.0], np.cumsum(of_step)])[map_of]
    return np.sqrt(of_way), np.asarray(of_map + np.where(is_after, of_way, -of_way))


def poses_between(
    time_ns: NDArray[np.int64], T: Floats, at_ns: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Floats, Floats]:
    """Poses and velocities at other times, between poses (K, 7) at ascending times (K,), at least one.

    Returns:
        (N,) within the times; (N,) between poses no more than a second apart; (N, 7) poses and (N, 3) velocities [m/s] along the
        axes of the world, which mean something where both are true.
    """
    after = np.clip(np.searchsorted(time_ns, at_ns, side="right"), 1, max(len(time_ns) - 1, 1))
    inside = (at_ns >= time_ns[0]) & (at_ns <= time_ns[-1]) & (len(time_ns) > 1)
    after = np.minimum(after, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap = np.maximum((time_ns[after] - time_ns[before]).astype(np.float64), 1.0)
    A, B = T[before], T[after]
    share = np.clip((at_ns - time_ns[before]) / gap, 0.0, 1.0)
    found = se3.compose(A, se3.exp(share[:, None] * se3.log(se3.compose(se3.inverse(A), B))))
    return np.asarray(inside), gap <= _LONGEST_GAP_NS, found, (B[:, 4:] - A[:, 4:]) / (gap[:, None] * 1e-9)


def _one_each(t: NDArray[np.int64], interval: float) -> NDArray[np.intp]:
    """The first of every interval."""
    if not len(t) or interval <= 0.0:
        return np.arange(len(t))
    cell = (t - t[0]) // max(round(interval * 1e9), 1)
    return np.flatnonzero(np.concatenate([[True], np.diff(cell) > 0]))


def _filled(covariance: Floats, config: GeoreferenceConfig) -> Floats:
    """With what the settings say where the receiver says nothing, and nothing better than the settings allow."""
    filled = covariance.copy()
    axes = np.diag([1.0, 1.0, _HEIGHT_FACTOR**2])
    filled[~np.isfinite(filled).all(axis=(1, 2))] = config.sigma**2 * axes
    values, vectors = np.linalg.eigh(filled)
    return np.asarray((vectors * np.maximum(values, config.least_sigma**2)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _count(counts: Counter[str], reason: str, rows: NDArray[np.bool_]) -> None:
    if number := int(np.count_nonzero(rows)):
        counts[reason] = number
