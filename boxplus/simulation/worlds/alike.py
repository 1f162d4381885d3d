"""Worlds whose places look alike, to deceive whatever recognises places. The ground is z = 0."""

from __future__ import annotations

import numpy as np

from boxplus.simulation.worlds.world import Solid, World, box, rectangle
from boxplus.simulation.worlds.worlds import house, pavements


def car_park(columns: int = 10, rows: int = 7, spacing: float = 8.0, height: float = 2.8) -> World:
    """One deck: square columns on a grid, a ceiling with beams, and walls far off; no cars, and no column like no other.

    Columns stand at ((i + ½) · spacing, (j + ½) · spacing) for i < columns, j < rows; aisles are between them.
    """
    size = np.array([columns, rows]) * spacing
    middle = 0.5 * size
    solids = [rectangle((*middle, 0.0), size + 40.0, reflectivity=0.2), rectangle((*middle, height), size + 40.0)]
    for side in (-1.0, 1.0):
        solids.append(box((middle[0], middle[1] + side * (middle[1] + 20.0), 0.5 * height), (size[0] + 40.0, 0.3, height)))
        solids.append(box((middle[0] + side * (middle[0] + 20.0), middle[1], 0.5 * height), (0.3, size[1] + 40.0, height)))
    for j in range(rows):
        solids.append(box((middle[0], (j + 0.5) * spacing, height - 0.2), (size[0], 0.3, 0.4)))
        for i in range(columns):
            solids.append(box(((i + 0.5) * spacing, (j + 0.5) * spacing, 0.5 * height), (0.6, 0.4, height)))
    return World(solids, cell_m=4.0)


def storeys(count: int = 3, size: tuple[float, float] = (36.0, 24.0), storey: float = 4.0, seed: int = 0) -> World:
    """A building whose floors are the same to the centimetre: a corridor around a core, with rooms and furniture.

    The middle of the corridor is the rectangle through (±(size / 2 − 1.5 m)); floor k lies at z = k · storey. A ramp between
    floors is left to the imagination.
    """
    random = np.random.Generator(np.random.PCG64([seed, 120]))
    width, depth = size
    pattern: list[Solid] = []
    core = (width - 6.0, depth - 6.0)
    pattern.append(box((0.0, 0.0, 0.5 * storey), (*core, storey - 0.3)))
    for side in (-1.0, 1.0):
        for x in np.arange(-0.5 * core[0] + 1.0, 0.5 * core[0], 4.0):
            pattern.append(
                box((x + random.uniform(0, 2), side * (0.5 * core[1] + 0.1), 1.1), (random.uniform(0.6, 1.6), 0.4, 2.2))
            )
        for y in np.arange(-0.5 * core[1] + 1.0, 0.5 * core[1], 4.0):
            pattern.append(
                box((side * (0.5 * core[0] + 0.1), y + random.uniform(0, 2), 1.1), (0.4, random.uniform(0.6, 1.6), 2.2))
            )
    solids: list[Solid] = []
    for k in range(count):
        base = k * storey
        for row in pattern:
            moved = row.copy()
            moved[3] += base
            solids.append(moved)
        solids.append(rectangle((0.0, 0.0, base), size, reflectivity=0.3))
        solids.append(rectangle((0.0, 0.0, base + storey - 0.3), size, reflectivity=0.6))
        for side in (-1.0, 1.0):
            solids.append(box((side * (0.5 * width + 0.1), 0.0, base + 0.5 * storey), (0.2, depth, storey)))
        solids.append(box((0.0, 0.5 * depth + 0.1, base + 0.5 * storey), (width, 0.2, storey)))
        solids.append(box((0.0, -0.5 * depth - 0.1, base + 0.5 * storey), (width, 0.2, storey)))
    return World(solids, cell_m=2.0)


def parallel_corridors(
    count: int = 4, length: float = 60.0, spacing: float = 12.0, width: float = 3.0, door: float = 6.0
) -> World:
    """Identical corridors along x at y = k · spacing, with a niche every `door` metres, joined by a passage at either end.

    Passages run along y at x = ±(length / 2 + width / 2).
    """
    height = 2.6
    total = (count - 1) * spacing
    solids = [
        rectangle((0.0, 0.5 * total, 0.0), (length + 4.0 * width, total + 4.0 * width), reflectivity=0.3),
        rectangle((0.0, 0.5 * total, height), (length + 4.0 * width, total + 4.0 * width), reflectivity=0.6),
    ]
    for k in range(count - 1):
        solids.append(box((0.0, (k + 0.5) * spacing, 0.5 * height), (length, spacing - width - 1.0, height)))
    for side in (-1.0, 1.0):
        solids.append(
            box((side * (0.5 * length + 1.0 * width + 0.1), 0.5 * total, 0.5 * height), (0.2, total + 2.0 * width, height))
        )
        y = 0.5 * total + side * (0.5 * total + 0.5 * width + 0.1)
        solids.append(box((0.0, y, 0.5 * height), (length + 2.0 * width, 0.2, height)))
    for k in range(count):
        for side in (-1.0, 1.0):
            if (k == 0 and side < 0) or (k == count - 1 and side > 0):
                continue
            for x in np.arange(-0.5 * length + 0.5 * door, 0.5 * length, door):
                solids.append(box((x, k * spacing + side * (0.5 * width + 0.25), 0.5 * height), (door - 1.2, 0.5, height)))
    return World(solids, cell_m=2.0)


def estates(apart: float = 180.0, pitch: float = 60.0, street: float = 18.0, seed: int = 0) -> World:
    """Two estates of three by three blocks, house for house and car for car the same, the second one `apart` metres along x.

    The middles of the first one's streets are the lines x, y = 0 and `pitch`; the ring of blocks around them is a part of it.
    """
    solids: list[Solid] = [rectangle((0.5 * (apart + pitch), 0.5 * pitch, 0.0), (apart + 500.0, 400.0), reflectivity=0.2)]
    lot = (pitch - street) / 3.0
    for begin in (0.0, apart):
        random = np.random.Generator(np.random.PCG64([seed, 121]))
        for i, j in np.ndindex(3, 3):
            low = np.array([begin + (i - 1) * pitch, (j - 1) * pitch]) + 0.5 * street
            for a, b in np.ndindex(3, 3):
                if (a, b) != (1, 1):  # the yard in the middle is never seen
                    solids += house(random, low + lot * np.array([a, b]), low + lot * np.array([a + 1, b + 1]))
            solids += pavements(random, low, low + pitch - street, street)
    return World(solids)
