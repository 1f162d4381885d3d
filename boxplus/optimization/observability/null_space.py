"""The directions in which a linearised problem does not determine its variables.

A direction v is unobservable when ‖J v‖² vanishes against ‖D v‖², D² being the diagonal of H. Two kinds are looked for, apart:
those of one variable alone, from its diagonal block (there may be thousands: points seen from one place only), and those that
several variables share, by inverse iteration on each connected component (a free gauge, a free scale).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.observability.components import Components
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import connected_numbers
from boxplus.sparse.cholesky import NotPositiveDefinite

# A direction is unobservable when its curvature, scaled to a unit diagonal, is below this. Computed from J, gauges come out below
# 1e-20; an odometry of 10,000 poses without any loop is down to 1e-16 and yet determined.
NULL = 1e-18
_OWN_NULL = 1e-13  # the same for the block of one variable, which is a sum of squares and therefore less exact
# The share of the diagonal that makes H regular for the inverse iteration.
_SHIFTS = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6)
_LEAST_SCALE = 1e-26  # of the largest diagonal entry: below it an entry is rounding
_FIRST_SUBSPACE, _SUBSPACE = 2, 12  # directions to see whether there is anything to find, and to find it
_FIRST_ROUNDS, _MORE_ROUNDS = 2, 4  # of inverse iteration
_SUSPICIOUS = 1e-11  # lowest curvature after the first rounds that settles the matter
_CANDIDATE = 1e-9  # curvatures below it are computed once more
_MOVED = 1e-6  # of the largest tangent of a direction: below it a variable does not move
_CHUNK = 16384


@dataclass(frozen=True, slots=True)
class OwnDirections:
    """Unobservable directions of variables alone, those of one block that have equally many.

    Attributes:
        number: (m,) numbers of the variables.
        directions: (m, dof, k) tangents.
    """

    number: NDArray[np.int64]
    directions: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SharedDirections:
    """Unobservable directions that move several variables together.

    Attributes:
        component: of the variables.
        number: (m,) numbers of the variables that move.
        index: (d,) places of their tangents in the tangent vector of the problem.
        directions: (d, k) tangents; those outside `index` are zero.
        scale: (d,) √diag(H), in which tangents of different units compare.
        is_complete: False where there may be more directions than were looked for.
    """

    component: int
    number: NDArray[np.int64]
    index: NDArray[np.int64]
    directions: NDArray[np.float64]
    scale: NDArray[np.float64]
    is_complete: bool


@dataclass(frozen=True, slots=True)
class NullSpace:
    """All unobservable directions at a point.

    Attributes:
        own, shared: the directions.
        moves: (free variables,) whether an unobservable direction moves it. What does not move has a covariance all the same.
        pivots: places in the tangent vector; holding these makes the problem regular and leaves the others' covariance as it is.
    """

    own: tuple[OwnDirections, ...]
    shared: tuple[SharedDirections, ...]
    moves: NDArray[np.bool_]
    pivots: NDArray[np.int64]

    @property
    def is_empty(self) -> bool:
        """Whether the problem determines all of its variables."""
        return not len(self.pivots)


def find_null_space(problem: LeastSquares) -> NullSpace:
    """The unobservable directions at the accepted point of `problem`, whose factorisation is replaced."""
    problem.linearize(problem.values)
    layout = problem.layout
    diagonal = problem.system.diagonal
    least = _LEAST_SCALE * float(diagonal.max(initial=0.0))
    scale = np.sqrt(np.where(diagonal > least, diagonal, least if least > 0.0 else 1.0))
    own, projectors = _own_directions(problem, scale)
    shared = _shared_directions(problem, scale, projectors)
    moves = np.zeros(len(layout.sizes), dtype=np.bool_)
    for number in [*(alone.number for alone in own), *(together.number for together in shared)]:
        moves[number] = True
    rows = [_own_pivots(alone) for alone in own]
    pivots = [(layout.start[alone.number][:, None] + r).reshape(-1) for alone, r in zip(own, rows, strict=True)]
    for component in sorted({together.component for together in shared}):
        parts = [together for together in shared if together.component == component]
        index = np.unique(np.concatenate([part.index for part in parts]))
        weights = np.zeros((len(index), sum(part.directions.shape[1] for part in parts)))
        column = 0
        for part in parts:
            end = column + part.directions.shape[1]
            weights[np.searchsorted(index, part.index), column:end] = part.directions
            column = end
        for alone, r in zip(own, rows, strict=True):
            _vanish_at_pivots(weights, index, alone, r, layout.start)
        pivots.append(index[_pivot_rows(weights * scale[index][:, None])])
    return NullSpace(own, shared, moves, np.concatenate(pivots) if pivots else np.zeros(0, dtype=np.int64))


def _vanish_at_pivots(
    weights: NDArray[np.float64],
    index: NDArray[np.int64],
    alone: OwnDirections,
    rows: NDArray[np.intp],
    start: NDArray[np.int64],
) -> None:
    """Add own directions to shared ones (d, k) so that these vanish where the own ones have their pivots."""
    place = np.searchsorted(index, start[alone.number])
    met = place < len(index)
    met[met] = index[place[met]] == start[alone.number[met]]
    if met.any():
        places = place[met][:, None] + np.arange(alone.directions.shape[1])
        own, at = alone.directions[met], rows[met][:, :, None]
        part = weights[places]
        share = np.linalg.solve(np.take_along_axis(own, at, axis=1), np.take_along_axis(part, at, axis=1))
        weights[places] = part - own @ share


@dataclass(frozen=True, slots=True)
class _Projector:
    """Takes their own unobservable directions out of vectors in scaled tangents: index (m, dof), normal (m, dof, k)."""

    index: NDArray[np.int64]
    normal: NDArray[np.float64]

    def apply(self, x: NDArray[np.float64]) -> None:
        part = x[self.index]
        x[self.index] = part - self.normal @ (np.swapaxes(self.normal, 1, 2) @ part)


def _own_directions(problem: LeastSquares, scale: NDArray[np.float64]) -> tuple[tuple[OwnDirections, ...], list[_Projector]]:
    layout = problem.layout
    found, projectors = [], []
    for block, number in zip(layout.blocks, layout.number, strict=True):
        free = number[number >= 0]
        if not len(free):
            continue
        dof = block.manifold.dof
        first = int(free[0])
        H = np.zeros((len(free), dof, dof))
        for group in problem.groups:
            _add_own_blocks(group, connected_numbers(layout, group), block, first, H)
        index = layout.start[free][:, None] + np.arange(dof)
        s = scale[index]
        curvature, vectors = np.linalg.eigh(H / (s[:, :, None] * s[:, None, :]))
        count = (curvature < _OWN_NULL).sum(axis=1)
        for k in np.unique(count[count > 0]):
            rows = np.flatnonzero(count == k)
            normal = vectors[rows, :, :k]
            found.append(OwnDirections(free[rows], normal / s[rows][:, :, None]))
            projectors.append(_Projector(index[rows], normal))
    return tuple(found), projectors


def _add_own_blocks(group: Group, numbers: list[NDArray[np.int64]], block: object, first: int, H: NDArray[np.float64]) -> None:
    """H of each variable of a block with itself, (n, dof, dof)."""
    for a, (connection_a, number_a) in enumerate(zip(group.connections, numbers, strict=True)):
        for b, (connection_b, number_b) in enumerate(zip(group.connections, numbers, strict=True)):
            if connection_a.block is not block or connection_b.block is not block:
                continue
            same = np.flatnonzero((number_a >= 0) & (number_a == number_b))
            for begin in range(0, len(same), _CHUNK):
                rows = same[begin : begin + _CHUNK]
                Ja, Jb = group.jacobians[a][rows], group.jacobians[b][rows]
                np.add.at(H, number_a[rows] - first, np.swapaxes(Ja, 1, 2) @ Jb)


def _shared_directions(
    problem: LeastSquares, scale: NDArray[np.float64], projectors: list[_Projector]
) -> tuple[SharedDirections, ...]:
    layout = problem.layout
    components = Components.of(layout, problem.groups)
    # A component of one variable has no direction but its own.
    members = np.bincount(components.label, minlength=components.count)
    active = np.flatnonzero(members > 1)
    if not len(active):
        return ()
    tangent_label = np.repeat(components.label, layout.sizes)
    for shift in _SHIFTS:
        try:
            problem.factorize(shift * scale * scale)
            break
        except NotPositiveDefinite:
            continue
    order = np.argsort(tangent_label, kind="stable")
    bounds = np.searchsorted(tangent_label[order], np.stack([active, active + 1]))
    index = [order[begin:end] for begin, end in bounds.T]
    search = _Search(problem, scale, projectors, components.label, active, index)
    if search.is_regular():
        return ()
    bases = search.run()
    shared = []
    for component, places, basis in zip(active, index, bases, strict=True):
        is_complete = basis.shape[1] < min(_SUBSPACE, len(places))
        variable = np.repeat(np.arange(len(layout.sizes)), layout.sizes)[places]
        for part in _separated(basis, variable) if basis.shape[1] else ():
            tangents = part / scale[places][:, None]
            # In the units of the tangents or in those of their noise, whichever shows more.
            reach = np.maximum(np.abs(tangents) / np.abs(tangents).max(axis=0), np.abs(part) / np.abs(part).max(axis=0))
            moved = np.unique(variable[reach.max(axis=1) > _MOVED])
            kept = np.isin(variable, moved)
            shared.append(SharedDirections(int(component), moved, places[kept], tangents[kept], scale[places][kept], is_complete))
    return tuple(shared)


@dataclass(frozen=True, slots=True)
class _Search:
    """Inverse iteration on all components at once, each with its own subspace, in scaled tangents."""

    problem: LeastSquares
    scale: NDArray[np.float64]
    projectors: list[_Projector]
    label: NDArray[np.int64]
    active: NDArray[np.int64]
    index: list[NDArray[np.int64]]

    def is_regular(self) -> bool:
        """Whether two directions after two rounds show already that there is nothing to find."""
        basis = self._begin(_FIRST_SUBSPACE)
        self._iterate(basis, _FIRST_ROUNDS)
        return all(not len(low) or low[0] > _SUSPICIOUS for _, low in self._lowest(basis))

    def run(self) -> list[NDArray[np.float64]]:
        """For every component its unobservable directions (d, k), orthonormal in scaled tangents."""
        basis = self._begin(_SUBSPACE)
        for rounds in (_FIRST_ROUNDS, _MORE_ROUNDS):
            self._iterate(basis, rounds)
            lowest = self._lowest(basis)
            # Curvatures between the two are small ones that more rounds tell from zero.
            if not any(((low > NULL) & (low < _CANDIDATE)).any() for _, low in lowest):
                break
        return [directions[:, low < NULL] for directions, low in lowest]

    def _begin(self, width: int) -> NDArray[np.float64]:
        basis = np.random.default_rng(0).standard_normal((len(self.scale), width))
        self._orthonormalize(basis)
        return basis

    def _iterate(self, basis: NDArray[np.float64], rounds: int) -> None:
        for _ in range(rounds):
            for k in range(basis.shape[1]):
                basis[:, k] = self.scale * self.problem.system.solve(self.scale * basis[:, k])
            self._orthonormalize(basis)

    def _lowest(self, basis: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """For every component the directions of low curvature in the span of the basis, and their curvatures, ascending."""
        candidates = basis.copy()
        ranks = [self._compress(candidates, places) for places in self.index]
        lowest: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        # Twice, as the first eigenvalues are only as exact as the largest of them allows.
        for bound in (_CANDIDATE, np.inf):
            grams = self._grams(candidates / self.scale[:, None])
            lowest = []
            for k, (gram, places) in enumerate(zip(grams, self.index, strict=True)):
                curvature, rotation = np.linalg.eigh(gram[: ranks[k], : ranks[k]])
                chosen = candidates[places][:, : ranks[k]] @ rotation[:, curvature < bound]
                ranks[k] = chosen.shape[1]
                candidates[places] = 0.0
                candidates[places, : ranks[k]] = chosen
                lowest.append((chosen, curvature[curvature < bound]))
        return lowest

    def _compress(self, basis: NDArray[np.float64], places: NDArray[np.int64]) -> int:
        """Make the columns of one component that have a length after all projections orthonormal; returns their number."""
        U, length, _ = np.linalg.svd(basis[places], full_matrices=False)
        rank = int((length > 0.5).sum())
        basis[places] = 0.0
        basis[places, :rank] = U[:, :rank]
        return rank

    def _orthonormalize(self, basis: NDArray[np.float64]) -> None:
        for projector in self.projectors:
            projector.apply(basis)
        inactive = np.ones(len(basis), dtype=np.bool_)
        for places in self.index:
            inactive[places] = False
            Q = np.linalg.qr(basis[places])[0]
            basis[places, : Q.shape[1]] = Q
            basis[places, Q.shape[1] :] = 0.0
        basis[inactive] = 0.0
        for projector in self.projectors:
            projector.apply(basis)

    def _grams(self, V: NDArray[np.float64]) -> NDArray[np.float64]:
        """(J V)ᵀ (J V) of every component, from J itself: H would have lost half of the digits."""
        layout = self.problem.layout
        width = V.shape[1]
        place = np.full(int(self.label.max()) + 1, -1)
        place[self.active] = np.arange(len(self.active))
        grams = np.zeros((len(self.active), width, width))
        for group in self.problem.groups:
            numbers = connected_numbers(layout, group)
            owner = np.max(numbers, axis=0)
            owner = np.where(owner >= 0, place[self.label[owner]], -1)
            for rows in _chunks(np.flatnonzero(owner >= 0)):
                product = np.zeros((len(rows), group.residual.dim, width))
                for number, J in zip(numbers, group.jacobians, strict=True):
                    free = number[rows] >= 0
                    at = layout.start[number[rows]][:, None] + np.arange(J.shape[2])
                    product[free] += J[rows[free]] @ V[at[free]]
                if len(self.active) == 1:
                    flat = product.reshape(-1, width)
                    grams[0] += flat.T @ flat
                else:
                    np.add.at(grams, owner[rows], np.swapaxes(product, 1, 2) @ product)
        return grams


def _chunks(rows: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    for begin in range(0, len(rows), _CHUNK):
        yield rows[begin : begin + _CHUNK]


def _separated(basis: NDArray[np.float64], variable: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """The same space as bases of motions that have no variable in common; `variable` (d,) is that of each tangent."""
    from scipy.sparse.csgraph import connected_components

    reduced = basis @ np.linalg.inv(basis[_pivot_rows(basis)])
    moves = np.abs(reduced) > _MOVED * np.abs(reduced).max(axis=0)
    moved = np.logical_or.reduceat(moves, np.flatnonzero(np.diff(variable, prepend=-1)), axis=0)
    _, label = connected_components(moved.T.astype(np.int64) @ moved.astype(np.int64) > 0, directed=False)
    return [reduced[:, label == k] for k in np.unique(label)]


def _pivot_rows(basis: NDArray[np.float64]) -> NDArray[np.intp]:
    """As many rows as columns that make a well-conditioned square matrix."""
    from scipy.linalg import qr

    _, order = qr(basis.T, mode="r", pivoting=True)
    return np.asarray(order[: basis.shape[1]], dtype=np.intp)


def _own_pivots(alone: OwnDirections) -> NDArray[np.intp]:
    """(m, k) tangents that tell the own directions of each variable apart."""
    if alone.directions.shape[2] == 1:
        return np.asarray(np.abs(alone.directions[:, :, 0]).argmax(axis=1)[:, None])
    return np.array([_pivot_rows(basis) for basis in alone.directions])
