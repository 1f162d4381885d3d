"""Roads of the campaign and what goes fast on them: cut into from the first sample on, or taken from rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import sites
from lio_campaign.places import Place

_SHORT_M, _LONG_M = 700.0, 1600.0  # a street, in which nobody is faster than 25 m/s, and the others


def _long_street(random: np.random.Generator) -> Place:
    world = sites.street(_SHORT_M, seed=int(random.integers(1 << 30)))
    return Place(world, (-330.0, -1.5, 1.4), (330.0, 1.5, 2.4), long=True)


def _highway(random: np.random.Generator) -> Place:
    world = sites.highway(_LONG_M, seed=int(random.integers(1 << 30)))
    return Place(world, (-780.0, -4.0, 1.4), (780.0, 4.0, 2.4), long=True, featureless=True)


def _long_tunnel(random: np.random.Generator) -> Place:
    world = sites.tunnel(_LONG_M, lamp_spacing=float(random.uniform(8.0, 20.0)))
    return Place(world, (-780.0, -2.2, 1.4), (780.0, 2.2, 2.4), long=True, featureless=True)


PLACES: dict[str, Callable[[np.random.Generator], Place]] = {
    "long_street": _long_street,
    "highway": _highway,
    "long_tunnel": _long_tunnel,
}

MOTIONS: dict[str, tuple[str, ...]] = {
    "fast_constant": ("long_street", "highway", "long_tunnel"),
    "fast_drive": ("long_street", "highway", "highway", "long_tunnel"),
    "fast_from_rest": ("long_street", "highway", "long_tunnel"),
}
"""The roads that suit each motion."""


def fast_motion(motion: str, world: str, place: Place, duration_s: float, random: np.random.Generator) -> Trajectory:
    """A motion along the road at up to 33 m/s; it may be longer than asked for."""
    speed = float(random.uniform(8.0, 20.0 if world == "long_street" else 33.0))
    height, seed = random.uniform(1.5, 2.2), int(random.integers(1 << 30))
    if motion == "fast_constant":
        x = random.uniform(place.low[0] + 0.5 * speed * duration_s, place.high[0] - 0.5 * speed * duration_s)
        forwards = random.choice((-1.0, 1.0))
        begin = (x - 0.5 * forwards * speed * duration_s, random.uniform(place.low[1], place.high[1]), height)
        attitude = manoeuvres.level(random.uniform(-np.pi, np.pi), *random.uniform(-0.1, 0.1, 2))
        return manoeuvres.constant_velocity(duration_s, begin, (forwards * speed, 0.0, 0.0), attitude)
    rest_s = float(random.uniform(1.5, 3.0))
    corners = int(random.choice((2, 6)))  # straight on, or slowing down to 5 m/s four times
    begin_x = place.low[0]
    if motion == "fast_from_rest":
        begin_x += random.uniform(0.0, 0.9) * (place.high[0] - place.low[0] - speed * duration_s)
    x = np.linspace(begin_x, place.high[0], corners)
    route = np.stack([x, random.uniform(place.low[1], place.high[1], corners)], axis=1)
    if motion == "fast_from_rest":
        return trajectories.drive(route, speed, height, rest_s, seed)
    drive = trajectories.drive(route, speed, height, 0.0, seed)
    latest = drive.duration_s - speed / 2.0 - duration_s  # brakes at 2 m/s²
    earliest = min(0.7 * speed / 2.0, latest)  # may still accelerate
    return drive.starting_at(float(random.uniform(earliest, latest)))
