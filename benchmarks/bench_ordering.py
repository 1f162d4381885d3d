"""Elimination orders: METIS' nested dissection and ours, the operations of a factorisation and the time to find the order.

    python benchmarks/bench_ordering.py [--only cube disc] [--rounds 5]

Graphs: a cube of grid points, points in a disc and in a ball joined to their nearest neighbours, a walk over a Manhattan grid
that comes back to where it was, each with 6 scalars a node and generated from a seed, and those of --graphs. "Operations" is the
sum of the squares of the factor's column lengths, counted exactly. METIS is timed by processor time with its default settings;
ours as `order` calls it: minimum degree first, nested dissection where that pays. Without pymetis there is nothing to compare
with.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, tril
from scipy.spatial import cKDTree

from boxplus.formats.graphs.g2o import read_g2o
from boxplus.sparse.orderings.ordering import order

Edges = NDArray[np.int64]
SIZE = 6


def cube(side: int) -> tuple[int, Edges]:
    """Points of a grid, joined along its axes."""
    node = np.arange(side**3).reshape(side, side, side)
    pairs = [np.stack([np.moveaxis(node, a, 0)[1:].ravel(), np.moveaxis(node, a, 0)[:-1].ravel()], axis=1) for a in range(3)]
    return node.size, np.concatenate(pairs)


def nearest(count: int, neighbours: int, dimensions: int, seed: int) -> tuple[int, Edges]:
    """Points at random, joined to the nearest ones."""
    points = np.random.default_rng(seed).random((count, dimensions))
    found = cKDTree(points).query(points, neighbours + 1)[1]
    return count, np.stack([np.repeat(np.arange(count), neighbours), found[:, 1:].ravel()], axis=1)


def walk(count: int, seed: int) -> tuple[int, Edges]:
    """A walk over a grid; half of the times that it comes to a crossing again it is joined to a visit before."""
    random = np.random.default_rng(seed)
    steps, half = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]), int(count**0.5 / 3)
    at, heading, visits, edges = np.zeros(2, int), 0, {(0, 0): [0]}, []
    for k in range(1, count):
        heading = (heading + random.choice([1, 3])) % 4 if random.random() < 0.15 else heading
        while np.abs(at + steps[heading]).max() > half:
            heading = int(random.integers(4))
        at = at + steps[heading]
        edges.append((k - 1, k))
        before = visits.setdefault((int(at[0]), int(at[1])), [])
        edges += [(k, j) for j in before[-3:] if random.random() < 0.5]
        before.append(k)
    return count, np.array(edges)


def of_file(path: Path) -> tuple[int, Edges]:
    """The graph of a g2o file."""
    graph = read_g2o(path)
    return len(graph.ids), graph.edges


def pattern(count: int, edges: Edges) -> csc_matrix:
    """All entries of the symmetric matrix, diagonal included."""
    i, j = np.concatenate([edges, edges[:, ::-1], np.repeat(np.arange(count)[:, None], 2, axis=1)]).T
    matrix = csc_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    matrix.sum_duplicates()
    return matrix


def least_ms(run: Callable[[], object], rounds: int) -> float:
    """Least processor time."""
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        run()
        times.append(1e3 * (time.process_time() - begin))
    return min(times)


def measure(options: argparse.Namespace) -> list[Metric]:
    """The figures of every graph."""
    try:
        import pymetis
    except ImportError:
        print("nothing to compare with: pymetis is not installed", file=sys.stderr)
        return []
    cases: dict[str, Callable[[], tuple[int, Edges]]] = {
        "cube": lambda: cube(options.cube),
        "disc": lambda: nearest(options.points, 5, 2, 11),
        "ball": lambda: nearest(options.points, 6, 3, 11),
        "walk": lambda: walk(options.points, 11),
    }
    for name in ("torus3D", "sphere2500", "cubicle"):
        if (options.graphs / f"{name}.g2o").is_file():
            cases[name] = lambda name=name: of_file(options.graphs / f"{name}.g2o")
    metrics = []
    for name in options.only or cases:
        count, edges = cases[name]()
        matrix, sizes = pattern(count, edges), np.full(count, SIZE)
        lower = tril(matrix, format="csc")
        off = matrix - csc_matrix((np.ones(count), (np.arange(count),) * 2))
        off.eliminate_zeros()
        adjacency = pymetis.CSRAdjacency(off.indptr.astype(np.int32), off.indices.astype(np.int32))

        def metis(adjacency: object = adjacency) -> NDArray[np.int64]:
            return np.array(pymetis.nested_dissection(adjacency)[0], np.int64)

        theirs = metis()
        renamed = tril(matrix[theirs][:, theirs], format="csc")
        flops = order(renamed.indptr, renamed.indices, sizes, "natural").flops
        ours = order(lower.indptr, lower.indices, sizes)
        times = [least_ms(lambda: order(lower.indptr, lower.indices, sizes), options.rounds), least_ms(metis, options.rounds)]  # noqa: B023
        metrics += [
            Metric(f"ordering/{name}: operations", ours.flops, "", "lower", 1.05, "METIS", flops),
            Metric(f"ordering/{name}: time", times[0], "ms", "lower", None, "METIS", times[1]),
        ]
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    shared = Path(__file__).resolve().parents[2] / "shared" / "data" / "graphs"
    parser.add_argument("--graphs", type=Path, default=shared, help="folder of g2o files")
    parser.add_argument("--only", nargs="*", help="cube disc ball walk torus3D sphere2500 cubicle")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cube", type=int, default=20, help="points along an edge")
    parser.add_argument("--points", type=int, default=8000)


if __name__ == "__main__":
    run_as_script(__doc__ or "", measure, _arguments)
