"""Does a marginal prior claim to know what nothing measures? (docs/marginalization.md)

Moving the whole world changes no measurement that is relative. A prior with ‖J n‖ > 0 along such a motion n has information that
came from nowhere: from Jacobians of one variable taken at two places.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import require
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.observability.world_motions import kinds_of, motions_of
from boxplus.optimization.terms.variables import Variables

_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Gauge:
    """Motions of the problem that no residual sees; `world_gauge` makes the usual ones.

    Attributes:
        names: of the k motions.
        units: of each: `m`, `rad`, or empty for a factor.
        tangents: for blocks by their names the tangents (n, dof, k) of their variables at x (n, size) under each motion, by one
            unit; blocks that are left out do not move.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    tangents: Mapping[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]]


@dataclass(frozen=True, slots=True)
class Leak:
    """How much a marginal prior says about motions that nothing measures.

    Attributes:
        names: of the k motions.
        relative: (k,) ‖J n‖ / ‖J‖ for the motion by one unit; rounding is below 1e-10.
        per_sigma: (k,) by how much of the motion the prior differs by one standard deviation, in metres, degrees or as a factor:
            what it claims to know; infinite where it claims nothing.
        units: of `per_sigma`.
        is_anchored: something that was marginalised measured where the world is; the prior then knows rightly.
    """

    names: tuple[str, ...]
    relative: NDArray[np.float64]
    per_sigma: NDArray[np.float64]
    units: tuple[str, ...]
    is_anchored: bool

    @property
    def worst(self) -> float:
        """The largest of `relative`."""
        return float(self.relative.max(initial=0.0))

    def sentences(self) -> list[str]:
        """`yaw: one sigma of the prior is 3.1 deg`, for every motion."""
        return [
            f"{name}: one sigma of the prior is {size:.3g} {unit}".rstrip()
            for name, size, unit in zip(self.names, self.per_sigma, self.units, strict=True)
        ]


def world_gauge(
    blocks: Mapping[Variables, str],
    *,
    rotation: Literal["any", "yaw", "none"] = "any",
    up: ArrayLike = (0.0, 0.0, 1.0),
    scale: bool = False,
) -> Gauge:
    """Translation of the world, and what else is free of rotation and scale.

    Cameras and LiDARs alone leave any rotation free, an accelerometer only that about `up`; one camera alone leaves the scale.

    Args:
        blocks: what the variables of each block are: `world_from_body` or `body_from_world` for poses and rotations, `point`,
            `vector`, `velocity_first` (n numbers of which the first three are a velocity), `inverse_depth`, `line`. Blocks that
            are left out, such as biases and extrinsics, do not know of the world.
        up: (3,) axis of the yaw, in the world.

    Raises:
        InputError: a kind that the manifold of the block cannot be; an axis of no length.

    Example:
        >>> problem = bp.Problem()
        >>> poses = problem.add_variables(bp.SE3, bp.SE3.random(np.random.default_rng(0), 3), name="poses")
        >>> gauge = bp.world_gauge({poses: "world_from_body"}, rotation="yaw")  # moves of the world that nothing measures
        >>> gauge.names
        ('translation x', 'translation y', 'translation z', 'yaw')
    """
    require(blocks, Mapping, "the meaning of every block, by block", 'write e.g. world_gauge({poses: "world_from_body"})')
    axis = as_floats(up, "up")
    if axis.shape != (3,) or not 0.0 < float(np.linalg.norm(axis)) < math.inf:
        raise InputError("up as an axis (3,)", repr(up), "give (0, 0, 1) in a world with z up")
    if rotation not in ("any", "yaw", "none"):
        raise InputError('rotation "any", "yaw" or "none"', repr(rotation), "choose one of them")
    names = [f"translation {a}" for a in _AXES]
    columns = [np.eye(7)[:, 3 + k] for k in range(3)]
    if rotation == "any":
        names += [f"rotation {a}" for a in _AXES]
        columns += [np.eye(7)[:, k] for k in range(3)]
    elif rotation == "yaw":
        names.append("yaw")
        columns.append(np.concatenate([axis / np.linalg.norm(axis), np.zeros(4)]))
    units = ["m"] * 3 + ["rad"] * (len(names) - 3)
    if scale:
        names.append("scale")
        units.append("")
        columns.append(np.eye(7)[:, 6])
    motions = np.stack(columns, axis=1)
    for block, kind in blocks.items():
        require(block, Variables, "blocks of variables", 'write e.g. world_gauge({poses: "world_from_body"})')
        if kind not in kinds_of(block.manifold):
            raise InputError(f"for {block.name!r} one of {', '.join(kinds_of(block.manifold))}", repr(kind), "choose one of them")
    tangents = {block.name: _tangents(block.manifold, kind, motions) for block, kind in blocks.items()}
    return Gauge(tuple(names), tuple(units), tangents)


def _tangents(
    manifold: Manifold, kind: str, motions: NDArray[np.float64]
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    return lambda x: motions_of(manifold, kind, x) @ motions


def leak_of(
    J: NDArray[np.float64], blocks: list[tuple[Variables, NDArray[np.float64]]], gauge: Gauge, *, is_anchored: bool
) -> Leak:
    """The leak of a prior with the Jacobian J (d, w).

    Args:
        blocks: the blocks it knows variables of, in the order of its columns, and the points (n, size) where they are linearised.
    """
    N = np.zeros((J.shape[1], len(gauge.names)))
    end = 0
    for block, x in blocks:
        begin, end = end, end + len(x) * block.manifold.dof
        if block.name in gauge.tangents:
            N[begin:end] = gauge.tangents[block.name](x).reshape(end - begin, len(gauge.names))
    along = np.sqrt(((J[:, :, None] * N[None]).sum(axis=1) ** 2).sum(axis=0)) if len(J) else np.zeros(N.shape[1])
    whole = math.sqrt(float((J**2).sum()))
    with np.errstate(divide="ignore"):
        size = 1.0 / along
    in_degrees = np.array([unit == "rad" for unit in gauge.units])
    units = tuple("deg" if unit == "rad" else unit for unit in gauge.units)
    return Leak(gauge.names, along / whole if whole else along, np.where(in_degrees, np.degrees(size), size), units, is_anchored)
