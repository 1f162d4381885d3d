"""`--gt` at the end of a run, where positions determine the alignment and where they do not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from boxplus.cli.ground_truth import compare_with
from boxplus.formats.trajectory import Trajectory, write_tum
from boxplus.manifolds import quaternion, so3


def _drive(bend: float, turn: float = 0.0) -> Trajectory:
    """Eighty metres ahead, in a world turned about the vertical."""
    s = np.arange(0.0, 80.0, 0.8)
    p = np.stack([s, bend * np.sin(s / 20.0), 0.5 * bend * np.cos(s / 15.0)], axis=1)
    R = so3.exp(np.array([0.0, 0.0, turn]))
    q = np.tile(quaternion.from_matrix(R[None])[0], (len(s), 1))
    return Trajectory(np.rint(1e8 * np.arange(len(s))).astype(np.int64) + 10**15, p @ R.T, q)


@pytest.mark.parametrize(("bend", "kind"), [(5.0, "se3"), (0.0, "origin")])
def test_a_straight_drive_is_compared_from_its_first_pose(tmp_path: Path, bend: float, kind: str) -> None:
    truth, estimate = _drive(bend, turn=0.7), _drive(bend)
    estimate.p[:, 0] *= 1.001
    write_tum(tmp_path / "estimate.tum", estimate)
    found = compare_with(truth, tmp_path / "estimate.tum", tmp_path / "evaluation.json", "se3")
    assert found.error is None and found.evaluation is not None
    assert json.loads((tmp_path / "evaluation.json").read_text()) == found.evaluation
    assert found.evaluation["alignment"]["kind"] == kind
    assert found.evaluation["ate_translation_m"]["max"] == pytest.approx(0.08 if kind == "origin" else 0.04, rel=0.1)
    assert any("rotation about that line is undetermined" in text for text in found.evaluation["warnings"]) == (kind == "origin")
