"""Sentences about variables that can move although all others stand still: points seen from one place only, and their like."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.observability.free_motions import touching_groups, vector_text
from boxplus.optimization.observability.null_space import OwnDirections
from boxplus.optimization.observability.variable_names import variable_names
from boxplus.optimization.observability.world_motions import kinds_of, positions_of
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.variables import Variables

_ALONG = 1e-5  # largest sine of the angle between a direction and the viewing ray it is
_WHOLE = 1e-6  # share of a tangent's squared length, up to which it is taken for none and for all
_SAME = 1e-6  # largest difference of directions that are told in one sentence


def describe_own(problem: LeastSquares, own: Sequence[OwnDirections]) -> list[str]:
    """A sentence for all variables of a block that are free in the same way."""
    sentences = []
    for alone in own:
        block, rows = _block_of(problem.layout, alone.number)
        names = variable_names(problem.layout, alone.number)
        seen = touching_groups(problem, alone.number)
        freedom = alone.directions.shape[2]
        if freedom == block.manifold.dof:
            if not seen:
                sentences.append(f"no residual touches {names}: fix them, remove them, or measure them")
            else:
                sentences.append(f"nothing determines {names}; residuals touching them, without effect: {seen}")
            continue
        if block.manifold == Euclidean(3) and freedom == 1:
            on_ray = _along_rays(problem, block, rows, alone)
            if on_ray.any():
                sentences.append(_seen_from_one_place(problem, alone.number[on_ray]))
            if on_ray.all():
                continue
            alone = OwnDirections(alone.number[~on_ray], alone.directions[~on_ray])
        if block.manifold == Line3D and freedom == 2 and _is_seen(problem, alone.number):
            which = "it is" if len(alone.number) == 1 else "each is"
            sentences.append(
                f"{names} can move within a plane through the camera: {which} seen from one place only; residuals touching "
                f"{_them(alone)}: {seen}"
            )
            continue
        sentences += _plain(problem, block, alone)
    return sentences


def _seen_from_one_place(problem: LeastSquares, number: NDArray[np.int64]) -> str:
    names, seen = variable_names(problem.layout, number), touching_groups(problem, number)
    if len(number) == 1:
        return f"{names} can move along its viewing ray: it is seen from one place only; residuals touching it: {seen}"
    touching = [problem.layout.numbers(c) for group in problem.groups for c in group.connections]
    times = sum(int(np.isin(of, number).sum()) for of in touching)
    # Seen more than once each, and still from one place.
    turning = times >= 2 * len(number) and len(number) == _free_like(problem, number)
    apart = ", the cameras do not move apart and no depth is determined" if turning else ""
    return (
        f"{names} can move along their viewing rays: each of the {len(number)} is seen from one place only{apart}; "
        f"residuals touching them: {seen}"
    )


def _free_like(problem: LeastSquares, number: NDArray[np.int64]) -> int:
    """How many free variables the block of these has."""
    return next(int(np.count_nonzero(own >= 0)) for own in problem.layout.number if np.isin(number[0], own))


def _plain(problem: LeastSquares, block: Variables, alone: OwnDirections) -> list[str]:
    """By direction, or by their number where the directions differ."""
    names, seen = variable_names(problem.layout, alone.number), touching_groups(problem, alone.number)
    unit = alone.directions[:, :, 0] / np.linalg.norm(alone.directions[:, :, 0], axis=1, keepdims=True)
    freedom = alone.directions.shape[2]
    if freedom > 1 or np.linalg.norm(unit - unit[0] * np.sign(unit @ unit[0])[:, None], axis=1).max() > _SAME:
        which = _which(alone, problem.layout.tangents[block.number].tangent_names)
        what = f"{freedom} of {block.manifold.dof} degrees of freedom{which} of {names}"
        return [f"{what} are unconstrained; residuals touching {_them(alone)}: {seen}"]
    first = unit[0] * np.sign(unit[0, np.argmax(np.abs(unit[0]))])
    if block.manifold in (Euclidean(2), Euclidean(3)):
        how = f"along {vector_text(first)}"
    else:
        parts = zip(first, problem.layout.tangents[block.number].tangent_names, strict=True)
        named = [(abs(w), f"{w:+.2f} {name}") for w, name in parts if abs(w) > 0.05]
        how = f"along ({', '.join(text for _, text in sorted(named, reverse=True)[:4])})"
    return [f"{names} can move freely {how}; residuals touching {_them(alone)}: {seen}"]


def _which(alone: OwnDirections, tangent_names: Sequence[str]) -> str:
    """` (translation x [m], translation y [m])`: the tangents that are free one by one, with all variables; else nothing."""
    Q = np.linalg.qr(alone.directions)[0]
    share = (Q * Q).sum(axis=2)  # of every tangent, that lies in what is free
    is_free = share.min(axis=0) > 1.0 - _WHOLE
    if not (is_free | (share.max(axis=0) < _WHOLE)).all():
        return ""
    return f" ({', '.join(name for name, free in zip(tangent_names, is_free, strict=True) if free)})"


def _them(alone: OwnDirections) -> str:
    return "it" if len(alone.number) == 1 else "them"


def _block_of(layout: Layout, number: NDArray[np.int64]) -> tuple[Variables, NDArray[np.intp]]:
    """The block of variables that all belong to one, and their rows in it."""
    for block, own in zip(layout.blocks, layout.number, strict=True):
        rows = np.flatnonzero(np.isin(own, number) & (own >= 0))
        if len(rows):
            return block, rows
    raise LookupError(f"no block has the variables {number}")


def _is_seen(problem: LeastSquares, number: NDArray[np.int64]) -> bool:
    """Whether the residuals of these variables connect them to poses."""
    for group in problem.groups:
        touches = any(np.isin(problem.layout.numbers(c), number).any() for c in group.connections)
        if touches and not any("body_from_world" in kinds_of(c.block.manifold) for c in group.connections):
            return False
    return True


def _along_rays(problem: LeastSquares, block: Variables, rows: NDArray[np.intp], alone: OwnDirections) -> NDArray[np.bool_]:
    """Which points move along the line to every pose T_camera_world that a residual connects them to."""
    on_ray, seen = np.ones(len(rows), dtype=np.bool_), np.zeros(len(rows), dtype=np.bool_)
    place = np.full(len(block), -1)
    place[rows] = np.arange(len(rows))
    p = problem.values[block.number][rows]
    for group in problem.groups:
        for own in (c for c in group.connections if c.block is block):
            where = place[own.rows]
            hit = np.flatnonzero(where >= 0)
            for other in group.connections:
                if other.block is block or "body_from_world" not in kinds_of(other.block.manifold) or not len(hit):
                    continue
                T = problem.values[other.block.number][other.rows[hit]]
                centre = positions_of(other.block.manifold, "body_from_world", T)
                if centre is None:
                    continue
                ray = p[where[hit]] - centre
                direction = alone.directions[where[hit], :, 0]
                sine = np.linalg.norm(np.cross(ray, direction), axis=1)
                off = sine > _ALONG * np.linalg.norm(ray, axis=1) * np.linalg.norm(direction, axis=1)
                on_ray[where[hit[off]]] = False
                seen[where[hit]] = True
    return on_ray & seen
