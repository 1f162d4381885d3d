"""Clocks of different rates are told apart from clocks with an offset, with a deviation that holds; and from drift."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory
from tests.evaluation.smooth_paths import SmoothPath, disturbed


def pair(seed: int, rate: float, offset_s: float = 0.0, duration_s: float = 60.0) -> tuple[Trajectory, Trajectory]:
    """An estimate whose stamps lack `offset_s` in the middle and `rate` of every second, and the ground truth."""
    path = SmoothPath(seed, duration_s)
    truth = path.sample(np.arange(0.0, duration_s, 0.01))
    estimate = disturbed(path.sample(np.arange(0.5, duration_s - 0.5, 0.1)), seed, 0.01, 0.003)
    middle = int(truth.time_ns[len(truth) // 2])
    late = np.round((estimate.time_ns - middle - offset_s * 1e9) / (1.0 + rate)).astype(np.int64)
    return replace(estimate, time_ns=middle + late), truth


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rate", "offset_s"), [(1e-3, 0.0), (-5e-3, 0.3), (2e-3, -0.1)])
def test_rate_and_offset_are_found_together(seed: int, rate: float, offset_s: float) -> None:
    result = evaluate(*pair(seed, rate, offset_s))
    found = result.association.time_offset.rate
    assert found.shows and abs(found.rate - rate) < 4.0 * found.deviation < 2e-4
    middle = np.abs(found.offset_s - offset_s - rate * (found.middle_ns - pair(seed, 0.0)[1].time_ns[3000]) * 1e-9)
    assert middle < 4.0 * found.offset_deviation_s + 2e-3
    (warning,) = (text for text in result.warnings if "clock" in text)
    assert warning.startswith("the clocks do not run at the same rate: the estimate's clock ")
    assert ("loses" if rate > 0 else "gains") in warning and "with a constant offset" in warning
    assert any(line.startswith("clock rate: the estimate's clock") for line in result.summary().splitlines())
    assert json.loads(json.dumps(result.to_dict()))["association"]["time_offset"]["rate"]["rate"] == found.rate
    estimate, truth = pair(seed, rate, offset_s)
    mended = evaluate(replace(estimate, time_ns=found.corrected(estimate.time_ns)), truth)
    assert f"the ATE is {mended.ate.rmse:.4g} m" in warning and mended.ate.rmse < 0.03


@pytest.mark.parametrize("seed", range(4, 12))
def test_clocks_of_one_rate_are_not_doubted(seed: int) -> None:
    for offset_s in (0.0, 0.2):
        result = evaluate(*pair(seed, 0.0, offset_s))
        assert not result.association.time_offset.rate.shows
        assert not any("same rate" in text for text in result.warnings)


def circle(t: np.ndarray) -> Trajectory:
    """Five metres about the origin, half a radian a second."""
    angle = 0.5 * t
    p = 5.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(t)], axis=1)
    q = np.stack([np.cos(0.5 * angle), np.zeros_like(t), np.zeros_like(t), np.sin(0.5 * angle)], axis=1)
    return Trajectory(np.round((10.0 + t) * 1e9).astype(np.int64), p, q)


def test_a_circle_at_constant_speed_tells_no_clock_and_takes_no_time() -> None:
    truth, estimate = circle(np.arange(0.0, 200.0, 0.01)), circle(np.arange(0.0, 200.0, 0.1))
    estimate = replace(estimate, p=estimate.p + 0.01 * np.random.default_rng(0).normal(size=estimate.p.shape))
    begin = time.process_time()
    result = evaluate(estimate, truth)
    assert time.process_time() - begin < 5.0  # 20 s before it was asked first whether the motion tells an offset at all
    assert result.association.time_offset is None and not any("offset" in text for text in result.warnings)
