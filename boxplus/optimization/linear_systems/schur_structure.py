"""What a Schur elimination is made of: entries (pairs of a kept and an eliminated variable) and the blocks of S they add to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.normal_equations import Gather
from boxplus.optimization.linear_systems.schur_kernels import count_pairs, list_pairs, number_entries
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.variables import Variables
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.counting_sort import gather_by, order_by


@dataclass(frozen=True, slots=True)
class Entries:
    """The entries of those kept variables that have the same degrees of freedom, kept variable by kept variable.

    Attributes:
        dof: of the kept variables.
        start: (n_f,) where each of the kept variables begins in their tangent vector.
        begin: (n_f + 1,) where the entries of each begin.
        kept, eliminated: (m,) the two variables of each entry; the kept one by its number in the layout without E.
        Z: (m, e, dof), Zᵀ = L⁻¹ Wᵀ.
        of_eliminated, order: (n_e + 1,), (m,): E variable p has the entries order[of_eliminated[p]:of_eliminated[p + 1]].
        start_of_entry: (m,) where the kept variable of each entry begins.
        gathers: the residuals that add to W, by where the entry begins in Z.
    """

    dof: int
    start: NDArray[np.int64]
    begin: NDArray[np.int64]
    kept: NDArray[np.int64]
    eliminated: NDArray[np.uint32]
    Z: NDArray[np.float64]
    of_eliminated: NDArray[np.int64]
    order: NDArray[np.uint32]
    start_of_entry: NDArray[np.int64]
    gathers: tuple[Gather, ...]


@dataclass(frozen=True, slots=True)
class Products:
    """Pairs of entries of one eliminated variable, sorted by the block of S they subtract Zₐ Z_bᵀ from.

    Attributes:
        a, b: the entries of the rows and of the columns.
        target: (k,) where each block begins among the values of S.
        begin: (k + 1,) where its pairs begin in `entry_a` and `entry_b`.
    """

    a: Entries
    b: Entries
    target: NDArray[np.int64]
    begin: NDArray[np.int64]
    entry_a: NDArray[np.uint32]
    entry_b: NDArray[np.uint32]


def eliminated_numbers(layout: Layout, eliminated: Variables, group: Group) -> tuple[int, NDArray[np.int64]] | None:
    """The connection of a group to the eliminated block, and the E variables there (−1 where fixed); None without one."""
    slots = [slot for slot, c in enumerate(group.connections) if c.block is eliminated]
    if not slots:
        return None
    number = layout.numbers(group.connections[slots[0]])
    own = layout.number[eliminated.number]
    return slots[0], np.where(number >= 0, number - int(own[own >= 0][0]), -1)


def build_entries(
    layout: Layout,
    rest: Layout,
    groups: Sequence[Group],
    connected: Sequence[Sequence[NDArray[np.int64]]],
    eliminated: Variables,
    count: int,
) -> list[Entries]:
    """The entries of `count` eliminated variables, one `Entries` for each size of kept variables.

    Args:
        rest: the layout of the kept ones; `connected`: for every group the numbers of its variables in that.
    """
    parts: list[tuple[Group, int, int, NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]] = []
    for group, numbers in zip(groups, connected, strict=True):
        found = eliminated_numbers(layout, eliminated, group)
        if found is None:
            continue
        slot, e_number = found
        for other, f_number in enumerate(numbers):
            selected = np.flatnonzero((f_number >= 0) & (e_number >= 0))
            if len(selected):
                parts.append((group, slot, other, selected, f_number[selected], e_number[selected]))
    entries = []
    for dof in np.unique(rest.sizes):
        own = [part for part in parts if part[0].connections[part[2]].block.manifold.dof == dof]
        if own:
            entries.append(_entries_of(int(dof), rest, own, count, eliminated.manifold.dof))
    return entries


def _entries_of(
    dof: int,
    rest: Layout,
    parts: list[tuple[Group, int, int, NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]],
    count: int,
    e: int,
) -> Entries:
    f_all, p_all = np.concatenate([f for *_, f, _ in parts]), np.concatenate([p for *_, p in parts])
    entry, kept, of = (np.empty(len(f_all), dtype=np.int64) for _ in range(3))
    variables, begin = np.empty(len(rest.sizes), dtype=np.int64), np.empty(len(rest.sizes) + 1, dtype=np.int64)
    by_e, by_f = np.zeros(count + 1, dtype=np.int64), np.zeros(len(rest.sizes) + 1, dtype=np.int64)
    entries, met = number_entries(f_all, p_all, by_e, by_f, entry, kept, of, variables, begin)
    kept, of, variables, begin = kept[:entries], of[:entries], variables[:met], begin[: met + 1]
    order, of_eliminated = order_by(of, count)
    gathers = []
    place, end = np.arange(len(kept)) * (e * dof), 0
    for group, slot, other, selected, *_ in parts:
        end += len(selected)
        gathers.append(Gather.sorted_by(group, slot, other, entry[end - len(selected) : end], place, selected))
    return Entries(
        dof=dof,
        start=rest.start[variables],
        begin=begin,
        kept=kept,
        eliminated=of.astype(np.uint32),
        Z=np.zeros((len(kept), e, dof)),
        of_eliminated=of_eliminated,
        order=order,
        start_of_entry=rest.start[kept],
        gathers=tuple(gathers),
    )


def build_products(
    rest: Layout, kept_pattern: BlockPattern, entries: list[Entries], count: int
) -> tuple[BlockPattern, NDArray[np.int64], list[Products]]:
    """The pattern of S, where the values of `kept_pattern` lie in it, and the products that are subtracted."""
    kept = np.concatenate([k.kept for k in entries]) if entries else np.zeros(0, dtype=np.int64)
    of = np.concatenate([k.eliminated for k in entries]).astype(np.int64) if entries else kept
    first = np.cumsum([0, *(len(k.kept) for k in entries)])
    by_kept = order_by(kept, len(rest.sizes))[0]
    by_eliminated, begin = order_by(of[by_kept], count)
    order = by_kept[by_eliminated].astype(np.int64)
    a = np.empty(count_pairs(begin), dtype=np.uint32)
    b = np.empty_like(a)
    list_pairs(begin, order, a, b)
    column = np.repeat(np.arange(len(kept_pattern.sizes)), np.diff(kept_pattern.col_start))
    pattern, pairs = BlockPattern.from_pairs(
        rest.sizes, np.concatenate([kept_pattern.row, kept[a]]), np.concatenate([column, kept[b]])
    )
    own, pair_block = pairs.block[: len(column)], pairs.block[len(column) :]
    length = np.diff(kept_pattern.value_start)
    within = np.arange(int(kept_pattern.value_start[-1])) - np.repeat(kept_pattern.value_start[:-1], length)
    places = np.repeat(pattern.value_start[own], length) + within
    products = []
    every = np.arange(len(a))
    for i, rows in enumerate(entries):
        for j, columns in enumerate(entries):
            chosen = every if len(entries) == 1 else np.flatnonzero(_within(a, first, i) & _within(b, first, j))
            if not len(chosen):
                continue
            blocks, start, ordered = gather_by(pair_block[chosen], len(pattern.row), chosen)
            entry_a, entry_b = a[ordered] - np.uint32(first[i]), b[ordered] - np.uint32(first[j])
            products.append(Products(rows, columns, pattern.value_start[blocks], start, entry_a, entry_b))
    return pattern, places, products


def _within(entry: NDArray[np.uint32], first: NDArray[np.int64], kind: int) -> NDArray[np.bool_]:
    """Which entries, counted over all kinds, are of one."""
    return np.asarray((entry >= first[kind]) & (entry < first[kind + 1]))
