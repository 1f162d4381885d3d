"""Whether a file means what it was read as: its poses and its edges, which say the same of every step in two ways, tell."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import quaternion

_FAR, _NEAR = 0.2, 0.02  # of a step's length, by which poses and edges contradict each other as read, and agree otherwise
_BESIDE, _ALONG = 0.2, 0.05  # the same of the angles by which steps turn
_TURNING = 0.75  # quantile of these angles, from which on a step turns enough to tell
_STRAIGHT = 1e-3  # [rad] turns that are none
_LEAST = 10  # steps
_LIMIT = 20_000  # steps looked at


def misreading(graph: PoseGraph, follow: NDArray[np.bool_]) -> str | None:
    """A sentence where the poses of the file contradict its odometry as they were read, and agree with it read in another way.

    The ways are angles in degrees (2D), quaternions with w first (3D), edges that go from the second pose to the first, poses of
    the world in the body, a world that is mirrored, rotations that are inverted, edges along the axes of the world, and positions
    in another unit than the edges. Where positions agree with the edges, rotations are asked.

    Args:
        follow: (m,) which edges are odometry (`consecutive_edges`).
    """
    if graph.poses is None:
        return None
    steps = np.flatnonzero(follow)
    steps = steps[:: max(1, len(steps) // _LIMIT)]
    i, j = graph.edges[steps].T
    split = 4 if graph.dimension == 3 else 1
    p, t = graph.poses[:, split:], graph.measurements[steps, split:]
    length = float(np.median(np.linalg.norm(t, axis=1))) if len(steps) else 0.0
    if len(steps) < _LEAST or not length > 0.0:
        return None
    turn = graph.poses[:, :split]

    def off(R: NDArray[np.float64], p: NDArray[np.float64], a: NDArray[np.int64], b: NDArray[np.int64]) -> float:
        """Median distance between what poses and edges say of a step, as a share of its length."""
        seen = np.einsum("nba,nb->na", R[a], p[b] - p[a])
        return float(np.median(np.linalg.norm(seen - t, axis=1))) / length

    R = _rotations(turn)
    as_read = off(R, p, i, j)
    if not as_read > _FAR:
        return _turned_edges(R[i].transpose(0, 2, 1) @ R[j], graph.measurements[steps, :split])
    other = _rotations(np.radians(turn) if graph.dimension == 2 else turn[:, [1, 2, 3, 0]])
    back, ratio = R.transpose(0, 2, 1), float(np.median(np.linalg.norm(p[j] - p[i], axis=1))) / length
    ways = {
        "angles are taken for degrees" if graph.dimension == 2 else "quaternions are taken for qw qx qy qz": off(other, p, i, j),
        "edges are taken to lead from their second pose to their first": off(R, p, j, i),
        "poses are taken for those of the world in the body, and inverted": off(back, -np.einsum("nab,nb->na", back, p), i, j),
    }
    ways["rotations of the poses are taken for inverted"] = off(back, p, i, j)
    still = np.broadcast_to(np.eye(R.shape[1]), R.shape)
    ways["translations of the edges are taken for those along the axes of the world"] = off(still, p, i, j)
    axes = (np.array([-1.0, 1.0]), np.array([1.0, -1.0])) if graph.dimension == 2 else tuple(1.0 - 2.0 * np.eye(3))
    for flip, name in zip(axes, "xyz"[: graph.dimension], strict=True):
        mirrored = R * flip[:, None] * flip
        ways[f"the {name} axis of the poses is taken for flipped (of positions and rotations)"] = off(mirrored, p * flip, i, j)
    if ratio > 0.0:
        told = f"{ratio:.4g} times too large" if ratio > 1.0 else f"{1.0 / ratio:.4g} times too small"
        ways[f"positions are taken for {told}, another unit than that of the edges"] = off(R, p / ratio, i, j)
    way = min(ways, key=lambda name: ways[name])
    if not ways[way] < _NEAR:
        return None
    return (
        f"the poses of the file contradict its odometry by {as_read:.0%} of a step as they were read, and by "
        f"{ways[way]:.1%} if {way}: correct the file"
    )


def _turned_edges(of_poses: NDArray[np.float64], measured: NDArray[np.float64]) -> str | None:
    """The same of the rotations of steps, of which edges alone may have another meaning.

    Args:
        of_poses: (k, 2, 2) or (k, 3, 3) what the poses say of each step. measured: (k, 1) or (k, 4) what its edge says.
    """
    turn = _angles(of_poses, np.broadcast_to(np.eye(of_poses.shape[1]), of_poses.shape))
    turning = turn >= max(float(np.quantile(turn, _TURNING)), _STRAIGHT)
    if np.count_nonzero(turning) < _LEAST:
        return None
    usual = float(np.median(turn[turning]))

    def off(R: NDArray[np.float64]) -> float:
        """Median angle between what poses and edges say of a step that turns, as a share of its own."""
        return float(np.median(_angles(R, of_poses)[turning])) / usual

    R = _rotations(measured)
    as_read = off(R)
    if not as_read > _BESIDE:
        return None
    if measured.shape[1] == 1:
        ways = {"angles of the edges are taken for degrees": off(_rotations(np.radians(measured)))}
    else:
        ways = {"quaternions of the edges are taken for qw qx qy qz": off(_rotations(measured[:, [1, 2, 3, 0]]))}
    ways["rotations of the edges are taken for inverted"] = off(R.transpose(0, 2, 1))
    way = min(ways, key=lambda name: ways[name])
    if not ways[way] < _ALONG:
        return None
    return (
        f"the rotations of the edges contradict the poses of the file by {as_read:.0%} of a turn as they were read, and by "
        f"{ways[way]:.1%} if {way}: correct the file"
    )


def _angles(A: NDArray[np.float64], B: NDArray[np.float64]) -> NDArray[np.float64]:
    """(k,) between rotations (k, d, d) [rad]: ‖A − B‖ is 2√2 sin(θ/2), in the plane and in space."""
    return np.asarray(2.0 * np.arcsin(np.minimum(np.linalg.norm(A - B, axis=(1, 2)) / math.sqrt(8.0), 1.0)))


def _rotations(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    if turn.shape[1] == 4:
        return quaternion.to_matrix(turn)
    c, s = np.cos(turn[:, 0]), np.sin(turn[:, 0])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
