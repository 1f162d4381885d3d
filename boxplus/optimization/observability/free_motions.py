"""Sentences about motions that several variables make together, in terms of the world: translation, rotation, scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, product

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.observability.components import Components
from boxplus.optimization.observability.null_space import OwnDirections, SharedDirections
from boxplus.optimization.observability.variable_names import variable_names
from boxplus.optimization.observability.world_motions import DOF, displacements_of, kinds_of, motions_of, positions_of
from boxplus.optimization.terms.variables import Variables

_IS_MOTION = 1e-8  # share of a motion's squared length that may lie outside the free directions
_IS_DEPENDENT = 1e-12  # motions that move nothing, such as a turn of one point about itself
_READINGS = 256  # combinations of kinds tried
_GROUPS, _DIRECTIONS = 4, 2  # named before the rest is counted
_FLAT = 1e-4
_HARDLY = 1e-3  # radians for every metre, or the other way round, that are none


def touching_groups(problem: LeastSquares, number: NDArray[np.int64]) -> str:
    """`edges (24 RelativePose), pixels (100 Reprojection)`: the groups whose residuals touch free variables."""
    wanted = np.zeros(len(problem.layout.sizes) + 1, dtype=np.bool_)  # the last stands for fixed ones, −1
    wanted[number] = True
    named = []
    for group in problem.groups:
        touched = np.any([wanted[problem.layout.numbers(c)] for c in group.connections], axis=0)
        if touched.any():
            named.append(f"{group.name} ({int(touched.sum())} {type(group.residual).__name__})")
    rest = f" and {len(named) - _GROUPS} more groups" if len(named) > _GROUPS else ""
    return ", ".join(named[:_GROUPS]) + rest


def vector_text(v: NDArray[np.float64]) -> str:
    """`(0.99, 0.02, 0)`."""
    return "(" + ", ".join(f"{x:.2f}".rstrip("0").rstrip(".") if abs(x) >= 0.005 else "0" for x in v) + ")"


def describe_shared(problem: LeastSquares, shared: SharedDirections, own: Sequence[OwnDirections]) -> list[str]:
    """What one set of free directions does to its variables, and which residuals touch them.

    Args:
        own: directions that variables have alone; the shared ones leave them out.
    """
    names = variable_names(problem.layout, shared.number)
    Q = np.linalg.qr(shared.directions * shared.scale[:, None])[0]
    world = _world_motions(problem, shared, own, Q)
    seen = f"residuals touching them: {touching_groups(problem, shared.number)}"
    sentences = []
    if world.free.shape[1]:
        loose = not Components.of(problem.layout, problem.groups).anchored[shared.component]
        whose = f"nothing ties {names} to the world, only to each other: " if loose else ""
        of = "them" if loose else names
        motions = _phrases(world)
        is_are = "are" if len(motions) > 1 else "is"
        advice = "fix one of them, or add a prior"
        if motions[-1].startswith("the scale"):
            advice = "fix a second pose, measure a distance, or add a prior"
            advice = f"fix one pose for the motion; for the scale {advice}" if len(motions) > 1 else advice
        sentences.append(f"{whose}{_listed(motions)} of {of} {is_are} unconstrained ({advice}); {seen}")
    rest = Q - world.covered @ (world.covered.T @ Q)
    U, length, _ = np.linalg.svd(rest, full_matrices=False)
    others = U[:, length > 0.5]
    for direction in others.T[:_DIRECTIONS]:
        tangents = direction / shared.scale
        together = _poses_text(problem, shared, tangents)
        how = together or f"along ({_tangents_text(problem, shared, tangents)})"
        sentences.append(f"{names} can move freely {how}; {seen}")
    if others.shape[1] > _DIRECTIONS:
        more = others.shape[1] - _DIRECTIONS
        sentences.append(f"{'' if shared.is_complete else 'at least '}{more} more directions of the same variables are free")
    return sentences


@dataclass(frozen=True, slots=True)
class _World:
    """Which motions of the world are free.

    Attributes:
        free: (7, k) orthonormal, rotation and scale about `centre`, lengths in units of `extent`.
        covered: (d, k) what they do to the scaled tangents, orthonormal.
        is_planar: all is two-dimensional.
    """

    free: NDArray[np.float64]
    covered: NDArray[np.float64]
    centre: NDArray[np.float64]
    extent: float
    is_planar: bool


def _world_motions(
    problem: LeastSquares, shared: SharedDirections, own: Sequence[OwnDirections], Q: NDArray[np.float64]
) -> _World:
    """The similarities of the world that lie in the span of Q, under the reading of the variables that explains most."""
    parts = _parts(problem, shared)
    best = _World(np.zeros((DOF, 0)), np.zeros((len(Q), 0)), np.zeros(3), 1.0, False)
    for reading in islice(product(*(part.kinds for part in parts)), _READINGS):
        found = _test(problem, shared, own, Q, parts, reading)
        if found.free.shape[1] > best.free.shape[1]:
            best = found
        if best.free.shape[1] == min(DOF, Q.shape[1]):
            break
    return best


@dataclass(frozen=True, slots=True)
class _Part:
    """The moving variables of one block: their rows, their places among the directions, and what they may stand for."""

    block: Variables
    rows: NDArray[np.intp]
    places: NDArray[np.intp]
    kinds: tuple[str, ...]


def _parts(problem: LeastSquares, shared: SharedDirections) -> list[_Part]:
    parts, begin = [], 0
    for block, number in zip(problem.layout.blocks, problem.layout.number, strict=True):
        rows = np.flatnonzero(np.isin(number, shared.number) & (number >= 0))
        if len(rows):
            # Tangents stand in ascending order, as do the variables of a block.
            end = begin + len(rows) * block.manifold.dof
            parts.append(_Part(block, rows, np.arange(begin, end), kinds_of(block.manifold)))
            begin = end
    return parts


def _test(
    problem: LeastSquares,
    shared: SharedDirections,
    own: Sequence[OwnDirections],
    Q: NDArray[np.float64],
    parts: list[_Part],
    reading: tuple[str, ...],
) -> _World:
    B = np.zeros((len(Q), DOF))
    places = []
    planar = True
    for part, kind in zip(parts, reading, strict=True):
        x = problem.values[part.block.number][part.rows]
        B[part.places] = motions_of(problem.layout.tangents[part.block.number], kind, x).reshape(-1, DOF)
        position = positions_of(part.block.manifold, kind, x)
        if position is not None:
            places.append(position)
            planar &= part.block.manifold.dof <= 3 and not np.any(position[:, 2])
    p = np.concatenate(places) if places else np.zeros((1, 3))
    centre = p.mean(axis=0)
    extent = float(np.sqrt(((p - centre) ** 2).sum(axis=1).mean())) or 1.0
    # Turned and scaled about the centre: w × (p − c) + v + s (p − c) = w × p + (v − w × c − s c) + s p.
    change = np.eye(DOF)
    change[3:6, :3] = [[0.0, -centre[2], centre[1]], [centre[2], 0.0, -centre[0]], [-centre[1], centre[0], 0.0]]
    change[3:6, 6] = -centre
    change[:, [0, 1, 2, 6]] /= extent
    B = shared.scale[:, None] * (B @ change)
    _leave_out(problem, shared, own, B)
    weight, basis = np.linalg.eigh(B.T @ B)
    able = weight > _IS_DEPENDENT * weight[-1]
    if able.sum() >= len(B):
        # So few tangents that some turn and scale explains any direction: only what is plainly a translation counts.
        B[:, [0, 1, 2, 6]] = 0.0
        weight, basis = np.linalg.eigh(B.T @ B)
        able = weight > _IS_DEPENDENT * weight[-1]
    if not able.any():
        return _World(np.zeros((DOF, 0)), np.zeros((len(Q), 0)), centre, extent, planar)
    onto = basis[:, able] / np.sqrt(weight[able])
    inside = Q.T @ B @ onto
    outside, rotation = np.linalg.eigh(np.eye(inside.shape[1]) - inside.T @ inside)
    motions = onto @ rotation[:, outside < _IS_MOTION]
    if not motions.shape[1]:
        return _World(motions, np.zeros((len(Q), 0)), centre, extent, planar)
    return _World(np.linalg.qr(motions)[0], np.linalg.qr(B @ motions)[0], centre, extent, planar and bool(places))


def _leave_out(problem: LeastSquares, shared: SharedDirections, own: Sequence[OwnDirections], B: NDArray[np.float64]) -> None:
    """Take out of scaled tangents what variables can do alone."""
    for alone in own:
        moved = np.isin(alone.number, shared.number)
        if moved.any():
            start = np.searchsorted(shared.index, problem.layout.start[alone.number[moved]])
            places = start[:, None] + np.arange(alone.directions.shape[1])
            normal = alone.directions[moved] * shared.scale[places][:, :, None]
            B[places] -= normal @ (np.swapaxes(normal, 1, 2) @ B[places])


def _within(free: NDArray[np.float64], zero: list[int]) -> NDArray[np.float64]:
    """The part of the space whose entries `zero` vanish, (7, k) orthonormal."""
    if not free.shape[1]:
        return free
    Q = np.linalg.qr(free)[0]
    _, length, right = np.linalg.svd(Q[zero], full_matrices=True)
    length = np.concatenate([length, np.zeros(len(right) - len(length))])
    return np.asarray(Q @ right[length < _FLAT].T)


def _phrases(world: _World) -> list[str]:
    """Names of the free motions, the most general ones that hold."""
    translations = _within(world.free, [0, 1, 2, 6])
    turns = _beyond(_within(world.free, [6]), translations)
    scales = _beyond(world.free, np.column_stack([translations, turns]))
    shifts, spins = translations.shape[1], turns.shape[1]
    dimensions = 2 if world.is_planar else 3
    phrases = []
    if shifts == dimensions and spins == (1 if world.is_planar else 3):
        phrases.append("any rigid motion")
    else:
        phrases += _translation(translations[3:6], world.is_planar)
        phrases += _rotation(world, turns, shifts)
    if scales.shape[1]:
        phrases.append("the scale" + _about(world, scales[:, 0], shifts == dimensions))
    return phrases


def _beyond(space: NDArray[np.float64], known: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the space has beyond a known part of it, orthogonal to that."""
    if not space.shape[1]:
        return space
    Q = np.linalg.qr(space)[0]
    rest = Q - known @ (known.T @ Q)
    U, length, _ = np.linalg.svd(rest, full_matrices=False)
    return np.asarray(U[:, length > 0.5])


def _signed(v: NDArray[np.float64]) -> NDArray[np.float64]:
    unit = v / np.linalg.norm(v)
    return np.asarray(unit * (1.0 if unit[np.argmax(np.abs(unit))] > 0.0 else -1.0))


def _translation(v: NDArray[np.float64], is_planar: bool) -> Iterator[str]:
    if v.shape[1] == (2 if is_planar else 3):
        yield "translation in any direction"
    elif v.shape[1] == 2:
        yield f"translation across {vector_text(_signed(np.cross(v[:, 0], v[:, 1])))}"
    elif v.shape[1] == 1:
        yield f"translation along {vector_text(_signed(v[:2, 0] if is_planar else v[:, 0]))}"


def _rotation(world: _World, turns: NDArray[np.float64], shifts: int) -> Iterator[str]:
    if turns.shape[1] == 3:
        yield "rotation about any axis"
    elif turns.shape[1] == 2:
        yield f"rotation about any axis across {vector_text(_signed(np.cross(turns[:3, 0], turns[:3, 1])))}"
    elif turns.shape[1] == 1:
        w, v = turns[:3, 0], turns[3:6, 0] * world.extent
        through = ""
        if shifts < 2:
            point = world.centre + np.cross(w, v) / (w @ w)
            through = f" through {vector_text(point[:2] if world.is_planar else point)}"
        yield f"rotation{through}" if world.is_planar else f"rotation about the axis {vector_text(_signed(w))}{through}"


def _about(world: _World, motion: NDArray[np.float64], is_anywhere: bool) -> str:
    if is_anywhere or abs(motion[6]) < _FLAT or np.linalg.norm(motion[:3]) > _FLAT:
        return ""
    point = world.centre - motion[3:6] * world.extent / motion[6]
    return f" about {vector_text(point[:2] if world.is_planar else point)}"


def _listed(phrases: list[str]) -> str:
    return phrases[0] if len(phrases) == 1 else ", ".join(phrases[:-1]) + " and " + phrases[-1]


def _poses_text(problem: LeastSquares, shared: SharedDirections, direction: NDArray[np.float64]) -> str:
    """How far, and which way, poses turn where others shift, where they do both; empty else."""
    moved = []
    for part in _parts(problem, shared):
        tangents = direction[part.places].reshape(len(part.rows), -1)
        number = part.block.number
        found = displacements_of(problem.layout.tangents[number], problem.values[number][part.rows], tangents)
        if found is not None:
            moved.append((problem.layout.number[number][part.rows], *found, part.block.manifold.dof <= 3))
    if not moved:
        return ""
    numbers, turns, shifts = (np.concatenate([one[k] for one in moved]) for k in range(3))
    turn, shift = np.linalg.norm(turns, axis=1), np.linalg.norm(shifts, axis=1)
    most_turned, most_shifted = int(np.argmax(turn)), int(np.argmax(shift))
    angle, length = turn[most_turned], shift[most_shifted]
    if angle <= _HARDLY * length or length <= _HARDLY * angle:
        return ""
    axis = _signed(turns[most_turned])
    along = shifts[most_shifted] / (length * (1.0 if axis @ turns[most_turned] > 0.0 else -1.0))
    who_turns, who_shifts = (variable_names(problem.layout, numbers[[k]]) for k in (most_turned, most_shifted))
    is_flat = all(flat for *_, flat in moved)
    return (
        f"by turning and shifting together, each by its own: where {who_turns}, which turns most, turns by 1 deg"
        f"{'' if is_flat else f' about {vector_text(axis)}'}, {who_shifts}, which shifts most, shifts by "
        f"{np.radians(length / angle):.3g} m along {vector_text(along[:2] if is_flat else along)}"
    )


def _tangents_text(problem: LeastSquares, shared: SharedDirections, direction: NDArray[np.float64]) -> str:
    """`+1.00 rotation z [rad] of poses, …`: the largest tangents of every block."""
    largest = float(np.abs(direction).max())
    named = []
    for part in _parts(problem, shared):
        tangents = direction[part.places].reshape(len(part.rows), -1)
        for axis, name in enumerate(problem.layout.tangents[part.block.number].tangent_names):
            peak = tangents[np.argmax(np.abs(tangents[:, axis])), axis] / largest
            if abs(peak) > 0.1:
                named.append((abs(peak), f"{peak:+.2f} {name} of {part.block.name}"))
    return ", ".join(text for _, text in sorted(named, reverse=True)[:4])
