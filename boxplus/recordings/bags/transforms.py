"""The extrinsic from a recording's static transforms."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Transform = tuple[str, str, NDArray[np.float64]]


def chain(transforms: Iterable[Transform], target: str, source: str) -> tuple[NDArray[np.float64], list[str]] | None:
    """The transform from frame `source` to frame `target` over the given edges, or None when they are not connected.

    Args:
        transforms: (parent, child, (7,) translation and xyzw quaternion) as in tf2: maps child coordinates to the parent's.
            An edge that is not finite or has no rotation is left out; of repeated edges the last one holds.
        target, source: names of frames.

    Returns:
        T_target_source (4, 4) float64, and the frames on the way, target first.
    """
    edges: dict[str, dict[str, NDArray[np.float64]]] = {}
    for parent, child, values in transforms:
        T_parent_child = _matrix(values)
        if T_parent_child is None or parent == child:
            continue
        edges.setdefault(parent, {})[child] = T_parent_child
        edges.setdefault(child, {})[parent] = _inverse(T_parent_child)
    if target not in edges or source not in edges:
        return None
    found = {target: (np.eye(4), [target])}
    waiting = deque([target])
    while waiting and source not in found:
        frame = waiting.popleft()
        T_target_frame, way = found[frame]
        for neighbour, T_frame_neighbour in edges[frame].items():
            if neighbour not in found:
                found[neighbour] = (T_target_frame @ T_frame_neighbour, [*way, neighbour])
                waiting.append(neighbour)
    return found.get(source)


def _matrix(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    norm = float(np.linalg.norm(values[3:]))
    if not np.isfinite(values).all() or abs(norm - 1.0) > 0.1:
        return None
    x, y, z, w = values[3:] / norm
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = values[:3]
    return T


def _inverse(T: NDArray[np.float64]) -> NDArray[np.float64]:
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse
