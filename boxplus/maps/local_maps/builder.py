"""Cut the stream of an odometry's scans into local maps, by way and by time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import Floats, LocalMap, checked_covariance, drift_covariance, relative_covariance
from boxplus.maps.local_maps.vertical import find_vertical
from boxplus.maps.tiles.voxel_thinning import first_per_voxel

_UP = np.array([0.0, 0.0, 1.0])
_LEAST_AHEAD = 0.1  # of the body's x axis in the horizontal plane; below it its y axis gives the heading


@dataclass(frozen=True, slots=True)
class _Seen:
    time_ns: int
    T_odo_body: Floats
    covariance: Floats
    up_odo: Floats | None
    path_m: float
    p_body: NDArray[np.float32]


class LocalMapBuilder:
    """Collects scans until a stretch is long enough, and makes a `LocalMap` of it.

    Args:
        config: settings; each has a default.
        looks_anew: where nobody says where up is, ask the surfaces of every map; otherwise the first that shows it tells it for
            all later ones.

    Example:
        >>> import numpy as np
        >>> builder = LocalMapBuilder(LocalMapConfig(length=2.0))
        >>> maps = []
        >>> for k in range(6):
        ...     pose = [1.0, 0.0, 0.0, 0.0, 0.5 * k, 0.0, 0.0]
        ...     maps += builder.push(k * 100_000_000, pose, np.eye(6) * 1e-6, np.ones((1, 3), np.float32))
        >>> [m.scans for m in maps]
        [5]
    """

    def __init__(self, config: LocalMapConfig | None = None, *, looks_anew: bool = False) -> None:
        self._looks_anew = looks_anew
        self.config = as_settings(LocalMapConfig, config)
        self._seen: list[_Seen] = []
        self._last: _Seen | None = None  # the scan that the frame of the last map stands at
        self._T_odo_before: Floats | None = None
        self._carried_up: Floats | None = None  # where nobody said it: what a map showed, before that the first one's guess
        self._is_shown = False
        self._count = 0

    def push(
        self, time_ns: int, T_odo_body: ArrayLike, covariance: ArrayLike, p_body: ArrayLike, up_odo: ArrayLike | None = _UP
    ) -> list[LocalMap]:
        """Take a scan; returns the map that it completes, if it does.

        Args:
            time_ns: absolute [ns], later than the one before.
            T_odo_body: (7,) pose of the body in the odometry's world [qw, qx, qy, qz, x, y, z].
            covariance: (6, 6) of [w, v] [rad, m] on the right of that pose, against the first pose.
            p_body: (N, 3) its points in the body's frame [m]; none where nobody knows where they belong.
            up_odo: (3,) against gravity, in the odometry's world. None where nobody knows: surfaces of the first map that shows
                it tell, within 45° of the z axis of the body there, and the odometry carries it on; maps before stand as the body
                did in the first of them (`LocalMap.is_level`).

        Raises:
            InputError: a time that is not later, arrays of another shape, not finite.
        """
        pose = SE3.check("T_odo_body", np.atleast_2d(as_floats(T_odo_body, "T_odo_body")))[0]
        up = None if up_odo is None else _direction(up_odo)
        points = np.asarray(p_body, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError("p_body of shape (N, 3)", f"shape {points.shape}", "give points in the body's frame [m]")
        newest = self._seen[-1] if self._seen else None
        if newest is not None and time_ns <= newest.time_ns:
            raise InputError("scans in order of time", f"{time_ns} ns after {newest.time_ns} ns", "push each scan once")
        step = 0.0 if newest is None else float(np.linalg.norm(pose[4:] - newest.T_odo_body[4:]))
        path = 0.0 if newest is None else newest.path_m + step
        kept = self._thinned(points)
        own = checked_covariance("covariance", covariance)
        self._seen.append(_Seen(int(time_ns), pose, own, up, path, kept))
        first = self._seen[0]
        way, time_s = path - first.path_m, (time_ns - first.time_ns) * 1e-9
        is_long = way >= self.config.length or (time_s >= self.config.duration and way >= self.config.least_length)
        return [self._cut()] if is_long else []

    def flush(self) -> list[LocalMap]:
        """The map of what is left, however short; nothing where nothing is."""
        return [self._cut()] if len(self._seen) > (1 if self._count else 0) else []

    def _thinned(self, p_body: NDArray[np.float32]) -> NDArray[np.float32]:
        sq = np.einsum("na,na->n", p_body, p_body)
        near = p_body[np.isfinite(sq) & (sq <= self.config.max_range**2)]
        return np.asarray(near[first_per_voxel(near, self.config.voxel)])

    def _cut(self) -> LocalMap:
        """The map of the collected scans; the last of them begins the next one."""
        path = np.array([seen.path_m for seen in self._seen])
        middle = self._seen[int(np.argmin(np.abs(path - 0.5 * (path[0] + path[-1]))))]
        up_odo, is_level = self._up_odo(middle)
        T_odo_map = _level_frame(middle.T_odo_body, up_odo)
        points = np.concatenate([self._in_map(seen, T_odo_map) for seen in self._seen])
        points = points[first_per_voxel(points, self.config.voxel)]
        begin = self._seen[0].time_ns
        made = LocalMap(
            number=self._count,
            time_ns=middle.time_ns,
            begin_ns=begin,
            end_ns=self._seen[-1].time_ns,
            T_odo_map=T_odo_map,
            covariance=self._covariance(middle, T_odo_map),
            path_m=middle.path_m,
            points=np.ascontiguousarray(points),
            scans=len(self._seen),
            is_level=is_level,
        )
        self._count += 1
        self._last, self._T_odo_before = middle, T_odo_map
        newest = self._seen[-1]
        # It stays for the way that the next stretch is measured from; its points are in the map already.
        self._seen = [replace(newest, p_body=newest.p_body[:0])]
        return made

    def _up_odo(self, middle: _Seen) -> tuple[Floats, bool]:
        """(3,) as it was said, or as the collected scans show it, or earlier ones did; and whether it is more than a guess."""
        if middle.up_odo is not None:
            return middle.up_odo, True
        up = self._carried_up
        if up is None or not self._is_shown or self._looks_anew:
            here = middle.T_odo_body  # in whose frame coordinates are small
            R_odo_here = quaternion.to_matrix(here[:4])
            found = find_vertical(np.concatenate([self._in_map(seen, here) for seen in self._seen]), _UP)
            if found is not None:
                up, self._is_shown = R_odo_here @ found, True
            elif up is None:
                up = R_odo_here[:, 2]
            self._carried_up = up
        return up, self._is_shown

    @staticmethod
    def _in_map(seen: _Seen, T_odo_map: Floats) -> NDArray[np.float32]:
        T = se3.compose(se3.inverse(T_odo_map), seen.T_odo_body)
        return np.asarray(seen.p_body @ quaternion.to_matrix(T[:4]).T.astype(np.float32) + T[4:].astype(np.float32))

    def _covariance(self, middle: _Seen, T_odo_map: Floats) -> Floats:
        if self._last is None or self._T_odo_before is None:
            return np.zeros((6, 6))
        before, after = (
            _moved(seen.covariance, se3.compose(se3.inverse(frame), seen.T_odo_body))
            for seen, frame in ((self._last, self._T_odo_before), (middle, T_odo_map))
        )
        own = relative_covariance(before, after, se3.compose(se3.inverse(self._T_odo_before), T_odo_map))
        drift = drift_covariance(middle.path_m - self._last.path_m, self.config.drift_rotation, self.config.drift_position)
        return own + drift


def _direction(up_odo: ArrayLike) -> Floats:
    up = as_floats(up_odo, "up_odo")
    if up.shape != (3,) or not np.isfinite(up).all() or not np.linalg.norm(up) > 0.0:
        raise InputError("up_odo as a direction (3,)", f"{up.tolist()}", "give minus gravity, in the odometry's world")
    return np.asarray(up / np.linalg.norm(up))


def _level_frame(T_odo_body: Floats, z: Floats) -> Floats:
    """(7,) frame at a body's position with z up and x ahead of it."""
    R_odo_body = quaternion.to_matrix(T_odo_body[:4])
    x = R_odo_body[:, 0] - z * (z @ R_odo_body[:, 0])
    if np.linalg.norm(x) < _LEAST_AHEAD:
        y = R_odo_body[:, 1] - z * (z @ R_odo_body[:, 1])
        x = np.cross(y, z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return np.concatenate([quaternion.from_matrix(R), T_odo_body[4:]])


def _moved(covariance: Floats, T_map_body: Floats) -> Floats:
    """A covariance on the right of a body's pose, on the right of that of a frame fixed to it."""
    Ad = se3.adjoint(T_map_body)
    return np.asarray(Ad @ covariance @ Ad.T)
