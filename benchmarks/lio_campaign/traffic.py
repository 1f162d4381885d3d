"""Other vehicles on a road: beside the platform, ahead and behind, with it and against it, some of them at its own speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault
from lio_campaign.nuisances import Scene, changes, moved, rays

_LANE_M = 3.6
_LONG_M, _TRUCK_M, _WIDTH_M = 4.0, 16.0, 2.4
_ROAD_BELOW_M = 1.9  # the IMU is at most this high
_NEAREST_M = 3.0  # behind the one ahead, in the own lane
_OWN_PACE = 0.2  # share of roads on which those that go the same way keep the platform's pace
_AT_REST_M_S = 14.0


def traffic(scene: Scene, seed: int) -> Fault:
    """Traffic on lanes along x, for the whole recording.

    Args:
        scene: on a road along x.
        seed: of the recording; its other draws do not depend on this one.
    """
    random = np.random.Generator(np.random.PCG64([seed, 5]))
    truth = scene.truth
    span_s = (truth.end_ns - truth.start_ns) * 1e-9
    ends = truth.ground_truth(np.array([truth.start_ns, truth.end_ns], np.int64))
    way = float(ends.p_world_imu[1, 0] - ends.p_world_imu[0, 0])
    forwards, own = (1.0 if way >= 0.0 else -1.0), abs(way) / span_s
    fleet = _AT_REST_M_S if own < 1.0 else own * (1.0 if random.uniform() < _OWN_PACE else float(random.uniform(0.75, 1.25)))
    count = int(random.integers(4, 25))
    lane = random.choice((-2, -1, 0, 1, 2), count, p=(0.2, 0.3, 0.1, 0.3, 0.1))
    against = lane > 0
    scatter = random.uniform(0.0, 0.06)
    speed = fleet * random.uniform(1.0 - scatter, 1.0 + scatter, count) * np.where(against, -1.0, 1.0)
    length = random.uniform(_LONG_M, _TRUCK_M, count)
    height = np.where(length > 8.0, 3.9, 1.6)
    ahead, clear = random.uniform(-90.0, 90.0, count), 0.5 * length + _NEAREST_M
    ahead = np.where((lane == 0) & (np.abs(ahead) < clear), np.copysign(clear + 5.0, ahead), ahead)
    begin = ends.p_world_imu[0] + np.stack([ahead, forwards * _LANE_M * lane, np.full(count, -_ROAD_BELOW_M)], axis=1)
    low = np.stack([-0.5 * length, np.full(count, -0.5 * _WIDTH_M), np.zeros(count)], axis=1)
    high = np.stack([0.5 * length, np.full(count, 0.5 * _WIDTH_M), height], axis=1)

    def scan(scan: Scan) -> Scan:
        if not len(scan):
            return scan
        origin, direction, ranges = rays(scene, scan)
        seconds = (scan.time_ns - truth.start_ns) * 1e-9
        own_x = origin[:, 0] - ends.p_world_imu[0, 0]
        seen = ranges.copy()
        for k in range(count):
            # In the own lane a vehicle keeps its distance, whatever the platform does.
            away = origin - begin[k]
            away[:, 0] -= own_x if lane[k] == 0 else forwards * speed[k] * seconds
            facing = _facing(away, direction, low[k], high[k])
            hit = _entered(away[facing], direction[facing], low[k], high[k])
            seen[facing] = np.where((hit > 0.5) & (hit < seen[facing]), hit, seen[facing])
        return moved(scan, scan.p_lidar * (seen / ranges)[:, None])

    return changes("traffic", f"{count} vehicles at {fleet:.0f} m/s, platform at {own:.0f}", scan)


def _facing(
    origin: NDArray[np.float64], direction: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Which of the rays (N, 3) may enter a box, by the ball about it and about all of their origins."""
    middle = origin.mean(axis=0)
    to_box = 0.5 * (low + high) - middle
    reach = 0.5 * float(np.linalg.norm(high - low)) + float(np.linalg.norm(origin - middle, axis=1).max())
    beside_sq = float(to_box @ to_box) - reach**2
    return np.flatnonzero(direction @ to_box > np.sqrt(beside_sq)) if beside_sq > 0.0 else np.arange(len(direction))


def _entered(
    origin: NDArray[np.float64], direction: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far along rays (N, 3) a box (3,), (3,) is entered (N,), inf where it is not: by the three pairs of its sides."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - origin) / direction, (high - origin) / direction
    # Along the sides of a box that they touch rays have no number: the other two pairs tell.
    enter = np.fmax.reduce(np.minimum(first, second), axis=1)
    leave = np.fmin.reduce(np.maximum(first, second), axis=1)
    return np.where((enter < leave) & (enter > 0.0), enter, np.inf)
