"""Which poses make a pair, by their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.evaluation.rpe import Delta, pairs_by_distance, pairs_by_frames, pairs_by_time, pairs_by_turn, relative_errors
from tests.evaluation.smooth_paths import SmoothPath

T = np.arange(0.0, 28.0, 0.1)
COUNT = 30
deltas = st.floats(0.05, 8.0)


def chained(steps: np.ndarray, delta: float) -> list[list[int]]:
    """Each pair begins where the last ended, and ends at the first row with the delta travelled."""
    pairs, begin = [], 0
    for row in range(1, len(steps) + 1):
        if sum(steps[begin:row].tolist()) >= delta:
            pairs.append([begin, row])
            begin = row
    return pairs


@given(seed=st.integers(0, 1000), delta=deltas)
@settings(max_examples=60, deadline=None)
def test_pairs_by_distance_against_their_definition(seed: int, delta: float) -> None:
    rng = np.random.default_rng(seed)
    p = np.cumsum(rng.normal(size=(COUNT, 3)) * (rng.random((COUNT, 1)) < 0.8), axis=0)  # some poses stand still
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    nearest = [(i, min(range(COUNT), key=lambda j: (abs(path[j] - path[i] - delta), j))) for i in range(COUNT)]
    every = [[i, j] for i, j in nearest if abs(path[j] - path[i] - delta) <= 0.1 * delta]
    assert pairs_by_distance(p, delta, "all").tolist() == every
    assert pairs_by_distance(p, delta).tolist() == chained(steps, delta)


@given(seed=st.integers(0, 1000), delta=st.floats(0.05, 3.0))
@settings(max_examples=40, deadline=None)
def test_pairs_by_turn_against_their_definition(seed: int, delta: float) -> None:
    turns = Rotation.from_rotvec(np.cumsum(np.random.default_rng(seed).normal(scale=0.4, size=(COUNT, 3)), axis=0))
    angle = np.array([[(a.inv() * b).magnitude() for b in turns] for a in turns])
    every = [[i, j] for i in range(COUNT) for j in range(i + 1, COUNT) if abs(angle[i, j] - delta) <= 0.1 * delta]
    assert pairs_by_turn(turns.as_matrix(), delta, "all").tolist() == every
    assert pairs_by_turn(turns.as_matrix(), delta).tolist() == chained(angle[np.arange(COUNT - 1), np.arange(1, COUNT)], delta)


@given(count=st.integers(0, 30), delta=st.integers(1, 35))
def test_pairs_by_frames(count: int, delta: int) -> None:
    assert pairs_by_frames(count, delta, "all").tolist() == [[i, i + delta] for i in range(max(0, count - delta))]
    assert pairs_by_frames(count, delta).tolist() == [[i, i + delta] for i in range(0, count, delta) if i + delta < count]


def test_pairs_by_time_pass_over_gaps() -> None:
    t = np.concatenate([np.arange(0, 50), np.arange(80, 130)]) * 100_000_000  # 10 Hz, 3 s missing
    for mode in ("all", "consecutive"):
        pairs = pairs_by_time(t, 1.0, mode)
        np.testing.assert_array_equal(t[pairs[:, 1]] - t[pairs[:, 0]], 1_000_000_000)
    assert len(pairs_by_time(t, 1.0, "all")) == 80
    assert pairs_by_time(t, 1.0).tolist() == [[0, 10], [10, 20], [20, 30], [30, 40], [50, 60], [60, 70], [70, 80], [80, 90]]
    assert len(pairs_by_time(t, 60.0)) == 0


def test_errors_over_turns_and_frames_are_those_of_their_pairs() -> None:
    truth = SmoothPath(3).sample(T)
    estimate = SmoothPath(4).sample(T)
    for delta, rows in (
        (Delta(30.0, "deg"), pairs_by_turn(estimate.R, np.radians(30.0))),
        (Delta(7, "frames"), pairs_by_frames(280, 7)),
    ):
        errors = relative_errors(estimate, truth, delta)
        assert errors.pairs.tolist() == rows.tolist()
        motions = [poses.R[rows[:, 0]].transpose(0, 2, 1) @ poses.R[rows[:, 1]] for poses in (truth, estimate)]
        angles = np.degrees(Rotation.from_matrix(motions[0].transpose(0, 2, 1) @ motions[1]).magnitude())
        np.testing.assert_allclose(errors.rotation_deg, angles, atol=1e-6)
    own, other = (relative_errors(estimate, truth, Delta(2.0, "m"), path_of=whose) for whose in ("estimate", "ground_truth"))
    assert own.pairs.tolist() == pairs_by_distance(estimate.p, 2.0).tolist()
    assert other.pairs.tolist() == pairs_by_distance(truth.p, 2.0).tolist() != own.pairs.tolist()


def test_relative_errors_refuse_what_they_cannot_compute(monkeypatch: pytest.MonkeyPatch) -> None:
    path = SmoothPath(0).sample(T)
    for value, unit in ((-1.0, "m"), (0.0, "s"), (np.nan, "deg"), (1.5, "frames")):
        number = "whole number" if unit == "frames" else "number"
        with pytest.raises(InputError, match=rf'a positive {number} in Delta\(value, "{unit}"\) – got '):
            Delta(value, unit)
    with pytest.raises(InputError, match="matched trajectories of the same length"):
        relative_errors(path, path.select(np.arange(9)), Delta(1.0, "m"))
    with pytest.raises(InputError, match=r"poses 100 s apart – got a matched trajectory of 27\.900 s – use a smaller Delta\("):
        relative_errors(path, path, Delta(100.0, "s"))
    with pytest.raises(InputError, match=r"poses 280 frames apart – got a matched trajectory of 280 poses"):
        relative_errors(path, path, Delta(280, "frames"))
    monkeypatch.setattr("boxplus.evaluation.rpe._MOST_PAIRS", 100)
    with pytest.raises(InputError, match="at most 100 pairs of poses"):
        relative_errors(path, path, Delta(20.0, "deg"), pairs="all")
