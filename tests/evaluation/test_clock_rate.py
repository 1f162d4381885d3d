"""Clocks of different rates are told apart from clocks with an offset, with a deviation that holds; and from drift."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from boxplus.evaluation.clock_fit import MotionPair
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


def test_a_circle_at_constant_speed_tells_no_clock_and_is_not_searched_for_one(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, estimate = circle(np.arange(0.0, 200.0, 0.01)), circle(np.arange(0.0, 200.0, 0.1))
    estimate = replace(estimate, p=estimate.p + 0.01 * np.random.default_rng(0).normal(size=estimate.p.shape))
    compared, cut = [], MotionPair._cut

    def counted(pair: MotionPair, *of: object) -> object:
        compared.append(of)
        return cut(pair, *of)

    monkeypatch.setattr(MotionPair, "_cut", counted)
    result = evaluate(estimate, truth)
    assert len(compared) < 100  # one is a twentieth of a second; whether the motion tells an offset at all is asked first
    assert result.association.time_offset is None and not any("offset" in text for text in result.warnings)


def test_a_rate_that_one_stretch_alone_tells_is_none() -> None:
    """Leaving it out leaves nothing that could say how sure the others are: it raised LinAlgError."""
    t = np.arange(0.0, 100.0, 0.05)
    away = np.where((t > 42.0) & (t < 48.0), 1.0 - np.cos(2.0 * np.pi * (t - 42.0) / 3.0), 0.0)
    half_turn = 0.2 * np.sin(0.3 * t) + 0.1 * np.cos(0.5 * t)
    q_wxyz = np.column_stack([np.cos(half_turn), np.sin(half_turn), np.zeros((len(t), 2))])
    p = np.column_stack([away, away * np.sin(t), away * np.cos(2.0 * t)])
    path = Trajectory(np.round(t * 1e9).astype(np.int64), p, q_wxyz)
    assert MotionPair(path.time_ns, path, path.time_ns, path).fit_rate("translation", 0.0, 1.0) is None
    assert not any("rate" in text for text in evaluate(path, path).warnings)
