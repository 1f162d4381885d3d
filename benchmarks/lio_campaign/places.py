"""Worlds of the campaign, each with the space in it that is free to move in, and the motions that fit them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import World

CLEARANCE_M = 0.35
_TRIES = 20


@dataclass(frozen=True)
class Place:
    """A world and where to move in it.

    Attributes:
        world: what there is to see.
        low, high: (3,) corners of a box of free space [m].
        long: the box is a lane along x.
        featureless: the LiDAR may rightly call its information weak here.
    """

    world: World
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    long: bool = False
    featureless: bool = False


def _room(random: np.random.Generator) -> Place:
    size = (random.uniform(8.0, 14.0), random.uniform(7.0, 10.0), random.uniform(3.0, 4.5))
    x, y = 0.2 * size[0], 0.18 * size[1]
    return Place(worlds.room(size, int(random.integers(1 << 30))), (-x, -y, 1.1), (x, y, min(2.4, size[2] - 0.8)))


def _hall(random: np.random.Generator) -> Place:
    return Place(worlds.hall(seed=int(random.integers(1 << 30))), (-18.0, -7.0, 1.5), (18.0, 7.0, 7.0))


def _warehouse(random: np.random.Generator) -> Place:
    world = sites.warehouse(random.uniform(34.0, 50.0), seed=int(random.integers(1 << 30)))
    return Place(world, (-14.0, -0.9, 1.0), (14.0, 0.9, 5.0), long=True)


def _corridor(random: np.random.Generator) -> Place:
    world = worlds.corridor(400.0, random.uniform(2.2, 3.0), random.uniform(2.4, 3.0))
    return Place(world, (-40.0, -0.4, 1.1), (40.0, 0.4, 1.8), long=True, featureless=True)


def _street(random: np.random.Generator) -> Place:
    return Place(sites.street(seed=int(random.integers(1 << 30))), (-125.0, -2.0, 1.3), (125.0, 2.0, 6.0), long=True)


def _tunnel(random: np.random.Generator) -> Place:
    spacing = float(random.uniform(8.0, 20.0)) if random.uniform() < 0.5 else None
    return Place(sites.tunnel(500.0, lamp_spacing=spacing), (-200.0, -2.2, 1.3), (200.0, 2.2, 4.0), long=True, featureless=True)


def _forest(random: np.random.Generator) -> Place:
    return Place(sites.forest(seed=int(random.integers(1 << 30))), (-3.0, -3.0, 1.1), (3.0, 3.0, 3.0))


def _open_field(random: np.random.Generator) -> Place:
    world = sites.open_field(int(random.integers(3, 8)), int(random.integers(1 << 30)))
    return Place(world, (-5.5, -5.5, 1.2), (5.5, 5.5, 5.0), featureless=True)


def _stairwell(random: np.random.Generator) -> Place:
    del random
    return Place(sites.stairwell(), (-1.2, -2.4, 1.2), (1.2, -1.7, 1.7))


PLACES: dict[str, Callable[[np.random.Generator], Place]] = {
    "room": _room,
    "hall": _hall,
    "warehouse": _warehouse,
    "corridor": _corridor,
    "street": _street,
    "tunnel": _tunnel,
    "forest": _forest,
    "open_field": _open_field,
    "stairwell": _stairwell,
}

MOTIONS: dict[str, tuple[str, ...]] = {
    "rest_then_walk": ("room", "hall", "warehouse", "corridor", "street", "forest", "stairwell"),
    "handheld": ("room", "hall", "warehouse", "corridor", "forest", "open_field"),
    "drone": ("room", "hall", "warehouse", "street", "tunnel", "forest", "open_field"),
    "vehicle": ("street", "hall", "tunnel"),
    "constant_velocity": ("warehouse", "corridor", "street", "tunnel", "hall"),
    "constant_turn": ("room", "hall", "forest", "open_field"),
    "lift": ("room", "hall", "warehouse", "street"),
    "midflight": ("room", "hall", "warehouse", "street", "tunnel", "forest", "stairwell"),
    "vibration": ("room", "hall", "street", "forest", "open_field", "corridor", "stairwell"),
}
"""The worlds that suit each motion."""


DrawMotion = Callable[[str, str, Place, float, np.random.Generator], Trajectory]
"""Draws a motion of a kind in a world, at its place, for so many seconds or longer."""


def make_motion(
    draw: DrawMotion, motion: str, world: str, place: Place, duration_s: float, random: np.random.Generator
) -> Trajectory:
    """A motion in free space, drawn again until it keeps its distance from every surface; it may be longer than asked for.

    Raises:
        RuntimeError: none was found, the box of the place is not free.
    """
    for _ in range(_TRIES):
        trajectory = draw(motion, world, place, duration_s, random)
        instants = np.arange(trajectory.start_ns, trajectory.start_ns + round(duration_s * 1e9), 20_000_000)
        path = trajectory.evaluate(instants[instants <= trajectory.end_ns]).p_world_imu
        if place.world.distance(path).min() > CLEARANCE_M:
            return trajectory
    raise RuntimeError(f"no free course for {motion} in {world}")


def usual_motion(motion: str, world: str, place: Place, duration_s: float, random: np.random.Generator) -> Trajectory:
    """A motion of `MOTIONS`."""
    seed = int(random.integers(1 << 30))
    rest = float(random.uniform(1.5, 3.0))
    if motion == "rest_then_walk":
        return _walk(world, place, duration_s, rest, random)
    if motion == "handheld":
        speed, rate = random.uniform(0.4, 1.5), random.uniform(0.5, 2.0)
        return manoeuvres.handheld(duration_s, place.low, place.high, speed, rate, rest, seed)
    if motion == "drone":
        speed = random.uniform(0.5, 1.2) if world in ("room", "forest") else random.uniform(1.0, 4.0)
        return manoeuvres.drone_within(duration_s, place.low, place.high, speed, rest, seed)
    if motion == "vehicle":
        return _drive(world, place, duration_s, rest, random)
    if motion == "constant_velocity":
        return _straight(place, duration_s, random)
    if motion == "constant_turn":
        radius = random.uniform(0.6, 1.0) * min(place.high[0], place.high[1])
        rate = random.choice((-1.0, 1.0)) * random.uniform(0.15, min(0.9, 4.0 / radius))
        centre = (0.0, 0.0, random.uniform(place.low[2], place.high[2]))
        return manoeuvres.constant_turn(duration_s, centre, radius, rate, random.uniform(-0.1, 0.1, 2))
    if motion == "lift":
        return _lift(place, duration_s, random)
    if motion == "midflight":
        return _midflight(world, place, duration_s, seed, random)
    if motion == "vibration":
        return _vibrating(place, duration_s, seed, random)
    raise ValueError(motion)


def _walk(world: str, place: Place, duration_s: float, rest_s: float, random: np.random.Generator) -> Trajectory:
    speed, seed = random.uniform(0.7, 1.5), int(random.integers(1 << 30))
    if world == "stairwell":
        return manoeuvres.climb(duration_s, speed=random.uniform(0.4, 0.7), standstill_s=rest_s, seed=seed)
    height = random.uniform(1.3, 1.7)
    if place.long or world == "forest":
        length = speed * duration_s + 4.0
        begin = -0.5 * length + random.uniform(-3.0, 3.0)
        y = random.uniform(-0.3, 0.3)
        return trajectories.walk(((begin, y), (begin + length, y)), speed, height, rest_s, seed)
    x, y = place.high[0] - 0.2, max(place.high[1], 1.3)
    loop = [(x, -y), (x, y), (-x, y), (-x, -y)]
    loops = int(speed * duration_s / (4.0 * (x + y))) + 1
    return trajectories.walk([(-x, -y), *(loop * loops)][:-1] if loops > 1 else [(-x, -y), *loop], speed, height, rest_s, seed)


def _drive(world: str, place: Place, duration_s: float, rest_s: float, random: np.random.Generator) -> Trajectory:
    speed, height, seed = random.uniform(3.0, 12.0), random.uniform(1.4, 2.2), int(random.integers(1 << 30))
    if world == "hall":
        x, y, speed = 18.0, 10.0, min(speed, 5.0)
        loop = [(x, -y), (x, y), (-x, y), (-x, -y)]
        loops = int(speed * duration_s / 90.0) + 1
        return trajectories.drive([(-4.0 - x, -y), *(loop * loops)][:-1], speed, height, rest_s, seed)
    reach = min(speed * duration_s + 20.0, place.high[0] - place.low[0] - 10.0)
    begin = random.uniform(place.low[0] + 5.0, place.high[0] - 5.0 - reach)
    middle = random.uniform(-1.2, 1.2, 2)
    route = ((begin, 0.0), (begin + 0.35 * reach, middle[0]), (begin + 0.7 * reach, middle[1]), (begin + reach, 0.0))
    return trajectories.drive(route, speed, height, rest_s, seed)


def _straight(place: Place, duration_s: float, random: np.random.Generator) -> Trajectory:
    low, high = np.array(place.low), np.array(place.high)
    speed = random.uniform(0.3, 0.95) * min((high[0] - low[0]) / duration_s, 10.0)
    begin = np.array([-0.5 * speed * duration_s, random.uniform(0.5 * low[1], 0.5 * high[1]), random.uniform(low[2], high[2])])
    forwards = random.choice((-1.0, 1.0))
    begin[0] *= forwards
    attitude = manoeuvres.level(random.uniform(-np.pi, np.pi), *random.uniform(-0.1, 0.1, 2))
    return manoeuvres.constant_velocity(duration_s, begin, (forwards * speed, 0.0, 0.0), attitude)


def _lift(place: Place, duration_s: float, random: np.random.Generator) -> Trajectory:
    low, high = np.array(place.low), np.array(place.high)
    begin = 0.5 * random.uniform(low, high)
    rise = high[2] - low[2]
    upwards = random.uniform() < 0.5
    begin[2] = low[2] if upwards else high[2]
    rest = random.uniform(1.5, 3.0)
    speed = max(random.uniform(0.3, 1.5), rise * trajectories.STEEPEST / (duration_s - rest - 2.0))
    rest = max(rest, duration_s - 1.0 - rise / speed * trajectories.STEEPEST)
    attitude = manoeuvres.level(random.uniform(-np.pi, np.pi), *random.uniform(-0.05, 0.05, 2))
    return manoeuvres.lift(begin, rise if upwards else -rise, speed, rest, attitude)


def _midflight(world: str, place: Place, duration_s: float, seed: int, random: np.random.Generator) -> Trajectory:
    if world == "stairwell":
        return manoeuvres.climb(duration_s + 5.0, speed=0.6, seed=seed).starting_at(4.0)
    kind = random.uniform()
    if world in ("street", "tunnel") and kind < 0.5:
        drive = trajectories.drive(((place.low[0] + 5.0, 0.0), (place.high[0] - 5.0, 0.5)), random.uniform(5.0, 11.0), seed=seed)
        return drive.starting_at(random.uniform(5.0, 8.0))
    if kind < 0.5:
        return manoeuvres.drone_within(duration_s, place.low, place.high, random.uniform(0.6, 1.5), 0.0, seed)
    rate = random.uniform(0.7, 2.0)
    return manoeuvres.handheld(duration_s, place.low, place.high, random.uniform(0.5, 1.4), rate, 0.0, seed)


def _vibrating(place: Place, duration_s: float, seed: int, random: np.random.Generator) -> Trajectory:
    """Standing with running motors: for good, or until it moves off."""
    if random.uniform() < 0.5:
        return trajectories.at_rest(duration_s, 0.5 * np.add(place.low, place.high))
    rest = random.uniform(3.0, 6.0)
    return manoeuvres.handheld(duration_s, place.low, place.high, random.uniform(0.4, 1.0), random.uniform(0.3, 1.0), rest, seed)
