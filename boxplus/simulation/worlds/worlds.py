"""Worlds to record in, each reproducible from its seed. The ground is z = 0."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from boxplus.simulation.worlds.world import Solid, World, box, cylinder, rectangle, sphere


def _random(seed: int, stream: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64([seed, 100 + stream]))


def room(size: tuple[float, float, float] = (12.0, 9.0, 4.0), seed: int = 0) -> World:
    """A furnished room around the origin: walls, columns, shelves, tables."""
    random = _random(seed, 0)
    width, depth, height = size
    solids = [box((0.0, 0.0, 0.5 * height), size, reflectivity=0.8)]
    for x, y in ((-0.3, 0.32), (0.32, -0.3)):
        solids.append(cylinder((x * width, y * depth, 0.0), 0.25, height))
    for side in (-1.0, 1.0):
        for x in np.arange(-0.4 * width, 0.4 * width, 2.2):
            tall = random.uniform(0.8, 0.7 * height)
            centre = (x + random.uniform(-0.3, 0.3), side * (0.5 * depth - 0.25), 0.5 * tall)
            solids.append(box(centre, (random.uniform(0.8, 1.6), 0.5, tall), reflectivity=random.uniform(0.2, 0.9)))
    for _ in range(5):
        angle = random.uniform(0.0, 2.0 * np.pi)
        x, y = 0.32 * width * np.cos(angle), 0.3 * depth * np.sin(angle)
        solids.append(box((x, y, 0.4), (1.4, 0.8, 0.8), yaw=random.uniform(0.0, np.pi), reflectivity=0.4))
    return World(solids, cell_m=2.0)


def corridor(length: float = 400.0, width: float = 2.4, height: float = 2.6) -> World:
    """A smooth tube along x: nothing tells how far one has come."""
    return World([box((0.0, 0.0, 0.5 * height), (length, width, height))])


def hall(size: tuple[float, float, float] = (60.0, 40.0, 12.0), seed: int = 0) -> World:
    """A factory hall around the origin: columns, machines along the walls, crates."""
    random = _random(seed, 1)
    width, depth, height = size
    solids = [box((0.0, 0.0, 0.5 * height), size, reflectivity=0.7)]
    for x in np.arange(-0.42 * width, 0.45 * width, 10.0):
        for y in (-0.36 * depth, 0.36 * depth):
            solids.append(box((x, y, 0.5 * height), (0.6, 0.6, height)))
            tall = random.uniform(1.5, 5.0)
            centre = (x + random.uniform(2.5, 6.0), 1.18 * y, 0.5 * tall)
            solids.append(box(centre, (random.uniform(2.0, 5.0), 2.5, tall), yaw=random.uniform(-0.2, 0.2)))
        solids.append(box((x, 0.0, height - 0.4), (0.5, depth, 0.8)))
    for _ in range(12):
        side = random.choice((-1.0, 1.0))
        x, y = random.uniform(-0.45, 0.45) * width, side * random.uniform(0.24, 0.32) * depth
        solids.append(box((x, y, 0.6), random.uniform(0.8, 2.0, 3) * (1, 1, 0.75), yaw=random.uniform(0.0, np.pi)))
    return World(solids)


def yard(side: float = 120.0, seed: int = 0) -> World:
    """A cargo yard around the origin: flat ground, containers at odd angles, tanks and heaps, under the open sky."""
    random = _random(seed, 2)
    solids = [rectangle((0.0, 0.0, 0.0), (2.0 * side, 2.0 * side), reflectivity=0.3)]
    for x in np.arange(-0.5 * side, 0.5 * side, 6.0):
        for y in np.arange(-0.5 * side, 0.5 * side, 6.0):
            centre = np.array([x, y]) + random.uniform(-1.2, 1.2, 2)
            if random.uniform() < 0.15:
                continue
            if random.uniform() < 0.25:
                solids.append(cylinder((*centre, 0.0), random.uniform(0.4, 1.3), random.uniform(0.6, 3.0)))
            else:
                size = random.uniform((1.0, 1.0, 0.4), (4.0, 2.4, 3.2))
                solids.append(
                    box((*centre, 0.5 * size[2]), size, yaw=random.uniform(0.0, np.pi), reflectivity=random.uniform(0.2, 0.9))
                )
    return World(solids)


def city(
    columns: int = 3,
    rows: int = 3,
    pitch: float = 60.0,
    street: float = 18.0,
    squares: Collection[tuple[int, int]] = (),
    arcades: Collection[tuple[float, float, float, float]] = (),
    seed: int = 0,
) -> World:
    """Blocks of buildings between streets.

    The middles of the streets are the lines x = i · pitch and y = j · pitch for i = 0 … columns, j = 0 … rows; block (i, j) lies
    beyond x = i · pitch and y = j · pitch. A ring of blocks closes the outside. The middle of every street is free of obstacles:
    8 m in streets of 18 m, 1 m in alleys of 6 m.

    Args:
        columns, rows: number of blocks inside of the ring.
        pitch: distance between streets [m].
        street: width between facing fronts [m].
        squares: blocks that are open squares with a market hall, a fountain, trees and stalls.
        arcades: stretches of street under a roof, as low x, low y, high x, high y [m].
        seed: everything else.
    """
    random = _random(seed, 3)
    extent = np.array([(columns + 2) * pitch, (rows + 2) * pitch])
    middle = 0.5 * np.array([columns * pitch, rows * pitch])
    solids = [rectangle((*middle, 0.0), extent + 200.0, reflectivity=0.2)]
    for i in range(-1, columns + 1):
        for j in range(-1, rows + 1):
            low = np.array([i, j]) * pitch + 0.5 * street
            high = low + pitch - street
            if (i, j) in squares:
                solids += _square(random, low, high)
            else:
                solids += _block(random, low, high)
            solids += pavements(random, low, high, street)
    for arcade in arcades:
        solids += _arcade(*arcade)
    return World(solids)


def _arcade(low_x: float, low_y: float, high_x: float, high_y: float) -> list[Solid]:
    """A flat roof with beams across, on columns along both sides."""
    low, size = np.array([low_x, low_y]), np.array([high_x - low_x, high_y - low_y])
    middle = low + 0.5 * size
    solids = [box((*middle, 4.25), (*size, 0.3), reflectivity=0.7)]
    along = int(np.argmax(size))
    for position in np.arange(1.0, size[along], 3.5):
        place, extent = middle.copy(), size.copy()
        place[along] = low[along] + position
        extent[along] = 0.3
        solids.append(box((*place, 3.9), (*extent, 0.4), reflectivity=0.4))
        for side in (-0.5, 0.5):
            foot = place.copy()
            foot[1 - along] += side * (size[1 - along] - 2.0)
            solids.append(cylinder((*foot, 0.0), 0.2, 3.8, reflectivity=0.8))
    return solids


def _block(random: np.random.Generator, low: np.ndarray, high: np.ndarray) -> list[Solid]:
    """Houses around the edge of a block, with set-back fronts, bays, balconies and chimneys."""
    solids: list[Solid] = []
    lots = np.maximum(np.rint((high - low) / 14.0).astype(int), 1)
    size = (high - low) / lots
    for i in range(lots[0]):
        for j in range(lots[1]):
            if 0 < i < lots[0] - 1 and 0 < j < lots[1] - 1:
                continue  # the yard in the middle is never seen
            if random.uniform() < 0.03:
                solids += _trees(random, low + size * (i + 0.25, j + 0.25), low + size * (i + 0.75, j + 0.75), 4)
                continue
            set_back = random.uniform(0.0, 1.8, 4)
            corner_low = low + size * (i, j) + set_back[:2] * (i == 0, j == 0)
            corner_high = low + size * (i + 1, j + 1) - set_back[2:] * (i == lots[0] - 1, j == lots[1] - 1)
            solids += house(random, corner_low, corner_high)
    return solids


def house(random: np.random.Generator, low: np.ndarray, high: np.ndarray) -> list[Solid]:
    """A house on the lot between two corners (2,): bays, balconies or pilasters on every front, a cornice."""
    storeys = int(random.integers(2, 7))
    height = 3.2 * storeys + 0.8
    centre, size = 0.5 * (low + high), high - low
    colour = random.uniform(0.3, 0.9)
    solids = [box((*centre, 0.5 * height), (*size, height), reflectivity=colour)]
    for axis, side in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        along = 1 - axis
        style = random.integers(0, 3)
        for offset in np.arange(-0.5 * size[along] + 2.0, 0.5 * size[along] - 1.5, random.uniform(3.2, 5.0)):
            place = centre.copy()
            place[along] += offset
            place[axis] += side * 0.5 * size[axis]
            extent = np.empty(2)
            if style == 0:  # bay windows from the first floor to the roof
                extent[axis], extent[along] = 1.2, 1.8
                solids.append(box((*place, 0.5 * (height + 3.0)), (*extent, height - 3.0), reflectivity=colour))
            elif style == 1:  # balconies
                extent[axis], extent[along] = 1.6, 2.2
                for storey in range(1, storeys):
                    solids.append(box((*place, 3.2 * storey + 0.5), (*extent, 1.1), reflectivity=0.6))
            else:  # pilasters
                extent[axis], extent[along] = 0.6, 0.5
                solids.append(box((*place, 0.5 * height), (*extent, height), reflectivity=colour))
        cornice = np.where(np.arange(2) == axis, 0.9, size[along])
        place = centre.copy()
        place[axis] += side * 0.5 * size[axis]
        solids.append(box((*place, height - 0.3), (*cornice, 0.6), reflectivity=colour))
    return solids


def _trees(random: np.random.Generator, low: np.ndarray, high: np.ndarray, count: int) -> list[Solid]:
    solids: list[Solid] = []
    for x, y in random.uniform(low, high, (count, 2)):
        solids += _tree(random, x, y)
    return solids


def _tree(random: np.random.Generator, x: float, y: float) -> list[Solid]:
    trunk = random.uniform(2.5, 4.0)
    solids = [cylinder((x, y, 0.0), random.uniform(0.12, 0.3), trunk, reflectivity=0.3)]
    for _ in range(3):
        offset = random.uniform(-0.7, 0.7, 3)
        solids.append(sphere((x + offset[0], y + offset[1], trunk + 0.9 + offset[2]), random.uniform(0.8, 1.5), reflectivity=0.4))
    return solids


def _car(random: np.random.Generator, x: float, y: float, yaw: float) -> list[Solid]:
    yaw += random.normal(0.0, 0.03)
    long, paint = random.uniform(3.8, 5.0), random.uniform(0.1, 0.9)
    back = -0.3 * np.array([np.cos(yaw), np.sin(yaw)])
    return [
        box((x, y, 0.62), (long, 1.8, 0.75), yaw=yaw, reflectivity=paint),
        box((x + back[0], y + back[1], 1.25), (0.5 * long, 1.6, 0.55), yaw=yaw, reflectivity=0.3),
    ]


def pavements(random: np.random.Generator, low: np.ndarray, high: np.ndarray, street: float) -> list[Solid]:
    """What stands along the four edges of a block: parked cars at the kerb, then trees, lamps, boxes and stalls."""
    solids: list[Solid] = []
    kerb, walkway = 0.5 * street - 5.2, min(1.5, 0.17 * street)
    for axis, edge, outwards in ((0, low, -1.0), (0, high, 1.0), (1, low, -1.0), (1, high, 1.0)):
        along = 1 - axis
        position = low[along] + random.uniform(1.0, 4.0)
        while position < high[along] - 2.0:
            kind = random.uniform()
            place = np.empty(2)
            place[along] = position
            if kind < 0.35 and kerb > 2.0:
                place[axis] = edge[axis] + outwards * (0.5 * street - 5.2)
                solids += _car(random, place[0], place[1], 0.0 if along == 0 else 0.5 * np.pi)
            else:
                place[axis] = edge[axis] + outwards * (walkway + random.uniform(-0.3, 0.3))
                if kind < 0.6:
                    solids += _tree(random, place[0], place[1])
                elif kind < 0.8:
                    solids.append(cylinder((*place, 0.0), 0.09, random.uniform(4.0, 7.0), reflectivity=0.9))
                else:
                    size = random.uniform((0.5, 0.5, 0.5), (1.8, 1.2, 2.0))
                    solids.append(box((*place, 0.5 * size[2]), size, yaw=random.uniform(0.0, np.pi)))
            position += random.uniform(3.0, 7.0)
    return solids


def _square(random: np.random.Generator, low: np.ndarray, high: np.ndarray) -> list[Solid]:
    """An open square: a market hall (a roof on columns), a fountain, trees and stalls."""
    middle, size = 0.5 * (low + high), high - low
    hall = low + 0.25 * size
    roof = np.array([0.3, 0.3]) * size
    solids = [box((*hall, 5.3), (*roof, 0.6), reflectivity=0.7)]
    for x in np.linspace(-0.45, 0.45, 4):
        for y in (-0.45, 0.45):
            solids.append(cylinder((hall[0] + x * roof[0], hall[1] + y * roof[1], 0.0), 0.3, 5.0))
    basin = middle + 0.22 * size
    solids.append(cylinder((*basin, 0.0), 3.0, 0.7, reflectivity=0.6))
    solids.append(cylinder((*basin, 0.0), 0.5, 3.0, reflectivity=0.8))
    solids += _trees(random, low + size * (0.55, 0.1), low + size * (0.9, 0.4), 6)
    for x, y in random.uniform(low + size * (0.1, 0.6), low + size * (0.45, 0.9), (7, 2)):
        solids.append(box((x, y, 1.2), random.uniform((1.5, 1.5, 2.4), (3.5, 2.5, 2.4)), yaw=random.uniform(0.0, np.pi)))
    return solids
