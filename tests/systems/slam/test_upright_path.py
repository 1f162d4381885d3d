"""Whether a path lies in an upright plane, as that of a LiDAR on its side does where a wall passed for the floor."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.slam.upright_path import climb_within_upright_plane

Floats = NDArray[np.float64]


def walked(seed: int) -> Floats:
    """Round corners on level ground, swaying by centimetres."""
    random = np.random.default_rng(seed)
    route = np.array([[0.0, 0.0], [18.0, 0.0], [18.0, 10.0], [2.0, 10.0], [2.0, 1.0]])
    xy = np.concatenate([np.linspace(a, b, 6) for a, b in itertools.pairwise(route)])
    return np.column_stack([xy, np.zeros(len(xy))]) + random.normal(0.0, 0.03, (len(xy), 3))


@given(seed=st.integers(0, 50), roll=st.floats(60.0, 120.0), yaw=st.floats(-180.0, 180.0))
def test_a_level_walk_turned_on_its_side_is_one(seed: int, roll: float, yaw: float) -> None:
    R = so3.exp(np.deg2rad([roll, 0.0, 0.0])) @ so3.exp(np.deg2rad([0.0, 0.0, yaw]))
    climb = climb_within_upright_plane(walked(seed) @ R.T)
    assert climb is not None and 8.0 < climb < 25.0


@given(seed=st.integers(0, 50), tilt=st.floats(-30.0, 30.0))
def test_a_walk_on_the_ground_or_a_slope_is_none(seed: int, tilt: float) -> None:
    R = so3.exp(np.deg2rad([tilt, 0.0, 0.0]))
    assert climb_within_upright_plane(walked(seed) @ R.T) is None


@pytest.mark.parametrize(
    "p",
    [
        np.zeros((0, 3)),
        np.zeros((9, 3)),
        np.linspace([0.0, 0.0, 0.0], [20.0, 0.0, 9.0], 12),  # up a ramp
        np.column_stack([np.cos(np.arange(30.0)), np.sin(np.arange(30.0)), 0.3 * np.arange(30.0)]),  # up a stairwell
    ],
)
def test_nothing_is_said_of_lines_and_stairwells(p: Floats) -> None:
    assert climb_within_upright_plane(p) is None
