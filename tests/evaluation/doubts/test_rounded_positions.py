"""Positions that were written with too few digits are told of, and coarse ones that are not the error are not."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.evaluation.evaluation import evaluate
from tests.evaluation.doubts.test_other_meanings import moved, path, told


def six_digits(p: np.ndarray) -> np.ndarray:
    return np.array([[float(f"{value:.6g}") for value in row] for row in p])


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_positions_of_a_map_projection_with_six_digits_are_told(seed: int) -> None:
    estimate = path(seed, 0.05)
    p = six_digits(estimate.p + np.array([450_000.0, 5_400_000.0, 300.0]))
    assert "all positions of the estimate are multiples, x of 1 m, y of 10 m, z of 0.001 m: if they were rounded" in told(
        moved(estimate, p)
    )


@pytest.mark.parametrize("seed", [1, 3, 5])
@pytest.mark.parametrize("unit", [0.01, 0.1, 1.0])
def test_which_file_was_rounded_is_told_where_it_matters(seed: int, unit: float) -> None:
    estimate, truth = path(seed, 0.05), path()
    for name in ("estimate", "ground truth"):
        files = {"estimate": estimate, "ground truth": truth}
        files[name] = moved(files[name], unit * np.round(files[name].p / unit))
        said = " // ".join(evaluate(files["estimate"], files["ground truth"], alignment="none").warnings)
        assert (f"all positions of the {name} are multiples" in said) == (unit > 0.01)


@pytest.mark.parametrize("noise_m", [0.01, 0.1, 2.0])
def test_a_path_that_goes_by_whole_metres_was_not_rounded(noise_m: float) -> None:
    """What errs by less than rounding makes was not, and what errs by far more does for another reason."""
    truth = path()
    truth = moved(truth, np.round(truth.p))
    estimate = moved(truth, truth.p + noise_m * np.random.default_rng(3).normal(size=truth.p.shape))
    assert evaluate(estimate, truth, alignment="none").warnings == ()


def test_even_speed_along_one_axis_was_not_rounded() -> None:
    truth = path()
    p = truth.p.copy()
    p[:, 0] = np.arange(len(p))
    truth = moved(truth, p)
    estimate = moved(truth, p + 0.3 * np.random.default_rng(3).normal(size=p.shape))
    assert evaluate(estimate, truth, alignment="none").warnings == ()


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_a_square_at_even_speed_was_not_rounded(seed: int) -> None:
    """A decimetre between two poses, and an estimate that errs by about as much as rounding to that would."""
    side = 0.1 * np.arange(150)
    ends = [(side, 0.0 * side), (0.0 * side + 15.0, side), (15.0 - side, 0.0 * side + 15.0), (0.0 * side, 15.0 - side)]
    x, y = np.concatenate(ends, axis=1)
    truth = moved(path(), np.round(np.stack([x, y, 0.0 * x], axis=1), 3))
    estimate = moved(truth, truth.p + 0.04 * np.random.default_rng(seed).normal(size=truth.p.shape))
    assert evaluate(estimate, truth, alignment="none").warnings == ()


@pytest.mark.parametrize("speed", [0.004, 0.03, 0.11])
def test_positions_of_a_slow_walk_that_were_rounded_are_told(speed: float) -> None:
    """Most steps of the file are none at all."""
    angle = np.linspace(0.0, 5.0, 600)
    size = speed * 600 / 5.0
    truth = moved(path(), size * np.stack([np.sin(angle), np.cos(angle), 0.0 * angle], axis=1))
    estimate = moved(truth, np.round(truth.p, 1))
    said = " // ".join(evaluate(estimate, truth, alignment="none").warnings)
    assert "all positions of the estimate are multiples, x of 0.1 m, y of 0.1 m" in said
