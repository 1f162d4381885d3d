"""Rays against solids: surfaces are hit exactly, the grid changes nothing, plain geometry agrees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation import World, box, cylinder, rectangle, sphere

seeds = st.integers(0, 2**32 - 1)


def random_solids(random: np.random.Generator, count: int = 12) -> list[np.ndarray]:
    solids = [rectangle((0.0, 0.0, 0.0), (300.0, 300.0))]
    for _ in range(count):
        centre = random.uniform((-15, -15, 0), (15, 15, 4))
        kind = random.integers(0, 4)
        if kind == 0:
            solids.append(box(centre, random.uniform(0.2, 4, 3), yaw=random.uniform(0, 3)))
        elif kind == 1:
            solids.append(box(centre, random.uniform(0.2, 4, 3), R_world_box=so3.exp(random.uniform(-2, 2, 3))))
        elif kind == 2:
            solids.append(cylinder(centre, random.uniform(0.1, 1), random.uniform(0.5, 4)))
        else:
            solids.append(sphere(centre, random.uniform(0.2, 1.5)))
    return solids


def random_rays(random: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions, so3.exp(random.uniform(-2, 2, (count, 3))), random.uniform((-25, -25, -1), (25, 25, 8), (count, 3))


@given(seeds)
def test_the_grid_changes_nothing_and_hits_lie_on_surfaces(seed: int) -> None:
    random = np.random.default_rng(seed)
    solids = random_solids(random)
    directions, R, p = random_rays(random, 60)
    directions[:3] = [[0, 0, 1], [1, 0, 0], [0, -1, 0]]
    R[:3] = np.eye(3)
    ranges, hits = World(solids, cell_m=1.5).cast(directions, R, p)
    plain, plain_hits = World(solids, cell_m=1000.0).cast(directions, R, p)
    np.testing.assert_allclose(ranges, plain, rtol=1e-12)
    found = np.isfinite(ranges)
    np.testing.assert_array_equal(hits[found], plain_hits[found])
    points = p[found] + ranges[found, None] * np.einsum("nij,nj->ni", R, directions)[found]
    assert World(solids).distance(points).max(initial=0.0) < 1e-9


@given(seeds)
def test_nothing_is_passed_through(seed: int) -> None:
    """March along the ray by the distance to the nearest surface: the first surface reached is the one that was hit."""
    random = np.random.default_rng(seed)
    world = World(random_solids(random, 6))
    directions, R, p = random_rays(random, 8)
    ranges, _ = world.cast(directions, R, p, max_range=40.0)
    for origin, direction, expected in zip(p, np.einsum("nij,nj->ni", R, directions), ranges, strict=True):
        travelled = 0.0
        while travelled < min(expected, 40.0) - 1e-3:
            distance = world.distance((origin + travelled * direction)[None])[0]
            assert distance > 0.0
            travelled += max(min(distance, expected - travelled), 1e-4)
        assert travelled <= expected + 1e-9


def test_plane_sphere_and_room() -> None:
    down, aside = np.array([[0.6, 0.0, -0.8]]), np.array([[1.0, 0.0, 0.0]])
    pose = np.eye(3)[None], np.array([[0.0, 0.0, 4.0]])
    assert World([rectangle((0, 0, 0), (50, 50))]).cast(down, *pose)[0] == pytest.approx([5.0])
    assert World([sphere((10, 0, 4), 2.0)]).cast(aside, *pose)[0] == pytest.approx([8.0])
    assert World([box((0, 0, 4), (6, 8, 3))]).cast(aside, *pose)[0] == pytest.approx([3.0])
    assert World([cylinder((10, 0, 0), 1.0, 5.0)]).cast(aside, *pose)[0] == pytest.approx([9.0])
    assert np.isinf(World([sphere((10, 0, 4), 2.0)]).cast(aside, *pose, max_range=7.9)[0]).all()
    assert np.isinf(World([sphere((-10, 0, 4), 2.0)]).cast(aside, *pose)[0]).all()


def test_distance_inside_and_outside() -> None:
    world = World([box((0, 0, 1), (2, 4, 2)), cylinder((10, 0, 0), 1.0, 2.0), sphere((0, 20, 0), 3.0)])
    points = [[0, 0, 1], [4, 6, 2], [10.5, 0, 1], [10, 0, 5], [12, 0, 1], [0, 20, 1]]
    assert world.distance(points) == pytest.approx([1.0, 5.0, 0.5, 3.0, 1.0, 2.0])


def test_refused() -> None:
    world = World([sphere((0, 0, 0), 1.0)])
    with pytest.raises(InputError, match="at least one solid"):
        World([])
    with pytest.raises(InputError, match="N a multiple of M"):
        world.cast(np.ones((5, 3)), np.stack([np.eye(3)] * 2), np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"p_world of shape \(N, 3\)"):
        world.distance([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="sizes that are not negative"):
        sphere((0, 0, 0), -1.0)
