"""Lines in the window: four numbers each, in the world; what the frames saw of them, and what leaves with a keyframe.

They are treated as corners are (`window`): the oldest keyframe that saw a line takes it along, with what all keyframes saw of it,
but for what the newest ones did where the line is still followed; that founds a new one. They never enter a prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import lines as line_manifold
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.lines import Line3D
from boxplus.optimization.losses import Huber
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.residuals.camera.line_reprojection import LineReprojection
from boxplus.residuals.camera.on_body import OnBody
from boxplus.systems.bundle_adjustment.line_triangulation import triangulate_lines
from boxplus.systems.visual_inertial_odometry.lines.tracks import LineTracks
from boxplus.systems.visual_inertial_odometry.rig import Rig

_HUBER = 1.5  # standard deviations
_CAUTION = 2.0  # by which the noise is taken to be larger, where it is decided whether segments determine a line
_LEAST_VIEWS = 2
_VAGUE = 0.3  # standard deviation of the worst of a line's four numbers among known poses, beyond which it is none [rad]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class LineFit:
    """How lines fit the newest frame.

    Attributes:
        agreed, not_agreed: lines that the first camera saw where they should be, and elsewhere.
        given_up: of the lines that are followed, those that turned out to be none.
    """

    agreed: int
    not_agreed: int
    given_up: Ints


NO_LINES = LineFit(0, 0, np.zeros(0, np.int64))
"""Of a frame without lines."""


class LineLandmarks:
    """Lines of a window and their residuals.

    Args:
        problem: gets a block `lines`.
        sigma_px: standard deviation of the ends of a segment across it, in pixels of the first camera.
    """

    def __init__(self, problem: Problem, rig: Rig, sigma_px: float) -> None:
        self.block: Variables = problem.add_variables(Line3D, np.zeros((0, 5)), name="lines")
        self._problem, self._rig, self._sigma = problem, rig, sigma_px
        model = rig.cameras[0].model
        focal = float(np.sqrt(model.fx * model.fy))
        self._K = np.diag([focal, focal, 1.0])  # segments are rays: pixels of a camera without a lens
        self._ids: Ints = np.zeros(0, np.int64)  # of each line in the block, and its number among those followed
        self._track: Ints = np.zeros(0, np.int64)
        self._frame: Ints = np.zeros(0, np.int64)  # of each observation
        self._line: Ints = np.zeros(0, np.int64)
        self._camera: Ints = np.zeros(0, np.int64)
        self._segment = np.zeros((0, 4))
        self._free_from: dict[int, int] = {}  # of a line followed the first frame whose sight of it is in no prior
        self._views: tuple[Group, NDArray[np.intp]] | None = None

    def __len__(self) -> int:
        return len(self.block)

    def add(self, frame: int, tracks: LineTracks | None) -> None:
        """What a frame sees of lines that there are."""
        if tracks is None:
            return
        _, line, row = np.intersect1d(self._track, tracks.ids, assume_unique=True, return_indices=True)
        for camera in range(tracks.segments.shape[1]):
            there = np.isfinite(tracks.segments[row, camera, 0])
            self._observe(np.full(int(there.sum()), frame), self._ids[line[there]], camera, tracks.segments[row[there], camera])

    def found(self, keyframes: Sequence[tuple[int, LineTracks | None]], bodies: Floats, mountings: Floats) -> None:
        """New lines, where what keyframes saw determines them: of what the last one sees and there is none of yet.

        Args:
            keyframes: their numbers and lines, in order of time.
            bodies: (f, 7) their poses; mountings: (c, 7).
        """
        frames = [(number, tracks) for number, tracks in keyframes if tracks is not None]
        if not frames:
            return
        bodies = bodies[[tracks is not None for _, tracks in keyframes]]
        newest = frames[-1][1]
        lone = newest.ids[~np.isin(newest.ids, self._track)]
        cameras = newest.segments.shape[1]
        free_from = np.array([self._free_from.get(int(k), 0) for k in lone], dtype=np.int64)
        parts = []
        for k, (number, tracks) in enumerate(frames):
            _, row, own = np.intersect1d(lone, tracks.ids, assume_unique=True, return_indices=True)
            for camera in range(cameras):
                there = np.isfinite(tracks.segments[own, camera, 0]) & (number >= free_from[row])
                count = int(there.sum())
                parts.append((np.full(count, k), row[there], np.full(count, camera), tracks.segments[own[there], camera]))
        frame, line, camera_of, segment = (np.concatenate([part[k] for part in parts]) for k in range(4))
        if not len(frame):
            return
        poses = se3.inverse(_world_poses(bodies, mountings))
        K = np.broadcast_to(self._K, (len(poses), 3, 3))
        focal, sigma = self._K[0, 0], _CAUTION * self._sigma
        result = triangulate_lines(K, poses, focal * segment, frame * cameras + camera_of, line, len(lone), sigma)
        good = result.found
        if not good.any():
            return
        ids = self._problem.extend(self.block, result.lines[good]).ids
        self._ids, self._track = np.append(self._ids, ids), np.append(self._track, lone[good])
        new_id = np.full(len(lone), -1)
        new_id[good] = ids
        numbers = np.array([number for number, _ in frames])
        for c in range(cameras):
            rows = good[line] & (camera_of == c)
            self._observe(numbers[frame[rows]], new_id[line[rows]], c, segment[rows])

    def _observe(self, frame: Ints, line: Ints, camera: int, segment: Floats) -> None:
        self._frame, self._line = np.append(self._frame, frame), np.append(self._line, line)
        self._camera = np.append(self._camera, np.full(len(frame), camera))
        self._segment = np.concatenate([self._segment, segment])

    def connect(self, bodies: Variables, mountings: Variables, rows: NDArray[np.intp] | None = None) -> None:
        """Residuals of these observations, or of all; of no others."""
        self.disconnect()
        rows = np.arange(len(self._frame)) if rows is None else rows
        if not len(rows):
            return
        segments = LineReprojection(self._K, self._K[0, 0] * self._segment[rows], sigma=self._sigma)
        group = self._problem.add_residuals(
            OnBody(segments),
            bodies[self._frame[rows]],
            mountings[self._camera[rows]],
            self.block[self._line[rows]],
            loss=Huber(_HUBER),
            name="lines",
        )
        self._views = (group, rows)

    def disconnect(self) -> None:
        """Take out the residuals that `connect` added."""
        if self._views is not None:
            self._problem.remove(self._views[0])
        self._views = None

    def reject(self, values: Sequence[Floats], newest: int, threshold: float) -> LineFit:
        """Leave out observations whose residual is larger, and lines that too few views agree on or hardly determine.

        Args:
            values: of the problem, as solved.
            newest: number of the newest frame.
            threshold: [standard deviations].
        """
        squares, information = np.zeros(len(self._frame)), np.zeros((len(self), 4, 4))
        if self._views is not None:
            group, rows = self._views
            squares[rows] = group.squares(values)
            J = group.jacobians[-1]
            np.add.at(information, group.connections[-1].rows, np.swapaxes(J, 1, 2) @ J)
        bad = squares > threshold**2
        first = (self._frame == newest) & (self._camera == 0)
        left = np.bincount(self.block.rows_of(self._line[~bad]), minlength=len(self))
        weakest = np.linalg.eigvalsh(information)[:, 0] if len(self) else np.zeros(0)
        gone = (left < _LEAST_VIEWS) | (weakest < 1.0 / _VAGUE**2)
        fit = LineFit(int((first & ~bad).sum()), int((first & bad).sum()), self._track[gone])
        self._keep(~bad)
        if gone.any():
            ids = self._ids[gone]
            self.disconnect()
            self._problem.remove(self.block[ids])
            self.forget(ids)
        return fit

    def drop(self, frame: int) -> None:
        """A frame leaves whose images are let go."""
        self.disconnect()
        self._keep(self._frame != frame)

    def leave(
        self, bodies: Variables, mountings: Variables, keyframes: Sequence[int], spared: int, newest: LineTracks | None
    ) -> VariableRows:
        """Connect what goes into a prior with the oldest of the keyframes, and return the lines that do.

        Args:
            keyframes: numbers of all, the oldest first; spared: of the first whose sight founds lines anew.
            newest: what the newest frame sees.
        """
        ids = np.unique(self._line[self._frame == keyframes[0]])
        leaving = np.isin(self._ids, ids)
        lives = leaving & np.isin(self._track, newest.ids) if newest is not None else np.zeros(len(leaving), dtype=np.bool_)
        founds_anew = np.isin(self._line, self._ids[lives]) & (self._frame >= spared)
        absorbed = np.isin(self._line, ids) & np.isin(self._frame, keyframes) & ~founds_anew
        for track in self._track[leaving]:
            self._free_from.pop(int(track), None)
        self._free_from |= dict.fromkeys(self._track[lives].tolist(), spared)
        self.connect(bodies, mountings, np.flatnonzero(absorbed))
        return self.block[ids]

    def forget(self, ids: Ints) -> None:
        """Lines (ids in the block) that were marginalised, and with them the residuals that `connect` added."""
        self._views = None
        self._keep(~np.isin(self._line, ids))
        stays = ~np.isin(self._ids, ids)
        self._ids, self._track = self._ids[stays], self._track[stays]

    def ends(self, bodies: Variables, mountings: Floats) -> tuple[Ints, Floats]:
        """Numbers (k,) of the lines, and the ends (k, 6) [m] of what the first camera saw of them last, in the world."""
        if not len(self):
            return np.zeros(0, np.int64), np.zeros((0, 6))
        own = np.flatnonzero(self._camera == 0)
        row = self.block.rows_of(self._line[own])
        last = np.full(len(self), -1)
        last[row] = own  # observations stand in order of time
        lines = np.flatnonzero(last >= 0)
        seen = last[lines]
        body = bodies.values[bodies.rows_of(self._frame[seen])]
        T = _world_poses(body, mountings[:1])
        R, p = quaternion.to_matrix(np.ascontiguousarray(T[:, :4])), T[:, 4:]
        rays = np.concatenate([self._segment[seen].reshape(-1, 2, 2), np.ones((len(seen), 2, 1))], axis=2)
        rays = np.einsum("nij,nkj->nki", R, rays)
        L = line_manifold.to_plucker(self.block.values[lines]) if len(lines) else np.zeros((0, 6))
        m, d = L[:, None, :3], L[:, None, 3:]
        foot = np.cross(d, m) / (d * d).sum(axis=2, keepdims=True) - p[:, None]
        # Where on the line the rays pass it nearest.
        dd, rr, dr = (d * d).sum(axis=2), (rays * rays).sum(axis=2), (d * rays).sum(axis=2)
        fr, fd = (foot * rays).sum(axis=2), (foot * d).sum(axis=2)
        along = (fr * dr - fd * rr) / np.maximum(dd * rr - dr * dr, 1e-12)
        ends = p[:, None] + foot + along[..., None] * d
        return self._track[lines], ends.reshape(-1, 6)

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        self._frame, self._line, self._camera = self._frame[kept], self._line[kept], self._camera[kept]
        self._segment = self._segment[kept]


def _world_poses(bodies: Floats, mountings: Floats) -> Floats:
    """(f c, 7) T_world_camera of every mounting (c, 7) on every body (f, 7)."""
    return se3.compose(np.repeat(bodies, len(mountings), axis=0), np.tile(mountings, (len(bodies), 1)))
