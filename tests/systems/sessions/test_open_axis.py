"""How far along a street two sessions lie: by what faces along it, of all encounters, where it fits at one shift only."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.open_axis import moved_along, open_axis, shift_along
from boxplus.systems.sessions.places import Places
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.loop import Loop

CONFIG = SessionsConfig()
CONFIG = CONFIG.model_copy(update={"slam": CONFIG.slam.model_copy(update={"appearance": "none"})})
HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
EAST = np.array([1.0, 0.0, 0.0])
_UNEVEN = (-31.0, -26.5, -19.0, -14.7, -8.0, -5.2, 1.0, 7.6, 9.9, 17.0, 21.3, 29.0, 33.8)


def at(x: float, z: float = 0.0) -> NDArray[np.float64]:
    """(7,) a pose there, level and ahead."""
    return HERE + np.array([0.0, 0.0, 0.0, 0.0, x, 0.0, z])


def wall(x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.float64]:
    """Points every 0.25 m on an upright wall of 3 m between two corners."""
    count = int(np.hypot(x[1] - x[0], y[1] - y[0]) / 0.25) + 1
    line = np.column_stack([np.linspace(*x, count), np.linspace(*y, count)])
    z = np.arange(0.125, 3.0, 0.25)
    return np.column_stack([np.repeat(line, len(z), axis=0), np.tile(z, count)])


def street(steps: tuple[float, ...]) -> NDArray[np.float64]:
    """Ground, and fronts along x, of which the northern one steps back and forth by a metre at these places."""
    grid = np.stack(np.meshgrid(np.arange(-40.0, 40.1, 0.5), np.arange(-6.0, 6.1, 0.5), [0.0]), axis=-1).reshape(-1, 3)
    parts, y = [grid, wall((-40.0, 40.0), (-6.0, -6.0))], 6.0
    for first, last in zip((-40.0, *steps), (*steps, 40.0), strict=True):
        parts.append(wall((first, last), (y, y)))
        if last < 40.0:
            parts.append(wall((last, last), (6.0, 7.0)))
        y = 13.0 - y
    return np.concatenate(parts)


def session(name: str, points: NDArray[np.float64], seed: int, yaw: float = 0.0) -> Places:
    """Driven along x, 16 m seen either way, to 1 cm; the frame turned."""
    random, maps = np.random.default_rng(seed), []
    for k, x in enumerate(np.linspace(-12.0, 12.0, 5)):
        near = points[np.abs(points[:, 0] - x) < 16.0]
        T = se3.compose(np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), 0.0, 0.0, 0.0]), at(x, 1.2))
        seen = se3.act(se3.inverse(at(x, 1.2)), near + random.normal(0.0, 0.01, near.shape))
        maps.append(LocalMap(k, k, k, k, T, 1e-6 * np.eye(6), 4.0 * k, seen.astype(np.float32), 1))
    return Places(Session.of(name, maps), CONFIG.slam)


def encounter(number: int, open_: NDArray[np.float64] | None = EAST) -> Loop:
    """Of the local maps of one number, measured to a centimetre but for one direction."""
    covariance, information = 1e-4 * np.eye(6), 1e4 * np.eye(6)
    if open_ is not None:
        covariance[3:, 3:] += 4.0 * np.outer(open_, open_)
        information[3:, 3:] -= 1e4 * np.outer(open_, open_)
    return Loop(number, number, "nearby", 0, HERE, HERE, covariance, information, 6 - (open_ is not None))


LOOPS = [encounter(k) for k in range(5)]


@pytest.mark.parametrize("shift", [-6.31, 0.0, 2.27])
def test_the_shift_along_a_street_is_found(shift: float) -> None:
    points = street(_UNEVEN)
    T = at(shift)
    found = shift_along(EAST, LOOPS, T, session("a", points, 1), session("b", points, 2), CONFIG)
    assert found.refusal is None and abs(found.metres + shift) < 0.05


def test_in_whatever_frame_the_sessions_are() -> None:
    points, yaw = street(_UNEVEN), 2.0
    T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, -np.sin(0.5 * yaw), 1.5, 0.0, 0.0])
    axis = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    found = shift_along(axis, LOOPS, T, session("a", points, 1), session("b", points, 2, yaw), CONFIG)
    assert found.refusal is None and abs(found.metres + 1.5) < 0.05


def test_even_fronts_and_fronts_that_repeat_tell_nothing() -> None:
    even, periodic = street(()), street(tuple(np.arange(-36.0, 37.0, 4.0).tolist()))
    told = shift_along(EAST, LOOPS, HERE, session("a", even, 1), session("b", even, 2), CONFIG)
    assert told.refusal == "nothing that faces along it lies over each other"
    told = shift_along(EAST, LOOPS, HERE, session("a", periodic, 1), session("b", periodic, 2), CONFIG)
    assert told.refusal is not None and told.refusal.startswith("what faces along it fits as well")
    other = street(tuple(x + 2.0 * (k % 3) for k, x in enumerate(_UNEVEN)))
    told = shift_along(EAST, LOOPS, HERE, session("a", other, 1), session("b", street(_UNEVEN), 2), CONFIG)
    assert told.refusal is not None


@given(st.lists(st.floats(-12.0, 12.0), min_size=1, max_size=60))
def test_however_many_leave_one_direction_open_it_is(degrees: list[float]) -> None:
    query = session("b", street(()), 1) if not _KEPT else _KEPT[0]
    _KEPT[:] = [query]
    yaw = np.deg2rad(np.array(degrees) - np.mean(degrees)).clip(-0.2, 0.2)
    loops = [encounter(k % 5, np.array([np.cos(a), np.sin(a), 0.0])) for k, a in enumerate(yaw)]
    axis = open_axis(loops, query, 0.3)
    assert axis is not None and abs(axis[0]) > 0.95
    north = np.array([0.0, 1.0, 0.0])
    assert open_axis([*loops, encounter(0, north)], query, 0.3) is None  # that of a street that crosses
    assert open_axis([*loops, encounter(0, None)], query, 0.3) is None


_KEPT: list[Places] = []


def test_what_all_tell_is_told_once() -> None:
    query = session("b", street(()), 1)
    moved = [moved_along(loop, EAST, query, len(LOOPS)) for loop in LOOPS]
    assert open_axis(moved, query, 0.3) is None and all(loop.measured == 6 for loop in moved)
    total = np.sum([loop.information for loop in moved], axis=0)
    assert total[3, 3] == pytest.approx(1.0 / 0.05**2)
    for loop in moved:  # information of what is measured, covariance of what was open
        assert loop.covariance[3, 3] == pytest.approx(1.0 / (1.0 / 4.0001 + 1.0 / (5 * 0.05**2)), rel=1e-3)
        assert np.linalg.eigvalsh(loop.covariance)[0] > 0.0


def test_axes_are_those_of_the_session() -> None:
    """An encounter's covariance is in the frame of its local map."""
    query = session("b", street(()), 1, yaw=0.8)
    axis = open_axis(LOOPS, query, 0.3)
    R = quaternion.to_matrix(query.session.T_session_map[0, :4])
    assert axis is not None and abs(axis @ R @ EAST) > 0.999 and np.allclose(R, so3.exp([0.0, 0.0, 0.8]))
