"""The extrinsic from a recording's static transforms."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Transform = tuple[str, str, NDArray[np.float64]]

_SAME_M, _SAME_DEG = 1e-2, 0.6  # between transforms that say the same, one of them in metres and angles of two digits


class Chain(NamedTuple):
    """The transform between two frames.

    Attributes:
        T_target_source: (4, 4) float64.
        way: the frames on the way, target first.
        disagreement: that other transforms say something else about it, a sentence; empty where none does.
    """

    T_target_source: NDArray[np.float64]
    way: list[str]
    disagreement: str


def chain(transforms: Iterable[Transform], target: str, source: str) -> Chain | None:
    """The transform from frame `source` to frame `target` over the given edges, or None when they are not connected.

    Args:
        transforms: (parent, child, (7,) translation and xyzw quaternion) as in tf2: maps child coordinates to the parent's.
            An edge that is not finite or has no rotation is left out; of repeated edges the last one holds.
        target, source: names of frames.
    """
    edges: dict[str, dict[str, NDArray[np.float64]]] = {}
    given: list[tuple[str, str, NDArray[np.float64]]] = []
    for parent, child, values in transforms:
        T_parent_child = _matrix(values)
        if T_parent_child is None or parent == child:
            continue
        edges.setdefault(parent, {})[child] = T_parent_child
        edges.setdefault(child, {})[parent] = _inverse(T_parent_child)
        given.append((parent, child, T_parent_child))
    if target not in edges or source not in edges:
        return None
    found = {target: (np.eye(4), [target])}
    waiting = deque([target])
    while waiting:
        frame = waiting.popleft()
        T_target_frame, way = found[frame]
        for neighbour, T_frame_neighbour in edges[frame].items():
            if neighbour not in found:
                found[neighbour] = (T_target_frame @ T_frame_neighbour, [*way, neighbour])
                waiting.append(neighbour)
    if source not in found:
        return None
    T_target_source, way = found[source]
    return Chain(T_target_source, way, _disagreement(found, given, way))


def _disagreement(
    found: Mapping[str, tuple[NDArray[np.float64], list[str]]],
    given: Iterable[tuple[str, str, NDArray[np.float64]]],
    way: list[str],
) -> str:
    """The largest difference from an edge that closes a loop with some of the way, or repeats an edge of it."""
    on_way = _steps(way)
    worst, text = 1.0, ""
    for parent, child, T_parent_child in given:
        if parent not in found:
            continue
        (T_target_parent, to_parent), (T_target_child, to_child) = found[parent], found[child]
        if not on_way & (_steps(to_parent) ^ _steps(to_child)):
            continue
        angle, metres = apart(T_parent_child, _inverse(T_target_parent) @ T_target_child)
        degrees = float(np.degrees(angle))
        if max(metres / _SAME_M, degrees / _SAME_DEG) > worst:
            worst = max(metres / _SAME_M, degrees / _SAME_DEG)
            text = (
                f"the static transforms disagree: one from {child!r} to {parent!r} is {degrees:.1f} deg and {metres:.3f} m from "
                "what the others say"
            )
    return text


def apart(T: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[float, float]:
    """Angle [rad] and distance [m] between two transforms (4, 4)."""
    between = _inverse(T) @ other
    half_sine = np.linalg.norm(between[:3, :3] - np.eye(3)) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(half_sine, 1.0))), float(np.linalg.norm(between[:3, 3]))


def _steps(way: list[str]) -> set[frozenset[str]]:
    return {frozenset(step) for step in pairwise(way)}


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
