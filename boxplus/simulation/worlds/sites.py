"""More worlds to record in, each reproducible from its seed: warehouse, tunnel, street, highway, forest, open field, stairwell.

The ground is z = 0 and what is long lies along x. Each says which part of it is free of obstacles.
"""

from __future__ import annotations

import numpy as np

from boxplus.simulation.worlds.world import Solid, World, box, cylinder, rectangle, sphere
from boxplus.simulation.worlds.worlds import house, pavements

STOREY_M = 3.2
"""Height of a storey of the stairwell [m]."""


def _random(seed: int, stream: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64([seed, 200 + stream]))


def warehouse(length: float = 40.0, height: float = 9.0, seed: int = 0) -> World:
    """Four rows of racks with pallets in a hall; the aisle |y| < 1.7 m is free from wall to wall, two more lie at y = ±4.6 m."""
    random = _random(seed, 0)
    pitch, depth, bay = 4.6, 1.2, 2.8
    solids = [box((0.0, 0.0, 0.5 * height), (length, 4.6 * pitch, height), reflectivity=0.7)]
    rack = length - 8.0
    for row in (-1.5, -0.5, 0.5, 1.5):
        y = row * pitch
        for x in np.arange(-0.5 * rack, 0.5 * rack + 0.01, bay):
            solids.append(box((x, y, 3.0), (0.1, depth, 6.0), reflectivity=0.9))
        for level in (0.15, 1.75, 3.35, 4.95):
            solids.append(box((0.0, y, level - 0.06), (rack, depth, 0.12), reflectivity=0.8))
            for x in np.arange(-0.5 * (rack - bay), 0.5 * (rack - bay) + 0.01, bay):
                if random.uniform() < 0.75:
                    size = random.uniform((1.2, 0.8, 0.6), (2.4, 1.1, 1.35))
                    centre = (x + random.uniform(-0.1, 0.1), y, level + 0.5 * size[2])
                    solids.append(box(centre, size, yaw=random.normal(0.0, 0.03), reflectivity=random.uniform(0.2, 0.9)))
    return World(solids, cell_m=2.0)


def tunnel(length: float = 500.0, width: float = 9.0, height: float = 6.0, lamp_spacing: float | None = None) -> World:
    """A road tunnel along x, free but for a metre along the walls.

    Args:
        length, width, height: of the tube [m].
        lamp_spacing: distance between the lamps under the roof [m]; None leaves the tube smooth: nothing tells how far one has
            come.
    """
    solids = [box((0.0, 0.0, 0.5 * height), (length, width, height))]
    for side in (-1.0, 1.0):
        solids.append(box((0.0, side * 0.5 * (width - 0.8), 0.1), (length, 0.8, 0.2)))
    if lamp_spacing is not None:
        for x in np.arange(-0.5 * length + lamp_spacing, 0.5 * length, lamp_spacing):
            solids.append(box((x, 0.0, height - 0.2), (1.2, 0.4, 0.4), reflectivity=0.9))
    return World(solids)


def street(length: float = 280.0, width: float = 18.0, seed: int = 0) -> World:
    """A street along x between houses, with parked cars, trees and lamps; |y| < 2.7 m is free."""
    random = _random(seed, 1)
    solids = [rectangle((0.0, 0.0, 0.0), (length + 200.0, 300.0), reflectivity=0.2)]
    for side in (-1.0, 1.0):
        low = -0.5 * length
        while low < 0.5 * length:
            high = low + random.uniform(10.0, 18.0)
            if random.uniform() > 0.08:
                near = 0.5 * width + random.uniform(0.0, 1.8)
                edges = np.sort([side * near, side * (near + 12.0)])
                solids += house(random, np.array([low, edges[0]]), np.array([high - 0.05, edges[1]]))
            low = high
    block = np.array([-0.5 * length, 0.5 * width]), np.array([0.5 * length, 0.5 * width + 10.0])
    mirrored = np.array([-0.5 * length, -0.5 * width - 10.0]), np.array([0.5 * length, -0.5 * width])
    for corner_low, corner_high in (block, mirrored):
        solids += pavements(random, corner_low, corner_high, width)
    return World(solids)


def highway(length: float = 1200.0, seed: int = 0) -> World:
    """A divided highway along x: rails, delineators, signs, gantries and bridges, noise barriers, bushes; |y| < 5 m is free."""
    random = _random(seed, 4)
    half = 0.5 * length
    solids = [rectangle((0.0, 0.0, 0.0), (length + 400.0, 400.0), reflectivity=0.2)]
    for y in (-7.0, 7.0, 9.0, 23.0):
        solids.append(box((0.0, y, 0.65), (length, 0.08, 0.32), reflectivity=0.8))
        for x in np.arange(-half, half, 4.0):
            solids.append(box((x + random.normal(0.0, 0.02), y, 0.4), (0.12, 0.14, 0.8), reflectivity=0.8))
    for x in np.arange(-half, half, 50.0):
        for y in (-6.4, 23.6):
            solids.append(box((x + random.normal(0.0, 0.3), y, 0.55), (0.12, 0.12, 1.1), reflectivity=0.9))
    for y in (-11.0, 28.0):
        begin = -half
        while begin < half:
            end = begin + random.uniform(40.0, 200.0)
            if random.uniform() < 0.35:
                height = random.uniform(2.5, 4.5)
                solids.append(box((0.5 * (begin + end), y, 0.5 * height), (end - begin, 0.3, height), reflectivity=0.4))
            else:
                solids += _bushes(random, begin, end, y)
            begin = end
    for x in np.arange(-half + random.uniform(20.0, 150.0), half, 150.0) + random.uniform(-30.0, 30.0):
        what = random.uniform()
        if what < 0.6:
            solids.append(cylinder((x, -8.2, 0.0), 0.06, 3.2, reflectivity=0.8))
            solids.append(box((x, -8.2, 3.0), (0.05, random.uniform(1.0, 3.0), random.uniform(0.8, 2.0)), reflectivity=0.95))
        else:
            deep, thick, above = (0.5, 0.6, 6.0) if what < 0.85 else (random.uniform(8.0, 14.0), 1.5, 5.5)
            solids.append(box((x, 8.0, above + 0.5 * thick), (deep, 40.0, thick), reflectivity=0.6))
            solids += [box((x, y, 0.5 * above), (deep, 0.6, above), reflectivity=0.6) for y in (-9.0, 8.0, 25.0)]
    return World(solids)


def _bushes(random: np.random.Generator, begin: float, end: float, y: float) -> list[Solid]:
    """Bushes and trees beyond the shoulder at `y`, a few metres apart."""
    solids: list[Solid] = []
    for x in np.arange(begin, end, random.uniform(4.0, 15.0)):
        place = x + random.uniform(-2.0, 2.0), y + np.sign(y) * random.uniform(0.5, 8.0)
        if random.uniform() < 0.5:
            solids.append(sphere((*place, random.uniform(0.2, 0.8)), random.uniform(0.5, 1.4), reflectivity=0.4))
        else:
            solids.append(cylinder((*place, 0.0), random.uniform(0.1, 0.3), 5.0, reflectivity=0.3))
            solids.append(sphere((*place, random.uniform(4.0, 6.0)), random.uniform(1.2, 2.5), reflectivity=0.4))
    return solids


def forest(side: float = 80.0, spacing: float = 3.5, seed: int = 0) -> World:
    """Trunks and shrubs on flat ground; the trail |y| < 1.5 m is free, and so is a clearing of 5 m around the origin."""
    random = _random(seed, 2)
    solids = [rectangle((0.0, 0.0, 0.0), (3.0 * side, 3.0 * side), reflectivity=0.2)]
    steps = np.arange(-0.5 * side, 0.5 * side, spacing)
    for x, y in np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + random.uniform(-1.0, 1.0, (len(steps) ** 2, 2)):
        radius = random.uniform(0.1, 0.35)
        if abs(y) < 1.5 + radius or np.hypot(x, y) < 5.0 + radius:
            continue
        solids.append(cylinder((x, y, 0.0), radius, random.uniform(6.0, 14.0), reflectivity=0.3))
        if random.uniform() < 0.15 and abs(y) > 3.0 and np.hypot(x, y) > 7.0:
            solids.append(sphere((x + 0.5, y, 0.1), random.uniform(0.4, 0.9), reflectivity=0.4))
    return World(solids)


def open_field(objects: int = 6, seed: int = 0) -> World:
    """Flat ground with a few huts and trees, 12 to 45 m from the origin: little tells where one is, less how one is turned."""
    random = _random(seed, 3)
    solids: list[Solid] = [rectangle((0.0, 0.0, 0.0), (600.0, 600.0), reflectivity=0.2)]
    for _ in range(objects):
        angle, distance = random.uniform(0.0, 2.0 * np.pi), random.uniform(12.0, 45.0)
        x, y = distance * np.cos(angle), distance * np.sin(angle)
        if random.uniform() < 0.5:
            size = random.uniform((2.0, 2.0, 2.0), (5.0, 4.0, 3.5))
            solids.append(box((x, y, 0.5 * size[2]), size, yaw=random.uniform(0.0, np.pi)))
        else:
            solids.append(cylinder((x, y, 0.0), random.uniform(0.15, 0.4), 3.0, reflectivity=0.3))
            solids.append(sphere((x, y, 4.0), random.uniform(1.2, 2.2), reflectivity=0.4))
    return World(solids)


def stairwell(storeys: int = 8) -> World:
    """A stairwell: two flights a storey around a wall, landings at y = ±2.2 m. `manoeuvres.climb` walks up in it.

    Flights rise along +y at x = −0.75 m and along −y at x = +0.75 m, half a storey each.
    """
    height = (storeys + 1) * STOREY_M
    solids = [box((0.0, 0.0, 0.5 * height - 0.1), (3.2, 5.8, height + 0.2), reflectivity=0.7)]
    solids.append(box((0.0, 0.0, 0.5 * height), (0.2, 2.6, height), reflectivity=0.6))
    steps, half = 9, 0.5 * STOREY_M
    for flight in range(2 * storeys):
        upwards = 1.0 if flight % 2 == 0 else -1.0
        for step in range(steps):
            y = upwards * (-1.4 + 2.8 * (step + 0.5) / steps)
            top = half * (flight + (step + 1) / steps)
            solids.append(box((-0.75 * upwards, y, top - 0.12), (1.3, 2.8 / steps, 0.24), reflectivity=0.5))
        solids.append(box((0.0, upwards * 2.15, half * (flight + 1) - 0.1), (3.2, 1.5, 0.2), reflectivity=0.5))
        solids.append(box((-1.5 * upwards, upwards * 2.7, half * (flight + 1) + 0.5), (0.2, 0.25, 0.9), reflectivity=0.8))
    return World(solids, cell_m=2.0)
