"""Motions to record: a walk, a drive, flights and tests of endurance. All begin at rest unless they say otherwise.

Every function returns control poses on a manifold spline, so ground truth is exact whatever the shape of the motion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation.motions.spline import SplineTrajectory

Floats = NDArray[np.float64]

START_NS = 1_700_000_000_000_000_000
"""First instant of the built-in motions."""

_EASE_S = 0.4
"""Time over which an oscillation fades in after the standstill."""


def walk(
    route_xy: ArrayLike, speed: float = 1.4, height: float = 1.6, standstill_s: float = 2.0, seed: int = 0
) -> SplineTrajectory:
    """A person walks along a route with a hand-held sensor: bobbing, swaying, looking about.

    Args:
        route_xy: (W, 2) corners of the route in the world [m].
        speed: pace between corners [m/s].
        height: of the sensor above z = 0 [m].
        standstill_s: rest before the first step [s].
        seed: phases of the sway.
    """
    time, p, yaw, moving = along_route(route_xy, speed, 1.2, 1.0, 2.0, standstill_s, 0.04)
    random = np.random.Generator(np.random.PCG64([seed, 0]))
    phase = random.uniform(0.0, 2.0 * np.pi, 6)
    step = 2.0 * np.pi * 1.8 * time
    lateral = 0.02 * moving * np.sin(0.5 * step + phase[0])
    p[:, 0] -= lateral * np.sin(yaw)
    p[:, 1] += lateral * np.cos(yaw)
    p[:, 2] = height + 0.02 * moving * np.sin(step + phase[1])
    roll = moving * (0.03 * np.sin(0.5 * step + phase[2]) + 0.03 * np.sin(0.9 * time + phase[3]))
    pitch = moving * (0.02 * np.sin(step + phase[4]) + 0.04 * np.sin(0.7 * time + phase[5]))
    yaw = yaw + moving * 0.12 * np.sin(0.8 * time + phase[0])
    return SplineTrajectory(START_NS, 0.04, from_angles(roll, pitch, yaw), p)


def drive(
    route_xy: ArrayLike, speed: float = 11.0, height: float = 1.8, standstill_s: float = 2.0, seed: int = 0
) -> SplineTrajectory:
    """A car drives along a route, slower in corners, with road vibration, pitch under acceleration and roll in turns.

    Args:
        route_xy: (W, 2) corners of the route in the world [m].
        speed: highest speed [m/s].
        height: of the IMU above z = 0 [m].
        standstill_s: rest before starting [s].
        seed: phases of the vibration.
    """
    time, p, yaw, moving = along_route(route_xy, speed, 9.0, 2.0, 2.5, standstill_s, 0.05)
    random = np.random.Generator(np.random.PCG64([seed, 1]))
    phase = random.uniform(0.0, 2.0 * np.pi, 4)
    velocity = np.gradient(p[:, :2], 0.05, axis=0)
    acceleration = np.gradient(velocity, 0.05, axis=0)
    forward = acceleration[:, 0] * np.cos(yaw) + acceleration[:, 1] * np.sin(yaw)
    leftward = -acceleration[:, 0] * np.sin(yaw) + acceleration[:, 1] * np.cos(yaw)
    p[:, 2] = height + moving * (
        0.012 * np.sin(2 * np.pi * 1.3 * time + phase[0]) + 0.006 * np.sin(2 * np.pi * 2.1 * time + phase[1])
    )
    roll = 0.012 * leftward + moving * 0.006 * np.sin(2 * np.pi * 0.9 * time + phase[2])
    pitch = -0.010 * forward + moving * 0.008 * np.sin(2 * np.pi * 1.2 * time + phase[3])
    return SplineTrajectory(START_NS, 0.05, from_angles(roll, pitch, yaw), p)


def at_rest(duration_s: float = 10.0, p_world_imu: ArrayLike = (0.0, 0.0, 1.5)) -> SplineTrajectory:
    """No motion at all."""
    time = control_times(duration_s, 0.1)
    p = np.broadcast_to(np.asarray(p_world_imu, dtype=np.float64), (len(time), 3))
    return SplineTrajectory(START_NS, 0.1, np.broadcast_to(np.eye(3), (len(time), 3, 3)), p)


def spin_in_place(
    duration_s: float = 20.0, rate: float = np.deg2rad(90.0), p_world_imu: ArrayLike = (0.0, 0.0, 1.5), standstill_s: float = 2.0
) -> SplineTrajectory:
    """A turn about the vertical at `rate` [rad/s] without leaving the spot."""
    time = control_times(duration_s, 0.05)
    moving = fade_in(time, standstill_s, 1.0)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (moving[1:] + moving[:-1]) * 0.05)]) * rate
    p = np.broadcast_to(np.asarray(p_world_imu, dtype=np.float64), (len(time), 3))
    return SplineTrajectory(START_NS, 0.05, from_angles(0.0 * yaw, 0.0 * yaw, yaw), p)


def flips(
    flips: int = 6, rate: float = np.deg2rad(1000.0), p_world_imu: ArrayLike = (0.0, 0.0, 2.0), standstill_s: float = 2.0
) -> SplineTrajectory:
    """Full turns about the x and y axes in turn, with peak rate `rate` [rad/s] and a pause of 0.8 s between them."""
    knot_s, pause_s = 0.01, 0.8
    turn_s = 4.0 * np.pi / rate  # a raised cosine has twice its mean rate at the peak
    time = control_times(standstill_s + flips * (turn_s + pause_s) + 1.0, knot_s)
    R = np.broadcast_to(np.eye(3), (len(time), 3, 3)).copy()
    for number in range(flips):
        u = np.clip((time - standstill_s - number * (turn_s + pause_s)) / turn_s, 0.0, 1.0)
        angle = 2.0 * np.pi * u - np.sin(2.0 * np.pi * u)
        axis = np.array([1.0, 0.0, 0.0]) if number % 2 == 0 else np.array([0.0, 1.0, 0.0])
        R = R @ so3.exp(angle[:, None] * axis)
    moving = fade_in(time, standstill_s, 1.0)
    since = time - standstill_s
    sway = np.stack([0.5 * np.sin(1.7 * since), 0.4 * np.sin(1.3 * since), 0.5 * np.sin(2.1 * since)], axis=1)
    return SplineTrajectory(START_NS, knot_s, R, np.asarray(p_world_imu, dtype=np.float64) + moving[:, None] * sway)


def fast(
    duration_s: float = 30.0, speed: float = 7.0, rate: float = np.deg2rad(100.0), standstill_s: float = 2.0
) -> SplineTrajectory:
    """A figure of eight with peak speed `speed` [m/s] while the heading swings with peak rate `rate` [rad/s]."""
    knot_s, pulse = 0.04, 0.5
    time = control_times(duration_s, knot_s)
    moving = fade_in(time, standstill_s, 3.0)
    phase = pulse * np.concatenate([[0.0], np.cumsum(0.5 * (moving[1:] + moving[:-1]) * knot_s)])
    # (a sin φ, b sin 2φ) has its highest speed pulse·√(a² + 4 b²) at φ = 0.
    b = 4.0
    a = np.sqrt((speed / pulse) ** 2 - 4.0 * b * b)
    p = np.stack([a * np.sin(phase), b * np.sin(2.0 * phase), 2.5 + 0.8 * np.sin(1.5 * phase)], axis=1)
    yaw = rate / (2.2 * pulse) * np.sin(2.2 * phase)
    roll, pitch = 0.35 * np.sin(2.0 * phase), 0.25 * np.sin(1.4 * phase)
    return SplineTrajectory(START_NS, knot_s, from_angles(roll, pitch, yaw), p)


def drone(duration_s: float = 60.0, speed: float = 3.0, height: float = 8.0, standstill_s: float = 2.0) -> SplineTrajectory:
    """A drone hovers, then flies loops with peak speed near `speed` [m/s], tilting as its thrust demands."""
    knot_s = 0.05
    time = control_times(duration_s, knot_s)
    moving = fade_in(time, standstill_s, 3.0)
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (moving[1:] + moving[:-1]) * knot_s)]) * speed
    p = np.stack(
        [
            14.0 * np.sin(travelled / 14.0),
            9.0 * np.sin(travelled / 19.0),
            height + 1.2 * np.sin(travelled / 9.0),
        ],
        axis=1,
    )
    acceleration = np.gradient(np.gradient(p, knot_s, axis=0), knot_s, axis=0)
    yaw = 0.6 * np.sin(travelled / 11.0)
    forward = acceleration[:, 0] * np.cos(yaw) + acceleration[:, 1] * np.sin(yaw)
    leftward = -acceleration[:, 0] * np.sin(yaw) + acceleration[:, 1] * np.cos(yaw)
    # A multicopter accelerates by tilting its thrust: specific force stays along the body's z axis.
    return SplineTrajectory(START_NS, knot_s, from_angles(-leftward / 9.81, forward / 9.81, yaw), p)


def control_times(duration_s: float, knot_s: float, beyond: int = 1) -> Floats:
    """Times of the control poses of a motion of `duration_s`, relative to its start.

    `beyond` are those before its start and after its end: one for cubic splines, two for quintic ones.
    """
    if not duration_s > 0:
        raise InputError("a positive duration [s]", f"{duration_s}", "give the length of the motion")
    return np.arange(-beyond, int(np.ceil(duration_s / knot_s - 1e-9)) + beyond + 1, dtype=np.float64) * knot_s


STEEPEST = 1.875  # slope of `fade_in` at its middle, times the seconds that it takes


def fade_in(time: Floats, start_s: float, ease_s: float = _EASE_S) -> Floats:
    """0 until `start_s`, 1 from `start_s + ease_s` on, with continuous acceleration between."""
    u = np.clip((time - start_s) / ease_s, 0.0, 1.0)
    faded: Floats = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    return faded


def from_angles(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """R_world_imu (K, 3, 3): yaw about z, then pitch about y, then roll about x."""
    zero = np.zeros_like(yaw)
    R: Floats = (
        so3.exp(np.stack([zero, zero, yaw], 1))
        @ so3.exp(np.stack([zero, pitch, zero], 1))
        @ so3.exp(np.stack([roll, zero, zero], 1))
    )
    return R


def along_route(
    route_xy: ArrayLike, speed: float, radius: float, acceleration: float, lateral: float, standstill_s: float, knot_s: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Control positions along a polyline with rounded corners.

    Args:
        route_xy: (W, 2) corners [m].
        speed, acceleration, lateral: limits of the speed [m/s], along and across the path [m/s²].
        radius: of the corners [m].
        standstill_s: rest at the start and half as long at the end [s].
        knot_s: time between control poses [s].

    Returns:
        time (K,), positions (K, 3) with z = 0, heading (K,), and how much the body moves, 0 to 1 (K,).
    """
    corners = np.asarray(route_xy, dtype=np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2:
        raise InputError("a route of at least two corners (W, 2)", f"shape {corners.shape}", "give x, y of every corner")
    path, curvature, heading = rounded(corners, radius)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    limit = np.minimum(speed, np.sqrt(lateral / np.maximum(curvature, 1e-9)))
    limit[0] = limit[-1] = 0.0
    for order in (range(1, len(path)), range(len(path) - 2, -1, -1)):
        for i in order:
            before = i - 1 if order.step > 0 else i + 1
            ds = steps[min(i, before)]
            limit[i] = min(limit[i], np.sqrt(limit[before] ** 2 + 2.0 * acceleration * ds))
    arrival = np.concatenate([[0.0], np.cumsum(2.0 * steps / (limit[1:] + limit[:-1]))])

    smooth_s = 0.6
    time = control_times(standstill_s + arrival[-1] + 0.5 * standstill_s + smooth_s, knot_s)
    departure = standstill_s + 0.5 * smooth_s
    window = np.hanning(round(smooth_s / knot_s) // 2 * 2 + 3)[1:-1]
    window /= window.sum()
    at = np.interp(time - departure, arrival, np.arange(len(path), dtype=np.float64))
    columns = [np.interp(at, np.arange(len(path)), values) for values in (path[:, 0], path[:, 1], heading)]
    pad = len(window) // 2
    x, y, yaw = (np.convolve(np.pad(column, pad, mode="edge"), window, mode="valid") for column in columns)
    moving = fade_in(time, departure) * (1.0 - fade_in(time, departure + arrival[-1] - _EASE_S))
    return time, np.stack([x, y, np.zeros_like(x)], axis=1), yaw, moving


def rounded(corners: Floats, radius: float, spacing: float = 0.1) -> tuple[Floats, Floats, Floats]:
    """Points about `spacing` apart on the polyline with arcs for corners, with their curvature and heading."""
    xy: list[Floats] = [corners[:1]]
    curvatures: list[Floats] = [np.zeros(1)]
    headings: list[Floats] = []
    legs = np.diff(corners, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    directions = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    headings.append(directions[:1])
    begin = corners[0]
    for i, direction in enumerate(directions):
        turn = directions[i + 1] - direction if i + 1 < len(directions) else 0.0
        cut = radius * abs(np.tan(0.5 * turn))
        if cut > 0.5 * lengths[i] or (i + 1 < len(lengths) and cut > 0.5 * lengths[i + 1]):
            raise InputError(
                f"legs at least twice as long as the {cut:.1f} m that rounding a corner takes",
                f"a leg of {min(lengths[i], lengths[min(i + 1, len(lengths) - 1)]):.1f} m",
                "move the corners of the route apart",
            )
        unit = np.array([np.cos(direction), np.sin(direction)])
        end = corners[i + 1] - cut * unit
        count = max(int(np.linalg.norm(end - begin) / spacing), 1)
        xy.append(begin + (np.arange(1, count + 1) / count)[:, None] * (end - begin))
        curvatures.append(np.zeros(count))
        headings.append(np.full(count, direction))
        begin = end
        if turn:
            count = max(int(radius * abs(turn) / spacing), 2)
            angle = direction + turn * np.arange(1, count + 1) / count
            side = np.sign(turn) * radius
            centre = end + side * np.array([-np.sin(direction), np.cos(direction)])
            xy.append(centre + side * np.stack([np.sin(angle), -np.cos(angle)], axis=1))
            curvatures.append(np.full(count, 1.0 / radius))
            headings.append(angle)
            begin = xy[-1][-1]
    return np.concatenate(xy), np.concatenate(curvatures), np.concatenate(headings)
