"""What a run says of the loops that its user decided on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.runs.slam.graph_file import read_graph, write_graph
from boxplus.runs.slam.loop_file import objections_to_forced
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.outcome import SlamOutcome

HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
FORCED = Loop(12, 1, "forced", 0, HERE, HERE, np.eye(6), np.eye(6), measured=6, weight=1.0)


def test_what_speaks_against_a_forced_loop_is_said() -> None:
    against = replace(FORCED, objection="the maps overlap too little: 36 % and 32 % of their points, 50 % asked for")
    nowhere = replace(FORCED, query=9, place=4, refusal="too few points of one map lie on planes of the other", weight=0.0)
    found = replace(FORCED, source="appearance")
    assert objections_to_forced([FORCED, against, nowhere, found]) == [
        "the forced loop [12, 1] is closed, although the maps overlap too little: 36 % and 32 % of their points, 50 % asked for; "
        "look in the report how the two lie over each other",
        "the forced loop [9, 4] is not closed: too few points of one map lie on planes of the other",
    ]


@pytest.mark.parametrize("objection", [None, "4.9 standard deviations from the odometry; true loops stay below 4.7"])
def test_it_is_kept_with_the_graph(tmp_path: Path, objection: str | None) -> None:
    none = Correction(np.zeros(0, dtype=np.int64), np.zeros((0, 7)), np.zeros((0, 7)))
    path = tmp_path / "graph.npz"
    write_graph(path, SlamOutcome(none, [replace(FORCED, objection=objection)], None))
    (loop,) = read_graph(path).loops
    assert loop.objection == objection and loop.refusal is None and loop.is_accepted
