"""Single manoeuvres: what a platform does for some seconds within free space. `trajectories` has whole journeys."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation.motions.spline import SplineTrajectory
from boxplus.simulation.motions.thrust import ThrustTrajectory
from boxplus.simulation.motions.trajectories import START_NS, STEEPEST, along_route, control_times, fade_in, from_angles
from boxplus.simulation.worlds.sites import STOREY_M

Floats = NDArray[np.float64]

_KNOT_S = 0.05


def constant_velocity(duration_s: float, p_start: ArrayLike, velocity: ArrayLike, R_world_imu: ArrayLike) -> SplineTrajectory:
    """Straight on from the first sample to the last: no acceleration, no rotation, as on a train.

    Args:
        duration_s: length [s].
        p_start: (3,) position at the first instant [m].
        velocity: (3,) in the world [m/s].
        R_world_imu: (3, 3) attitude, constant.
    """
    time = control_times(duration_s, 0.5)
    p = np.asarray(p_start, dtype=np.float64) + time[:, None] * np.asarray(velocity, dtype=np.float64)
    return SplineTrajectory(START_NS, 0.5, np.broadcast_to(np.asarray(R_world_imu, dtype=np.float64), (len(time), 3, 3)), p)


def constant_turn(
    duration_s: float, centre: ArrayLike, radius: float, rate: float, tilt: ArrayLike = (0.0, 0.0)
) -> SplineTrajectory:
    """A level circle at a constant rate from the first sample on, the heading along it.

    The circle is that of the spline: the acceleration follows that of an exact one to 1e-3 of it.

    Args:
        duration_s: length [s].
        centre: (3,) of the circle [m].
        radius: [m].
        rate: about the vertical, positive counter-clockwise [rad/s].
        tilt: (2,) constant roll and pitch of the IMU [rad].
    """
    time = control_times(duration_s, _KNOT_S)
    angle = rate * time
    offset = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    yaw = angle + np.copysign(0.5 * np.pi, rate)
    roll, pitch = np.asarray(tilt, dtype=np.float64)
    R = from_angles(np.full_like(yaw, roll), np.full_like(yaw, pitch), yaw)
    return SplineTrajectory(START_NS, _KNOT_S, R, np.asarray(centre, dtype=np.float64) + offset)


def lift(
    p_start: ArrayLike, rise: float, speed: float = 1.5, standstill_s: float = 2.0, R_world_imu: ArrayLike | None = None
) -> SplineTrajectory:
    """Rest, a ride straight up or down without any rotation, rest.

    Args:
        p_start: (3,) position at rest [m].
        rise: way up, negative for down [m].
        speed: highest speed [m/s].
        standstill_s: rest before; a second follows after.
        R_world_imu: (3, 3) attitude, level when not given.
    """
    ride_s = abs(rise) / speed * STEEPEST
    time = control_times(standstill_s + ride_s + 1.0, _KNOT_S)
    p = np.broadcast_to(np.asarray(p_start, dtype=np.float64), (len(time), 3)).copy()
    p[:, 2] += rise * fade_in(time, standstill_s, ride_s)
    R = np.eye(3) if R_world_imu is None else np.asarray(R_world_imu, dtype=np.float64)
    return SplineTrajectory(START_NS, _KNOT_S, np.broadcast_to(R, (len(time), 3, 3)), p)


def handheld(
    duration_s: float,
    low: ArrayLike,
    high: ArrayLike,
    speed: float = 1.0,
    rate: float = 1.0,
    standstill_s: float = 2.0,
    seed: int = 0,
) -> SplineTrajectory:
    """A sensor in a hand that wanders through a box and turns about all axes.

    Args:
        duration_s: length [s].
        low, high: (3,) corners of the box it stays in [m].
        speed: highest possible [m/s].
        rate: about the largest turn rate [rad/s].
        standstill_s: rest before; 0 begins in full motion.
        seed: course, attitude and phases.
    """
    random = np.random.Generator(np.random.PCG64([seed, 10]))
    time = control_times(duration_s, 0.04)
    course = _travelled(time, standstill_s)
    p = _wandering(course, low, high, speed, random)
    angles = []
    for largest, slowest, fastest in ((0.35, 0.4, 1.2), (0.35, 0.4, 1.2), (1.6, 0.05, 0.2)):
        frequency, phase = 2.0 * np.pi * random.uniform(slowest, fastest), random.uniform(0.0, 2.0 * np.pi)
        amplitude = min(largest, 0.7 * rate / frequency)
        angles.append(amplitude * np.sin(frequency * course + phase))
    roll, pitch, yaw = angles
    return SplineTrajectory(START_NS, 0.04, from_angles(roll, pitch, yaw + random.uniform(-np.pi, np.pi)), p)


def drone_within(
    duration_s: float,
    low: ArrayLike,
    high: ArrayLike,
    speed: float = 2.0,
    standstill_s: float = 2.0,
    seed: int = 0,
) -> ThrustTrajectory:
    """A multicopter that wanders through a box; its specific force lies along its z axis at every instant.

    Args:
        duration_s: length [s].
        low, high: (3,) corners of the box it stays in [m].
        speed: highest possible [m/s].
        standstill_s: rest before (level); 0 begins in full flight.
        seed: course and phases.
    """
    random = np.random.Generator(np.random.PCG64([seed, 11]))
    knot_s = 0.1
    time = control_times(duration_s, knot_s, beyond=2)
    course = _travelled(time, standstill_s)
    p = _wandering(course, low, high, speed, random)
    frequency, phase = 2.0 * np.pi * random.uniform(0.03, 0.12), random.uniform(0.0, 2.0 * np.pi)
    yaw = random.uniform(-np.pi, np.pi) + random.uniform(0.3, 1.2) * np.sin(frequency * course + phase)
    return ThrustTrajectory(START_NS, knot_s, p, yaw)


def climb(
    duration_s: float, start_half: int = 0, height: float = 1.5, speed: float = 0.6, standstill_s: float = 2.0, seed: int = 0
) -> SplineTrajectory:
    """A person walks up the flights of `sites.stairwell` with a hand-held sensor.

    Args:
        duration_s: length at least [s].
        start_half: number of half storeys below; even.
        height: of the sensor above the treads [m].
        speed: over the ground [m/s].
        standstill_s: rest before the first step [s].
        seed: phases of the sway.
    """
    if start_half % 2:
        raise InputError("an even number of half storeys to start from", f"{start_half}", "flights along +y begin a storey")
    loops = int(np.ceil(duration_s * speed / 9.0)) + 1
    loop = [(-0.75, 1.9), (0.75, 1.9), (0.75, -1.9), (-0.75, -1.9)]
    time, p, yaw, moving = along_route([(-0.75, -1.6), *(loop * loops)], speed, 0.6, 0.6, 0.5, standstill_s, 0.04)
    crossings = np.concatenate([[0], np.cumsum(np.abs(np.diff(np.sign(p[:, 0]))) > 0)])
    upwards = np.where(crossings % 2 == 0, 1.0, -1.0)
    flight = np.clip(0.5 + upwards * p[:, 1] / 2.8, 0.0, 1.0)
    window = np.hanning(13) / np.hanning(13).sum()
    climbed = start_half + np.convolve(np.pad(crossings + flight, 6, mode="edge"), window, mode="valid")
    p[:, 2] = height + 0.5 * STOREY_M * climbed
    phase = np.random.Generator(np.random.PCG64([seed, 12])).uniform(0.0, 2.0 * np.pi, 4)
    step = 2.0 * np.pi * 1.6 * time
    p[:, 2] += 0.02 * moving * np.sin(step + phase[0])
    roll = moving * 0.05 * np.sin(0.5 * step + phase[1])
    pitch = moving * 0.06 * np.sin(0.8 * time + phase[2])
    return SplineTrajectory(START_NS, 0.04, from_angles(roll, pitch, yaw + moving * 0.1 * np.sin(time + phase[3])), p)


def level(yaw: float, roll: float = 0.0, pitch: float = 0.0) -> Floats:
    """(3, 3) R_world_imu of an attitude [rad]: yaw about z, then pitch about y, then roll about x."""
    R: Floats = so3.exp(np.array([0.0, 0.0, yaw])) @ so3.exp(np.array([0.0, pitch, 0.0])) @ so3.exp(np.array([roll, 0.0, 0.0]))
    return R


def _travelled(time: Floats, standstill_s: float) -> Floats:
    """Time on the course: none at rest, then more and more, at last second by second; with 0 s of rest it is `time`."""
    if standstill_s <= 0.0:
        return time
    moving = fade_in(time, standstill_s, 1.5)
    step = time[1] - time[0]
    return np.concatenate([[0.0], np.cumsum(0.5 * (moving[1:] + moving[:-1]) * step)])


def _wandering(course: Floats, low: ArrayLike, high: ArrayLike, speed: float, random: np.random.Generator) -> Floats:
    """(K, 3) positions within a box: a sine an axis, each with about the same share of the speed."""
    lowest, highest = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if lowest.shape != (3,) or highest.shape != (3,) or not (lowest < highest).all():
        raise InputError("a box: low (3,) below high (3,) [m]", f"{lowest} and {highest}", "give two corners of free space")
    half = 0.5 * (highest - lowest)
    share = random.uniform(0.4, 1.0, 3)
    frequency = speed * share / np.linalg.norm(share) / half
    phase = random.uniform(0.0, 2.0 * np.pi, 3)
    positions: Floats = 0.5 * (lowest + highest) + half * np.sin(course[:, None] * frequency + phase)
    return positions
