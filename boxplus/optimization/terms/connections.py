"""Whether a residual and the variables it is connected to speak of the same thing.

A manifold says how a variable moves, and a role of a residual (`T_camera_world`, `p_world`) what its numbers mean. Numbers of the
right count in the wrong meaning give a cost, a minimum and a covariance like any others, so that both are compared before
anything is computed: the manifolds by equality, the meanings among all residuals that share a block.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np

from boxplus._arguments import require
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.tangents.change import POSES
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import VariableRows
from boxplus.residuals.residual import Residual

_MEANINGS = (
    (r"T_world_\w+", "a pose that maps to the world"),
    (r"T_\w+_world", "a pose that maps from the world"),
    (r"T_body_\w+", "where a sensor sits on its body"),
    (r"p_world", "a point in the world"),
    (r"bearing_rho", "a bearing and an inverse depth in an anchor"),
    (r"pixel_rho", "a pixel and an inverse depth in an anchor"),
    (r"rho", "an inverse depth"),
    (r"intrinsics", "the intrinsics of a camera"),
    (r"velocity_bias_[ij]", "a velocity and the biases of an IMU"),
    (r"image_time_offset", "one by which images are brought to the poses"),
    (r"imu_time_offset", "one by which the IMU is brought to the poses"),
)


def require_manifold(manifold: Manifold) -> None:
    """Refuse what is no manifold.

    Raises:
        InputError: the class of one, such as `Euclidean` without its dimension, or something else.
    """
    if not isinstance(manifold, Manifold):
        what = manifold.__name__ if isinstance(manifold, type) else repr(manifold)
        raise InputError("a manifold", what, "give one such as boxplus.SE3 or boxplus.Euclidean(3), dimension included")


def require_connections(residual: Residual, connections: Sequence[object]) -> None:
    """Refuse another number of connections than the residual has variables.

    Raises:
        InputError: so many others.
    """
    require(residual, Residual, "a residual", "give one of boxplus.residuals, or a subclass of boxplus.residuals.Residual")
    if len(connections) != len(residual.manifolds):
        raise InputError(
            f"{len(residual.manifolds)} connections ({', '.join(residual.roles)})",
            f"{len(connections)}",
            f"connect every variable of {type(residual).__name__}",
        )


def check_connections(residual: Residual, rows: Sequence[VariableRows], groups: Iterable[Group], carry_over: bool) -> None:
    """Refuse variables on other manifolds than the residual is derived for, or in another meaning than elsewhere.

    Args:
        rows: one connection for every variable of the residual.
        groups: what the problem has so far.
        carry_over: allow another ⊞ of the same pose.

    Raises:
        InputError: another manifold; a block that one residual takes for T_world_… and another for T_…_world, or for a
            point and for a bearing with an inverse depth.
    """
    for role, native, connection in zip(residual.roles, residual.manifolds, rows, strict=True):
        actual = connection.block.manifold
        if native == actual or carry_over:  # what cannot be carried over is refused by `tangent_change`
            continue
        advice = f"add the variables of {connection.block.name!r} on {native.name}"
        if native in POSES and actual in POSES:
            advice += f"; if they are {role} and shall move as {actual.name} does, give carry_over=True"
        raise InputError(
            f"{role} of {type(residual).__name__} on {native.name}", f"{connection.block.name!r} on {actual.name}", advice
        )
    # Variables may be shared between groups and within one; only roles that mean something can contradict another.
    telling = [
        (role, meaning, c) for role, c in zip(residual.roles, rows, strict=True) if (meaning := _meaning(role)) is not None
    ]
    if not telling:
        return
    used = [
        (group.name, role, meaning, connection)
        for group in groups
        for role, connection in zip(group.residual.roles, group.connections, strict=True)
        if (meaning := _meaning(role)) is not None
    ]
    for role, meaning, connection in telling:
        for name, other_role, other_meaning, other in used:
            if other.block is not connection.block or meaning == other_meaning:
                continue
            if len(np.intersect1d(other.rows, connection.rows)):
                raise InputError(
                    f"{role} of {type(residual).__name__}, {meaning}",
                    f"{connection.block.name!r}, which {name!r} takes for {other_role}, {other_meaning}",
                    "add variables for each meaning, or take residuals that agree",
                )
        used.append((type(residual).__name__, role, meaning, connection))


@lru_cache(maxsize=1024)
def _meaning(role: str) -> str | None:
    """What a role says of its variable; None where it says nothing that another role could contradict."""
    for pattern, meaning in _MEANINGS:
        if re.fullmatch(pattern, role):
            return meaning
    return None
