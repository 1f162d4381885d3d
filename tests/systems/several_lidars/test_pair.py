"""A LiDAR is found where and when it is by the surfaces that another one saw, and what is declared wrongly is named."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.several_lidars.judgement import judge_pair
from boxplus.systems.several_lidars.motion import LidarMotion
from boxplus.systems.several_lidars.pair import _linearized, _moved, fit_pair
from boxplus.systems.several_lidars.surfaces import Surfaces

Array = NDArray[np.float64]
START_NS = 1_700_000_000 * 10**9
SECONDS = 8.0
ROOM = np.array([14.0, 10.0, 5.0])


def pose(rotation: tuple[float, float, float], p: tuple[float, float, float]) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(np.array(rotation)), p
    return T


T_TRUE = pose((0.05, -0.1, 2.8), (-0.4, 0.1, 0.2))


def walls(random: np.random.Generator, count: int) -> Array:
    """Points (N, 3) on the walls, floor and ceiling of a room with a pillar."""
    p = random.uniform(-0.5, 0.5, (count, 3)) * ROOM
    axis = random.integers(0, 3, count)
    p[np.arange(count), axis] = random.choice([-0.5, 0.5], count) * ROOM[axis]
    pillar = random.random(count) < 0.15
    angle = random.uniform(0.0, 2.0 * np.pi, count)
    p[pillar, 0], p[pillar, 1] = 4.0 + 0.5 * np.cos(angle[pillar]), 2.0 + 0.5 * np.sin(angle[pillar])
    return p


def turning() -> LidarMotion:
    t = np.linspace(0.0, SECONDS, 81)
    R = so3.exp(np.column_stack([0.1 * np.sin(2.1 * t), 0.15 * np.sin(1.7 * t), 0.8 * np.sin(0.9 * t)]))
    p = np.column_stack([1.5 * np.sin(0.8 * t), np.cos(1.1 * t), 0.2 * np.sin(1.3 * t)])
    return LidarMotion(START_NS + (t * 1e9).astype(np.int64), R, p)


@cache
def scene(delay_s: float = 0.0) -> tuple[LidarMotion, Surfaces, Array, NDArray[np.int64]]:
    """Motion and surfaces of the first LiDAR; points of the other and their times, by a clock that is late by so much."""
    random = np.random.default_rng(3)
    motion = turning()
    surfaces = Surfaces(walls(random, 30_000) + random.normal(0.0, 0.01, (30_000, 3)))
    w = walls(random, 2500)
    t = random.uniform(0.6, SECONDS - 0.6, len(w))
    R, p, _, _ = motion.at(t)
    p_first = np.einsum("nji,nj->ni", R, w - p)
    p_other = (p_first - T_TRUE[:3, 3]) @ T_TRUE[:3, :3] + random.normal(0.0, 0.01, w.shape)
    return motion, surfaces, p_other, START_NS + ((t + delay_s) * 1e9).astype(np.int64)


def test_jacobian_is_that_of_central_differences() -> None:
    motion, surfaces, p, time_ns = scene()
    seconds, T, step = (time_ns - START_NS) * 1e-9, _moved(T_TRUE, np.array([0.02, 0.01, -0.03, 0.1, 0.0, 0.05, 0.0])), 1e-6

    def residual(delta: Array) -> Array:
        found = _linearized(motion, surfaces, p, seconds, _moved(T, delta), 0.01 + delta[6], 3.0)
        assert found is not None
        return found[1]

    found = _linearized(motion, surfaces, p, seconds, T, 0.01, 3.0)
    assert found is not None
    for k in range(7):
        ahead, behind = residual(step * np.eye(7)[k]), residual(-step * np.eye(7)[k])
        numeric = (ahead - behind) / (2.0 * step)
        same_plane = np.abs(numeric) < 100.0  # a point between two planes may change over
        np.testing.assert_allclose(found[0][same_plane, k], numeric[same_plane], rtol=1e-4, atol=1e-4)
        assert same_plane.mean() > 0.99


@pytest.mark.parametrize("turn_deg", [0.0, 5.0, 15.0])
@pytest.mark.parametrize("delay_s", [0.0, 0.1, -0.3])
def test_pose_and_clock_are_found(turn_deg: float, delay_s: float) -> None:
    declared = T_TRUE @ pose(tuple(np.radians(turn_deg) * np.array([0.6, -0.48, 0.64])), (0.1, -0.1, 0.05))
    motion, surfaces, p, time_ns = scene(delay_s)
    fit = fit_pair(motion, surfaces, p, time_ns, declared)
    assert fit is not None
    error = np.linalg.inv(T_TRUE) @ fit.T_first_other
    off = np.concatenate([so3.log(error[:3, :3]), error[:3, 3], [fit.time_offset_s + delay_s]])
    # Five deviations, and what planes through noisy points of a pillar may be off.
    assert (np.abs(off) < 5.0 * np.sqrt(np.diag(fit.covariance)) + np.repeat([1e-3, 5e-3, 1e-3], (3, 3, 1))).all()
    assert fit.fitting > 0.95


@pytest.mark.parametrize(
    ("declared", "delay_s", "verdict", "cause"),
    [
        (T_TRUE, 0.0, "agree", ""),
        (T_TRUE @ pose((0.0, 0.0, 0.1), (0.0, 0.0, 0.0)), 0.0, "contradicted", "pose"),
        (T_TRUE @ pose((0.0, 0.0, 0.0), (0.0, 0.3, 0.0)), 0.0, "contradicted", "pose"),
        (np.linalg.inv(T_TRUE @ pose((0.3, 0.6, 0.0), (0.0, 0.0, 0.0))), 0.0, "contradicted", None),
        (T_TRUE, 0.05, "contradicted", "clock"),
        (T_TRUE, -0.2, "contradicted", "clock"),
    ],
)
def test_what_is_declared_wrongly_is_named(declared: Array, delay_s: float, verdict: str, cause: str | None) -> None:
    judgement = judge_pair(*scene(delay_s), declared)
    assert judgement.verdict == verdict, judgement.text
    assert cause is None or judgement.cause == cause, judgement.text


def test_an_inverted_pose_is_called_so() -> None:
    motion, surfaces, p, time_ns = scene()
    T = pose((0.4, -0.9, 0.7), (1.2, 0.4, -0.6))
    p_other = (p @ T_TRUE[:3, :3].T + T_TRUE[:3, 3] - T[:3, 3]) @ T[:3, :3]
    judgement = judge_pair(motion, surfaces, p_other, time_ns, np.linalg.inv(T))
    assert (judgement.verdict, judgement.cause) == ("contradicted", "inverted"), judgement.text
    assert judgement.T_first_other is not None
    np.testing.assert_allclose(judgement.T_first_other, T, atol=0.02)


UPSIDE_DOWN = pose((np.pi, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("turn", "factor", "cause", "says"),
    [
        (UPSIDE_DOWN, 1.0, "pose", "turned by 180 deg about"),
        (pose((0.0, -np.pi / 2, 0.0), (0.0, 0.0, 0.0)), 1.0, "pose", "turned by 90 deg about (+0.00, -1.00, +0.00)"),
        (np.eye(4), 1.0 / 0.3048, "unit", "once they are multiplied by 0.3048: they come in feet"),
        (np.eye(4), 100.0, "unit", "once they are multiplied by 0.01: they come in centimetres"),
    ],
)
def test_what_lies_nowhere_is_named_where_another_reading_fits(turn: Array, factor: float, cause: str, says: str) -> None:
    """Once half of the map was upside down or in feet, with a warning that it could not be checked and exit code 0."""
    motion, surfaces, p, time_ns = scene()
    judgement = judge_pair(motion, surfaces, factor * p, time_ns, T_TRUE @ np.linalg.inv(turn))
    assert (judgement.verdict, judgement.cause) == ("contradicted", cause), judgement.text
    assert says in judgement.text
    if cause == "pose":
        assert judgement.T_first_other is not None
        np.testing.assert_allclose(judgement.T_first_other, T_TRUE, atol=0.02)


def test_another_reading_that_leaves_something_open_is_none() -> None:
    """A floor alone lies on the ceiling once it is turned upside down."""
    motion, _, _, _ = scene()
    random = np.random.default_rng(5)
    ceiling = np.column_stack([random.uniform(-9.0, 9.0, (20_000, 2)), np.full(20_000, 2.5)])
    t = random.uniform(0.6, SECONDS - 0.6, 2000)
    R, p, _, _ = motion.at(t)
    floor = np.column_stack([random.uniform(-7.0, 7.0, (2000, 2)), np.full(2000, -2.5)])
    p_other = np.einsum("nji,nj->ni", R, floor - p)
    judgement = judge_pair(motion, Surfaces(ceiling), p_other, START_NS + (t * 1e9).astype(np.int64), np.eye(4))
    assert judgement.verdict == "unverified", judgement.text


def test_without_common_surfaces_nothing_is_claimed() -> None:
    motion, surfaces, p, time_ns = scene()
    judgement = judge_pair(motion, surfaces, p * 40.0, time_ns, T_TRUE)
    assert judgement.verdict == "unverified" and "hardly any" in judgement.text


def test_at_rest_the_clock_is_not_called_checked() -> None:
    _, surfaces, _, _ = scene()
    random = np.random.default_rng(4)
    t = np.linspace(0.0, SECONDS, 81)
    rest = LidarMotion(START_NS + (t * 1e9).astype(np.int64), np.tile(np.eye(3), (81, 1, 1)), np.zeros((81, 3)))
    p_other = (walls(random, 2500) - T_TRUE[:3, 3]) @ T_TRUE[:3, :3]
    time_ns = START_NS + (random.uniform(0.1, SECONDS - 0.1, len(p_other)) * 1e9).astype(np.int64)
    judgement = judge_pair(rest, surfaces, p_other, time_ns + 200_000_000, T_TRUE)
    assert judgement.verdict == "agree" and "its clock could not be checked" in judgement.text
    assert judgement.unshown == ("clock",)
