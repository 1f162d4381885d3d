"""Collects the lines of a pose graph file, chunk by chunk and in any order, and puts the graph together at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from boxplus._words import either
from boxplus.errors import InputError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.numbers.lines import NumberLines
from boxplus.formats.numbers.parser import UNKNOWN_TAG

_Scalar = TypeVar("_Scalar", np.int64, np.float64)


class GraphBuilder:
    """Poses, edges and fixed poses as they come, named by the file's ids, with the lines they stand in.

    Args:
        source: the file.
        known: the words that may begin a line, as the file format has them.
        ignore_unknown: leave out lines that begin with another word, and count them in the graph's warnings.
    """

    def __init__(self, source: Path, known: tuple[str, ...], ignore_unknown: bool) -> None:
        self._source = source
        self._known = known
        self._ignore_unknown = ignore_unknown
        self._unknown: dict[str, tuple[int, int]] = {}  # word: how often, first line
        self._dimensions: dict[int, int] = {}  # dimension: first line
        self._poses: list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]] = []
        self._edge_ids: list[NDArray[np.int64]] = []
        self._measurements: list[NDArray[np.float64]] = []
        self._information: list[NDArray[np.float64]] = []
        self._edge_lines: list[NDArray[np.int64]] = []
        self._fixed: list[tuple[int, int]] = []  # id, line

    def add_poses(self, dimension: int, ids: NDArray[np.int64], poses: NDArray[np.float64], lines: NDArray[np.int64]) -> None:
        """Poses in the layout of `PoseGraph`."""
        self._dimensions.setdefault(dimension, int(lines[0]))
        self._poses.append((ids, poses, lines))

    def add_edges(
        self,
        dimension: int,
        ids: NDArray[np.int64],
        measurements: NDArray[np.float64],
        information: NDArray[np.float64],
        lines: NDArray[np.int64],
    ) -> None:
        """(k, 2) ids, measurements in the layout of `PoseGraph`, information in the order of the file."""
        self._dimensions.setdefault(dimension, int(lines[0]))
        self._edge_ids.append(ids)
        self._measurements.append(measurements)
        self._information.append(information)
        self._edge_lines.append(lines)

    def add_fixed(self, name: int, line: int) -> None:
        """The id of a pose that is held fixed."""
        self._fixed.append((name, line))

    def note_unknown(self, chunk: NumberLines) -> None:
        """Count the lines of a chunk that begin with an unknown word, or refuse the first.

        Raises:
            InputError: there is one, and unknown words are not to be ignored.
        """
        for row in np.flatnonzero(chunk.tag == UNKNOWN_TAG):
            if not self._ignore_unknown:
                chunk.fail(
                    int(row),
                    "a line that begins with " + ", ".join(self._known[:-1]) + f" or {self._known[-1]}",
                    "check that it is a pose graph; ignore_unknown leaves other lines out and counts them",
                )
            word = chunk.line(int(row)).split()[0]
            times, first = self._unknown.get(word, (0, int(chunk.number[row])))
            self._unknown[word] = (times + 1, first)

    def dimension(self) -> Literal[2, 3]:
        """2 or 3.

        Raises:
            InputError: the file has lines of both, or none.
        """
        if len(self._dimensions) == 2:
            raise InputError(
                "a pose graph in 2D or in 3D",
                f"both ({self._source}, 2D first in line {self._dimensions[2]}, 3D first in line {self._dimensions[3]})",
                "split the file",
            )
        if not self._edge_ids:
            raise InputError("a pose graph with at least one edge", f"none ({self._source})", "check that the file is complete")
        return 3 if 3 in self._dimensions else 2

    def edges(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Ids, measurements, information and lines of all edges, in the order of the file; to be called once."""
        return _take(self._edge_ids), _take(self._measurements), _take(self._information), _take(self._edge_lines)

    def build(
        self,
        dimension: Literal[2, 3],
        edges: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]],
        warnings: tuple[str, ...],
    ) -> PoseGraph:
        """The graph, from edges with their information in the order of the tangent.

        Raises:
            InputError: an edge or a FIX names a pose that the file does not have, or as `PoseGraph`.
        """
        names, measurements, information, lines = edges
        poses: NDArray[np.float64] | None = None
        pose_lines: NDArray[np.int64] | None = None
        if self._poses:
            ids, poses, pose_lines = (np.concatenate(part) for part in zip(*self._poses, strict=True))
        else:
            ids = np.unique(names)
        order = np.argsort(ids, kind="stable")
        index, known = _lookup(ids, order, names.reshape(-1))
        if not known.all():
            missing = int(np.argmin(known))
            raise InputError(
                "edges between poses that the file has",
                f"pose {names.reshape(-1)[missing]} ({self._source}, line {lines[missing // 2]}; {int((~known).sum())} such)",
                "add its line, or remove the edge",
            )
        fixed, known = _lookup(ids, order, np.array([name for name, _ in self._fixed], np.int64))
        if not known.all():
            name, line = self._fixed[int(np.argmin(known))]
            raise InputError(
                "fixed poses that the file has", f"pose {name} ({self._source}, line {line})", "add its line, or remove this one"
            )
        left_out = tuple(
            f"{times} {either(times, f'line {word} was', f'lines {word} were')} left out (first: {self._source}, line {first})"
            for word, (times, first) in self._unknown.items()
        )
        return PoseGraph(
            dimension=dimension,
            ids=ids,
            poses=poses,
            edges=index.reshape(-1, 2),
            measurements=measurements,
            information=information,
            fixed=np.unique(fixed),
            source=str(self._source),
            warnings=warnings + left_out,
            pose_lines=pose_lines,
            edge_lines=lines,
        )


def _take(parts: list[NDArray[_Scalar]]) -> NDArray[_Scalar]:
    """The parts in one array; they are given up, as a large file has no room for both."""
    joined = np.concatenate(parts)
    parts.clear()
    return joined


def _lookup(
    ids: NDArray[np.int64], order: NDArray[np.intp], names: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Where each name stands in `ids`, whose sorting order is given, and whether it does."""
    if not len(ids):
        return np.zeros(len(names), np.int64), np.zeros(len(names), np.bool_)
    place = np.minimum(np.searchsorted(ids, names, sorter=order), len(ids) - 1)
    index = order[place]
    return index.astype(np.int64), ids[index] == names
