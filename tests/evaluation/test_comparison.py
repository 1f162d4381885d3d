"""Several estimates in one table."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from boxplus.evaluation.comparison import compare, short_names
from boxplus.evaluation.comparison_plots import write_comparison_plots
from boxplus.evaluation.evaluation import evaluate
from boxplus.evaluation.rpe import Delta
from boxplus.formats.trajectory import Trajectory
from tests.evaluation.smooth_paths import SmoothPath, disturbed

T = np.arange(0.0, 20.0, 0.1)


def test_every_line_is_the_estimate_alone(tmp_path: Path) -> None:
    truth = SmoothPath(1).sample(T)
    estimates = {"good": disturbed(truth, 1), "brief": disturbed(truth, 2).select(np.arange(15))}
    one = functools.partial(evaluate, ground_truth=truth, deltas=[Delta(1.0, "m"), Delta(3.0, "s")])
    result = compare(
        {**estimates, "elsewhere": Trajectory(truth.times + 10**12, truth.p, truth.q_wxyz)}, one, {"lost": "no file"}
    )
    assert list(result.evaluations) == ["good", "brief"]
    assert list(result.refused) == ["lost", "elsewhere"]
    head, good, brief = result.table().splitlines()
    alone = one(estimates["good"])
    relative = [figure for errors in alone.relative for figure in (errors.translation.rmse, errors.rotation.rmse)]
    expected = [alone.ate.rmse, alone.ate.mean, alone.ate.median, alone.ate.max, alone.ate_rotation.rmse, *relative]
    assert good.split() == ["good", "200", *(f"{figure:.6f}" for figure in expected)]
    assert brief.split()[-2:] == ["–", "–"]  # 1.4 s long
    assert len(head) == len(good) == len(brief)
    text = result.summary()
    assert "elsewhere: not compared, expected two trajectories that overlap in time" in text
    assert "brief (0.0 to 1.4 s); a shorter one may look better" in text
    assert "some estimates have less than half the matches of others" in text
    paths = write_comparison_plots(result, tmp_path, truth)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_like_estimates_raise_no_doubt_about_the_table() -> None:
    truth = SmoothPath(1).sample(T)
    result = compare(
        {name: disturbed(truth, seed) for seed, name in enumerate("abc")}, functools.partial(evaluate, ground_truth=truth)
    )
    assert result.warnings == ()
    assert compare({}, functools.partial(evaluate, ground_truth=truth)).summary() == ""


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["out/a.tum", "out/b.csv"], ["a", "b"]),
        (["one/trajectory.tum", "two/trajectory.tum"], ["one/trajectory", "two/trajectory"]),
        (["x/a.tum", "x/a.csv"], ["a.tum", "a.csv"]),
        (["one", "two"], ["one", "two"]),
    ],
)
def test_names_are_short_and_differ(paths: list[str], names: list[str]) -> None:
    assert short_names([Path(path) for path in paths]) == names
