"""When the motion makes the extrinsic observable: turning about two axes."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.filtering.propagation import N_TIME, N_W, NODE
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.mounting.excitation import RotationExcitation


def _nodes(rates: np.ndarray) -> np.ndarray:
    nodes = np.zeros((len(rates), NODE))
    nodes[:, N_TIME] = np.linspace(0.0, 0.1, len(rates))
    nodes[:, N_W : N_W + 3] = rates
    return nodes


def _turning(amplitude: tuple[float, float, float], scans: int = 200, seed: int = 0) -> RotationExcitation:
    excitation = RotationExcitation()
    frame = so3.exp(np.random.default_rng(seed).normal(size=3))
    for scan in range(scans):
        time = 0.1 * scan + np.linspace(0.0, 0.1, 21)
        phases = np.stack([np.sin(3.0 * time), np.cos(3.0 * time), np.sin(5.0 * time)], axis=1)
        excitation.add(_nodes(phases * amplitude @ frame.T))
    return excitation


def test_at_first_nothing_is_known() -> None:
    assert not RotationExcitation().sufficient


@pytest.mark.parametrize("seed", range(4))
def test_turning_about_any_axis_is_enough(seed: int) -> None:
    assert not _turning((0.0, 0.0, 0.0), seed=seed).sufficient
    assert _turning((2.0, 0.0, 0.0), seed=seed).sufficient  # whichever direction the axis has
    assert _turning((2.0, 0.4, 0.0), seed=seed).sufficient
    assert _turning((0.5, 0.5, 0.5), seed=seed).sufficient
    assert not _turning((0.05, 0.05, 0.05), seed=seed).sufficient


def test_it_fades() -> None:
    excitation = _turning((1.0, 1.0, 0.0))
    assert excitation.sufficient
    for _ in range(200):
        excitation.add(_nodes(np.zeros((20, 3))))
    assert not excitation.sufficient
