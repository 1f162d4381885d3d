"""What speaks against a verdict on loop closures: witnesses refused together, odometry that does not fit, loose ends."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile, chi_square_sf
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.systems.pose_graph.bridges import Bridge
from boxplus.systems.pose_graph.consensus import Crossings
from boxplus.systems.pose_graph.doubts.arms import find_arms
from boxplus.systems.pose_graph.doubts.fit import pose_names
from boxplus.systems.pose_graph.doubts.refusals import refusals_doubt
from boxplus.systems.pose_graph.loops import LoopVerdict
from boxplus.systems.pose_graph.problem import odometry_order, with_edges
from boxplus.systems.pose_graph.start import components

_STRANGE = 1e-6  # chance of noise to bend sound odometry anywhere as far as that
_WIDTHS = (1, 3, 10, 30)  # steps that a slip is spread over
_ALONE = 0.1  # share of the poses that no kept loop closure checks, from which on that is told; of loop closures that are few
_WITNESSES = 3  # loop closures that agree with each other by more than chance
_OBJECTING = 2  # loop closures that may have been kept by chance, or bent; more of them confirm the odometry


def contradictions(graph: PoseGraph, verdict: LoopVerdict, bridges: list[Bridge]) -> tuple[list[str], list[str]]:
    """Sentences to note, and sentences for which the result is not to be trusted.

    Args:
        bridges: loop closures that were believed beforehand.
    """
    said = [bridge.sentence(graph) for bridge in bridges if bridge.is_contested]
    loops = np.count_nonzero(verdict.is_loop)
    refused = np.count_nonzero(verdict.is_loop & ~verdict.is_kept)
    if refused == loops and not bridges:
        said.append(
            f"all {loops} loop closures were refused, and the result is odometry alone: all are false, or the odometry claims "
            "more than it can"
        )
    elif refusals := refusals_doubt(graph, verdict):
        said.append(refusals)
    label, before = components(with_edges(graph, verdict.is_kept)), components(graph)
    if label.max(initial=0) > before.max(initial=0):
        alone = np.setdiff1d(np.unique(label, return_index=True)[1], np.unique(before, return_index=True)[1]).astype(np.int64)
        said.append(
            f"the edges that were kept leave {len(alone)} pieces tied to nothing, with poses {pose_names(graph, alone)}: where "
            "these lie is not known"
        )
    rank = odometry_order(graph)
    notes, contested = _unconfirmed(graph, verdict, rank)
    return notes, [*said, *(text for text in (_bent(graph, verdict, rank), _slip(graph, verdict, rank)) if text), *contested]


def _unconfirmed(graph: PoseGraph, verdict: LoopVerdict, rank: NDArray[np.int64]) -> tuple[list[str], list[str]]:
    """Notes and doubts on parts of the graph that hang on odometry alone, and of which refused loop closures speak."""
    arms = find_arms(graph, verdict.solution.values[0], verdict.is_kept, verdict.is_loop, rank)
    if not arms:
        return [], []
    refusals, loops = np.count_nonzero(~verdict.is_kept), np.count_nonzero(verdict.is_loop)
    if arms[0].is_contested:
        told = [
            f"{arms[0].agreeing} of {len(arms[0].refused)} refused loop closures agree with each other that the "
            f"{len(arms[0].poses)} poses that hang on {arms[0].name(graph, rank)} lie elsewhere, and none that was kept speaks "
            "of these: it slipped there, or these loop closures are false together"
        ]
        # Where there are others that no slip explains, false ones that agree are as likely.
        return ([], told) if refusals <= max(_ALONE * loops, 2 * arms[0].agreeing) else (told, [])
    alone = np.unique(np.concatenate([arm.poses for arm in arms]))
    refused = np.unique(np.concatenate([arm.refused for arm in arms]))
    share = len(alone) / len(graph.ids)
    # Where many are false, some are of any part.
    if not (share > _ALONE or refusals <= max(_ALONE * loops, _WITNESSES)):
        return [], []
    return [
        f"{share:.0%} of the odometry is confirmed by no loop closure that was kept ({len(alone)} poses, behind "
        f"{arms[0].name(graph, rank)}), refused ones that speak of it: {len(refused)}; whether it slipped there or these are "
        "false cannot be told"
    ], []


def _bent(graph: PoseGraph, verdict: LoopVerdict, rank: NDArray[np.int64]) -> str | None:
    """Where the loop closures that were kept bend the odometry, over one step or several, by more than its noise."""
    dim = graph.information.shape[1]
    steps = np.flatnonzero(~verdict.is_loop & (np.abs(np.diff(rank[graph.edges], axis=1))[:, 0] == 1))
    steps = steps[np.argsort(rank[graph.edges[steps]].min(axis=1), kind="stable")]
    squared = verdict.innovations[steps] ** 2
    if not len(steps):
        return None
    scale = max(float(np.median(squared)) / chi_square_quantile(0.5, dim), 1.0)
    total = np.concatenate([[0.0], np.cumsum(squared / scale)])
    best, told = _STRANGE / len(steps), None
    for width in (width for width in _WIDTHS if width <= len(steps)):
        sums = total[width:] - total[:-width]
        most = int(np.argmax(sums))
        chance = chi_square_sf(sums[most], width * dim)
        if chance < best:
            best = chance
            ends = graph.edges[steps[most : most + width]]
            first, last = (graph.ids[ends.reshape(-1)[k(rank[ends].reshape(-1))]] for k in (np.argmin, np.argmax))
            told = (
                f"the odometry from pose {first} to pose {last} is off by {math.sqrt(sums[most] * scale / width):.3g} standard "
                "deviations a step, as the loop closures that were kept demand: it slipped there, or false ones were kept"
            )
    return told


def _slip(graph: PoseGraph, verdict: LoopVerdict, rank: NDArray[np.int64]) -> str | None:
    """Where refused loop closures agree that all after some step of odometry lies elsewhere, and hardly any kept one objects."""
    refused = np.flatnonzero(verdict.is_loop & ~verdict.is_kept)
    if len(refused) < _WITNESSES:
        return None
    n = len(graph.ids)
    i, j = rank[graph.edges].T
    crossings = Crossings.of(graph, verdict.solution.values[0], refused, i[refused] > j[refused], rank, ~verdict.is_loop)
    low, high = np.minimum(i, j), np.maximum(i, j)
    kept = verdict.is_loop & verdict.is_kept
    confirmed = _spanned(low[kept], high[kept], n)
    best, told = 0, None
    for one in crossings.tried:
        witnesses = refused[crossings.agreeing(int(one))[1]]
        if len(witnesses) <= max(best, _WITNESSES - 1):
            continue
        spanned = _spanned(low[witnesses], high[witnesses], n)
        most = int(spanned.max())
        steps = np.flatnonzero(spanned == most)
        objecting = int(confirmed[steps].min())
        if most >= _WITNESSES and most > 2 * (objecting + 1) and objecting <= _OBJECTING and most > best:
            at = np.flatnonzero(confirmed[steps] == objecting)
            order = np.argsort(rank)
            first, last = (graph.ids[order[k]] for k in (steps[at[0]], steps[at[-1]] + 1))
            best = most
            told = (
                f"{most} refused loop closures agree with each other that odometry from pose {first} to pose {last} is wrong, "
                f"and {objecting} of those kept span it: it slipped there, or these are false together; if it slipped, give that "
                "edge less information"
            )
    return told


def _spanned(low: NDArray[np.int64], high: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """(n,) how many of the loop closures from `low` to `high` span the step from every place to the next."""
    change = np.bincount(low, minlength=n + 1) - np.bincount(high, minlength=n + 1)
    return np.asarray(np.cumsum(change)[:n])
