"""Floor plans against the walls of simulated rooms, and the ground of slopes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.maps.floor_plan.occupancy import FREE, OCCUPIED, UNKNOWN, FloorPlanConfig, Occupancy
from boxplus.maps.floor_plan.raster import Floats, GroundHeights, Raster
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drifting_drive
from boxplus.simulation.worlds.world import World, box, rectangle

# Two rooms with a door between them: centres and sizes of the walls, a cupboard and a lamp that hangs above heads.
WALLS = [
    *(((0.0, y, 1.5), (12.2, 0.2, 3.0)) for y in (-3.0, 3.0)),
    *(((x, 0.0, 1.5), (0.2, 6.2, 3.0)) for x in (-6.0, 6.0)),
    *(((0.0, y, 1.5), (0.2, 2.2, 3.0)) for y in (-2.0, 2.0)),
    ((-4.0, 2.0, 0.5), (1.0, 0.6, 1.0)),
]
LAMP = ((3.0, 0.0, 2.5), (0.5, 0.5, 0.4))
STILL = DriftConfig(
    speed=1.5, step_m=0.5, corner_radius=0.6, height=1.0, max_range=30.0, vertical_fov_deg=(-35.0, 35.0), channels=24,
    azimuth_steps=240, range_sigma=0.01, yaw_drift=0.0, tilt_drift=0.0, position_drift=0.0,
)  # fmt: skip


def seen_from(solids: list[NDArray[np.float64]], route: list[list[float]]) -> tuple[NDArray[np.float32], Floats]:
    """Points and path of a walk, both in the world."""
    drive = simulate_drifting_drive(World(solids), route, STILL)
    pairs = zip(drive.T_world_body, drive.scans, strict=True)
    points = np.concatenate([se3.act(T, scan.astype(np.float64)) for T, scan in pairs]).astype(np.float32)
    return points, drive.T_world_body[:, 4:]


def plan_of(points: NDArray[np.float32], path: Floats, config: FloorPlanConfig) -> tuple[NDArray[np.uint8], Raster]:
    corners = points[:, :2].min(axis=0).astype(np.float64), points[:, :2].max(axis=0).astype(np.float64)
    coarse = Raster.over(*corners, config.ground_cell)
    ground = GroundHeights(coarse, config.slope)
    ground.add(points)
    raster = Raster.over(*corners, config.resolution)
    occupancy = Occupancy(raster, ground.heights(), coarse, config)
    for part in np.array_split(points, 3):
        occupancy.add(part)
    return occupancy.cells(path), raster


def outside(p: Floats, centre: tuple[float, ...], size: tuple[float, ...]) -> Floats:
    """Distances (n,) of points (n, 2) from a box, seen from above; negative inside."""
    q = np.abs(p - np.array(centre[:2])) - 0.5 * np.array(size[:2])
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


def test_two_rooms_are_drawn_as_they_are() -> None:
    solids = [rectangle((0.0, 0.0, 0.0), (12.0, 6.0)), rectangle((0.0, 0.0, 3.0), (12.0, 6.0))]
    solids += [box(*solid) for solid in (*WALLS, LAMP)]
    points, path = seen_from(solids, [[-4.5, -1.5], [-1.5, 0.0], [1.5, 0.0], [4.5, 1.5], [4.5, -1.5], [1.5, -1.5]])
    cells, raster = plan_of(points, path, FloorPlanConfig())
    rows, columns = np.mgrid[: raster.rows, : raster.columns]
    middles = np.column_stack([raster.x + (columns.ravel() + 0.5) * raster.cell, raster.y + (rows.ravel() + 0.5) * raster.cell])
    found = cells.ravel()
    from_walls = np.min([outside(middles, *wall) for wall in WALLS], axis=0)
    inside = (np.abs(middles[:, 0]) < 5.9) & (np.abs(middles[:, 1]) < 2.9)
    open_floor = inside & (from_walls > 0.15)  # under the lamp, too
    assert not (found[open_floor] == OCCUPIED).any()
    assert (found[open_floor] == FREE).mean() > 0.97
    assert not (found[~inside & (from_walls > 0.15)] == FREE).any()  # nothing leaks through the walls
    assert not (found[(from_walls < -0.05) & ~inside] == FREE).any()
    for side in (-2.9, 2.9):  # the faces of the long walls, seen from within
        face = np.column_stack([np.arange(-5.7, 5.7, 0.1), np.full(114, side)])
        face = face[np.abs(face[:, 0]) > 0.2]
        occupied = middles[found == OCCUPIED]
        near = np.linalg.norm(face[:, None] - occupied[None], axis=2).min(axis=1)
        assert (near < 0.15).mean() > 0.97


def test_a_slope_is_ground_and_a_wall_on_it_is_none() -> None:
    random = np.random.default_rng(1)
    xy = random.uniform([0.0, 0.0], [20.0, 8.0], (40_000, 2))
    slope = np.column_stack([xy, 0.2 * xy[:, 0] + random.normal(0.0, 0.01, len(xy))])
    y, up = random.uniform(1.0, 7.0, 3000), random.uniform(0.0, 2.0, 3000)
    wall = np.column_stack([np.full(3000, 12.03), y, 0.2 * 12.03 + up])
    car = random.uniform([4.0, 3.0, 2.2], [6.0, 5.0, 2.4], (2000, 3))  # its roof alone, 1.2 to 1.4 m above
    hidden = (np.abs(slope[:, 0] - 5.0) < 1.0) & (np.abs(slope[:, 1] - 4.0) < 1.0)
    ghost = np.array([[10.0, 4.0, -3.0]])  # mirrored below the ground
    points = np.concatenate([slope[~hidden], wall, car, ghost]).astype(np.float32)
    cells, raster = plan_of(points, np.array([[2.0, 1.0, 1.4]]), FloorPlanConfig())
    assert (raster.x, raster.y) == (0.0, 0.0)
    assert (cells[10:70, 120] == OCCUPIED).mean() > 0.95
    assert (cells[31:49, 41:59] == OCCUPIED).mean() > 0.8
    for free in (cells[:, 2:38], cells[:, 62:118], cells[:, 123:198]):
        assert (free == OCCUPIED).mean() < 0.002 and (free == FREE).mean() > 0.9


@settings(deadline=None, max_examples=30)
@given(st.integers(2, 12), st.integers(2, 12), st.integers(0, 2**31), st.floats(0.05, 1.0))
def test_the_ground_is_the_largest_surface_below_that_is_nowhere_steeper(
    rows: int, columns: int, seed: int, slope: float
) -> None:
    random = np.random.default_rng(seed)
    raster = Raster(0.0, 0.0, 0.5, rows, columns)
    z = random.uniform(0.0, 3.0, (rows, columns))
    i, j = np.mgrid[:rows, :columns]
    middles = np.column_stack([(j.ravel() + 0.5) * 0.5, (i.ravel() + 0.5) * 0.5, z.ravel()])
    ground = GroundHeights(raster, slope)
    ground.add(np.repeat(middles, 3, axis=0).astype(np.float32))
    di, dj = (np.abs(v.ravel()[:, None] - v.ravel()[None]) for v in (i, j))
    way = 0.5 * (np.maximum(di, dj) + (np.sqrt(2.0) - 1.0) * np.minimum(di, dj))  # along rows, columns and diagonals
    expected = (z.astype(np.float32).astype(np.float64).ravel()[None] + slope * way).min(axis=1)
    np.testing.assert_allclose(ground.heights().ravel(), expected, atol=1e-9)


def test_what_nobody_saw_is_unknown() -> None:
    """A ray that meets nothing proves nothing, and ground is continued two metres at most."""
    random = np.random.default_rng(0)
    wall = np.column_stack([np.full(400, 5.05), random.uniform(-1.0, 1.0, 400), random.uniform(0.0, 2.0, 400)])
    floor = np.column_stack([random.uniform(-0.5, 0.5, (3000, 2)), np.zeros(3000)])
    far = np.array([[-10.0, -10.0, 0.0], [10.0, 10.0, 0.0]])
    points = np.concatenate([wall, floor, far]).astype(np.float32)
    cells, raster = plan_of(points, np.zeros((1, 3)), FloorPlanConfig())
    row, column, _ = raster.index(np.array([[3.0, 0.0], [-3.0, 0.0], [3.0, 4.0], [7.0, 0.0], [0.0, 0.0], [5.05, 0.0]]))
    assert cells[row, column].tolist()[1:4] == [UNKNOWN] * 3
    assert cells[row, column].tolist()[4] == FREE
    with pytest.raises(InputError, match="at most 200,000,000 cells"):
        Raster.over(np.zeros(2), np.array([1e5, 1e5]), 0.1)
