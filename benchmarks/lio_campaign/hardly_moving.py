"""Platforms that hardly move: who stands sways, who hovers drifts, what creeps goes less than the noise from scan to scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.simulation.motions.spline import SplineTrajectory, Trajectory
from boxplus.simulation.motions.thrust import ThrustTrajectory
from boxplus.simulation.motions.trajectories import START_NS, STEEPEST, control_times, fade_in, from_angles
from lio_campaign.places import Place

Floats = NDArray[np.float64]

_INDOORS = ("room", "hall", "warehouse", "corridor")
MOTIONS: dict[str, tuple[str, ...]] = {
    "sway": (*_INDOORS, "street", "forest", "open_field", "stairwell"),
    "hover": ("room", "hall", "warehouse", "street", "forest", "open_field"),
    "creep": (*_INDOORS, "street", "tunnel"),
    "afloat": ("hall", "street", "open_field", "tunnel"),
    "pan": (*_INDOORS, "street", "forest", "stairwell"),
    "look_around": (*_INDOORS, "forest", "open_field", "stairwell"),
    "stop_and_go": (*_INDOORS, "street", "forest"),
}
"""The worlds that suit each motion."""

_KNOT_S = 0.04


def hardly_moving(motion: str, world: str, place: Place, duration_s: float, random: np.random.Generator) -> Trajectory:
    """A motion that goes a metre or two at most, or stops again and again; half of them begin at rest.

    `sway`: somebody stands with the sensor in the hand. `hover`: a multicopter holds its place, more or less. `creep`: straight
    ahead at 1 to 15 cm/s. `afloat`: rolls, pitches and heaves slowly. `pan`: turns on a tripod, sweep by sweep. `look_around`:
    turns in a hand about all axes. `stop_and_go`: walks some metres, stands, walks on.
    """
    del world
    rest_s = float(random.uniform(1.0, 3.0)) if random.uniform() < 0.5 else 0.0
    middle = np.array([*random.uniform(-0.3, 0.3, 2), random.uniform(1.2, 1.6)])
    if place.low[0] > 0.0 or place.high[1] < 0.0:  # the free box lies to one side
        middle = 0.5 * np.add(place.low, place.high)
    yaw = float(random.uniform(-np.pi, np.pi))
    if motion == "hover":
        return _hovering(middle, yaw, duration_s, rest_s, random)
    time = control_times(duration_s, _KNOT_S)
    begun = _begun(time, rest_s)
    p, angles = np.tile(middle, (len(time), 1)), np.zeros((len(time), 3))
    if motion == "sway":
        p += begun[:, None] * _waves(time, random.uniform(0.002, 0.03, 3) * (1.0, 1.0, 0.3), (0.2, 1.4), random)
        angles += begun[:, None] * _waves(time, np.radians(random.uniform(0.1, 3.0, 3)), (0.2, 1.4), random)
    elif motion == "creep":
        course = np.cumsum(begun) * _KNOT_S * random.uniform(0.01, 0.15)
        p[:, 0] += random.choice((-1.0, 1.0)) * course
        angles[:, 2] += begun * _waves(time, np.radians(random.uniform(0.0, 15.0, 1)), (0.03, 0.1), random)[:, 0]
    elif motion == "afloat":
        p += begun[:, None] * _waves(time, random.uniform(0.02, 0.2, 3), (0.1, 0.4), random)
        angles += begun[:, None] * _waves(time, np.radians(random.uniform(1.0, 8.0, 3)), (0.1, 0.4), random)
    elif motion == "pan":
        angles[:, 2] = _sweeps(time, rest_s, random)
    elif motion == "look_around":
        angles += begun[:, None] * _waves(time, random.uniform(0.1, (0.4, 0.4, 1.5)), (0.05, 0.5), random)
    elif motion == "stop_and_go":
        goes = _goes(time, rest_s, random)
        course = np.cumsum(goes) * _KNOT_S * random.uniform(0.4, 1.2)
        reach = 0.8 * (place.high[0] - middle[0])
        p[:, 0] = middle[0] + reach * np.sin(course / max(reach, 0.5))  # there and back
        angles[:, 2] += 0.3 * np.sin(0.7 * course)
        p += _waves(time, random.uniform(0.001, 0.01, 3), (0.3, 1.4), random)
        angles += _waves(time, np.radians(random.uniform(0.2, 2.0, 3)), (0.2, 1.4), random)
    else:
        raise ValueError(motion)
    R = from_angles(angles[:, 0], angles[:, 1], angles[:, 2])
    R = so3.exp(np.array([0.0, 0.0, yaw])) @ R
    if motion in ("pan", "look_around", "afloat"):  # the IMU is not where it turns about
        p += R @ random.uniform((-0.3, -0.3, -0.1), (0.3, 0.3, 0.1))
    return SplineTrajectory(START_NS, _KNOT_S, R, p)


def _begun(time: Floats, rest_s: float) -> Floats:
    """(K,) 0 at rest, 1 in motion, all along where there is no rest."""
    return np.ones_like(time) if rest_s == 0.0 else fade_in(time, rest_s, 1.5)


def _waves(time: Floats, amplitude: Floats, hertz: tuple[float, float], random: np.random.Generator) -> Floats:
    """(K, n) two sines a column within a band, which do not repeat."""
    out = np.zeros((len(time), len(amplitude)))
    for axis, size in enumerate(amplitude):
        for share in (0.7, 0.3):
            frequency, phase = 2.0 * np.pi * random.uniform(*hertz), random.uniform(0.0, 2.0 * np.pi)
            out[:, axis] += share * size * np.sin(frequency * time + phase)
    return out


def _sweeps(time: Floats, rest_s: float, random: np.random.Generator) -> Floats:
    """(K,) an angle that goes to and fro, with pauses."""
    angle, begin_s = np.zeros_like(time), rest_s
    while begin_s < time[-1]:
        by = random.choice((-1.0, 1.0)) * random.uniform(0.3, 3.0)
        lasts_s = STEEPEST * abs(by) / random.uniform(0.15, 1.2)
        angle += by * fade_in(time, begin_s, lasts_s)
        begin_s += lasts_s + random.uniform(0.0, 3.0)
    return angle


def _goes(time: Floats, rest_s: float, random: np.random.Generator) -> Floats:
    """(K,) 1 while walking, 0 while standing."""
    goes, begin_s = np.zeros_like(time), rest_s
    while begin_s < time[-1]:
        ends_s = begin_s + random.uniform(1.5, 4.0)
        goes += fade_in(time, begin_s, 0.8) - fade_in(time, ends_s, 0.8)
        begin_s = ends_s + 0.8 + random.uniform(1.0, 4.0)
    return goes


def _hovering(middle: Floats, yaw: float, duration_s: float, rest_s: float, random: np.random.Generator) -> ThrustTrajectory:
    knot_s = 0.1
    time = control_times(duration_s, knot_s, beyond=2)
    begun = _begun(time, rest_s)
    slow = _waves(time, random.uniform(0.03, 0.3, 3), (0.03, 0.25), random)
    quick = _waves(time, random.uniform(0.0, 0.02, 3), (0.4, 1.0), random)
    p = middle + begun[:, None] * (slow + quick)
    turning = begun * _waves(time, np.radians(random.uniform(1.0, 20.0, 1)), (0.05, 0.3), random)[:, 0]
    return ThrustTrajectory(START_NS, knot_s, p, yaw + turning)
