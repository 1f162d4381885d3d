"""Errors that all steps of the odometry, or all loop closures, share: their information knows of none, and noise hides them.

Odometry may be too long or turn too far. Loop closures may all lie beside (a scan matcher with a bias, another step of the pose
they are written for), be of another body frame (another sensor, whose mounting was forgotten), or of another instant (stamps of
one of both that are late). Each has a known shape b over the whitened errors e; with S what these leave of themselves, its size
is bᵀe / bᵀSb (Baarda 1968). What all edges share is no error: with another scale, or another body frame, of all of them, the
result is another, too, and agrees with them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.solution import Solution
from boxplus.systems.pose_graph.doubts.reliability import Floats, Reliability
from boxplus.systems.pose_graph.problem import odometry_order

_LEAST = 10  # edges of a kind, for an error of its own
_SHOWN = 1e-3  # share of a common error that shows, below which the curvature of noisy poses shows as much of one
_STEP = 1e-6  # of differences by a scale, a length and an angle


@dataclass(frozen=True, slots=True)
class CommonError:
    """An error that many edges may share.

    Attributes:
        name: what it is, with the unit it is told in.
        unit: factor to that.
        size, spare: by how much, and the inverse of its variance.
        bent: by how many of its own standard deviations the result is off at most, if this is so.
        tried: how many errors of the odometry, or of loop closures, were looked for.
    """

    name: str
    unit: float
    size: float
    spare: float
    bent: float
    tried: int

    @property
    def squared(self) -> float:
        """By how much χ² would fall."""
        return self.size**2 * self.spare

    def told(self, scale: float) -> str:
        """`4.81 ± 0.99`, with errors that are √scale times what their information promises."""
        return f"{self.unit * self.size:.3g} ± {self.unit * math.sqrt(scale / self.spare):.2g}"

    def sentence(self, scale: float) -> str:
        """What it is, by how much, and what it does."""
        return (
            f"{self.name} by {self.told(scale)}, as all edges together have it and their information does not know; the result "
            f"is bent by up to {self.bent:.2g} of its own standard deviations"
        )


@dataclass(frozen=True, slots=True)
class _Shape:
    """What an error is in the whitened errors `values` (k, d) of the edges `rows` (k,)."""

    rows: NDArray[np.int64]
    values: Floats


class _Edges:
    """Edges of a kind, and what the result has of them.

    By the relative poses of the result, as those that were measured hold the very noise that they would be compared with; what
    the result has of it is at right angles to the errors.
    """

    def __init__(self, known: Reliability, which: NDArray[np.bool_]) -> None:
        self._known, self.rows = known, np.flatnonzero(which)
        self.manifold, self.group = (SE3, se3) if known.graph.dimension == 3 else (SE2, se2)
        i, j = known.graph.edges[self.rows].T
        self.steps = np.asarray(self.group.compose(self.group.inverse(known.poses[i]), known.poses[j]))

    def shape(self, moved: Callable[[float], Floats]) -> _Shape:
        """How their whitened errors change with what moves their measurements."""
        change = self.manifold.boxminus(self.steps, moved(_STEP)) - self.manifold.boxminus(self.steps, moved(-_STEP))
        return _Shape(self.rows, np.einsum("nab,nb->na", self._known.factors[self.rows], change / (2.0 * _STEP)))


def common_errors(known: Reliability, solution: Solution, odometry: NDArray[np.bool_]) -> list[CommonError]:
    """What the odometry may be off by in common, and after that loop closures, as far as it shows.

    Args:
        odometry: (m,) edges that join successive poses.
    """
    if np.count_nonzero(odometry) < _LEAST:
        return []
    kinds = [list(_of_odometry(known, odometry))]
    if np.count_nonzero(~odometry) >= _LEAST:
        kinds.append(list(_of_loops(known, odometry)))
    # Shapes are those of poses that are turned from the truth: of what the poses take up, as much is left over by that alone. In
    # the middle of all poses, as one that hangs on a weak edge turns nothing but itself.
    turns = 3 if known.graph.dimension == 3 else 1
    least = max(_SHOWN, float(np.median((known.deviations[:, :turns] ** 2).sum(axis=1))))
    found = []
    for tried, (name, unit, b) in ((len(kind), shape) for kind in kinds for shape in kind):
        slopes = _scattered(known, b)
        (response,) = solution.response([slopes], is_determined=True)
        length = float((b.values * b.values).sum())
        spare = length - float((slopes * response).sum())
        if not spare > least * length:
            continue
        size = float((b.values * known.errors[b.rows]).sum()) / spare
        with np.errstate(divide="ignore", invalid="ignore"):
            bent = np.abs(response * size) / known.deviations
        found.append(CommonError(name, unit, size, spare, float(np.nanmax(bent, initial=0.0)), tried))
    return found


def _of_odometry(known: Reliability, odometry: NDArray[np.bool_]) -> Iterator[tuple[str, float, _Shape]]:
    """Name, factor to the unit it is told in, and shape."""
    edges, dimension = _Edges(known, odometry), known.graph.dimension

    def stretched(by: float) -> Floats:
        moved: Floats = edges.steps.copy()
        moved[:, -dimension:] *= 1.0 + by
        return moved

    yield "steps of the odometry are too long, in %,", 100.0, edges.shape(stretched)
    for about, unit, one in _axes(dimension)[0]:
        by_turn = functools.partial(lambda one, by: edges.manifold.boxplus(edges.steps, by * one), one)
        yield f"steps of the odometry turn too far{about}, in degrees,", unit, edges.shape(by_turn)


def _of_loops(known: Reliability, odometry: NDArray[np.bool_]) -> Iterator[tuple[str, float, _Shape]]:
    """The same of loop closures."""
    edges, dimension = _Edges(known, ~odometry), known.graph.dimension
    steps, shape, manifold, group = edges.steps, edges.shape, edges.manifold, edges.group
    i, j = known.graph.edges[edges.rows].T
    origin = np.eye(1, manifold.size)  # the identity of space; of the plane it is zero
    origin = origin if dimension == 3 else np.zeros_like(origin)

    def between(first: Floats, second: Floats, by: float) -> Floats:
        """Of bodies moved by tangents (k, d) or (1, d) from where they are."""
        a, b = (
            manifold.boxplus(np.repeat(origin, len(steps), axis=0), by * np.broadcast_to(v, (len(steps), v.shape[-1])))
            for v in (first, second)
        )
        return np.asarray(group.compose(group.compose(group.inverse(a), steps), b))

    turns, shifts = _axes(dimension)
    for what, axes in (("in degrees", turns), ("in m", shifts)):
        for axis, unit, one in axes:
            end = functools.partial(between, np.zeros_like(one), one)
            yield f"loop closures end beside{axis or ', in heading'}, {what},", unit, shape(end)
            both = functools.partial(between, one, one)
            frame = "loop closures are of another body frame than the odometry, "
            yield f"{frame}{'turned' if what == 'in degrees' else 'shifted'}{axis}, {what},", unit, shape(both)
    motion = _motion(known, odometry)
    yield (
        "loop closures are of later poses than those they join, in steps of the odometry,",
        1.0,
        shape(functools.partial(between, motion[i], motion[j])),
    )


def _axes(dimension: int) -> tuple[list[tuple[str, float, Floats]], list[tuple[str, float, Floats]]]:
    """Turns and shifts: words, factor to degrees or metres, and tangent (1, d)."""
    count, one = (3, np.eye(6)) if dimension == 3 else (1, np.eye(3))
    turns = [(f" about {'xyz'[k]}" if count == 3 else "", math.degrees(1.0), one[k : k + 1]) for k in range(count)]
    shifts = [(f" along {'xyz'[k]}", 1.0, one[count + k : count + k + 1]) for k in range(dimension)]
    return turns, shifts


def _motion(known: Reliability, odometry: NDArray[np.bool_]) -> Floats:
    """(n, d) step of the odometry from every pose to the next, or to it from the one before where there is no next."""
    manifold = SE3 if known.graph.dimension == 3 else SE2
    rank = odometry_order(known.graph)
    i, j = known.graph.edges[odometry].T
    back = rank[i] > rank[j]
    first, second = np.where(back, j, i), np.where(back, i, j)
    step = manifold.boxminus(known.poses[second], known.poses[first])
    motion = np.zeros((len(known.poses), step.shape[1]))
    motion[second] = step
    motion[first] = step
    return motion


def _scattered(known: Reliability, shape: _Shape) -> Floats:
    """Jᵀ b (n, d)."""
    slopes = np.zeros((len(known.poses), shape.values.shape[1]))
    for ends, J in zip(known.graph.edges[shape.rows].T, known.jacobians, strict=True):
        pulled = np.einsum("nab,na->nb", J[shape.rows], shape.values)
        for axis in range(slopes.shape[1]):
            slopes[:, axis] += np.bincount(ends, pulled[:, axis], len(slopes))
    return slopes
