"""Drives whose odometry drifts, as graphs of local maps without points, with fixes along the truth."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.simulation.drifting_drive import DriftConfig, simulate_drift
from boxplus.simulation.gnss import GnssConfig, simulate_gnss
from boxplus.systems.georeference.georeference import Georeference
from boxplus.systems.slam.graph import MapGraph

ORIGIN = EnuFrame(49.01, 8.43, 116.0)
LAPS = [[0, 0], [120, 0], [120, 90], [0, 90], [0, 0], [120, 0], [120, 60]]
_SCANS_OF_A_MAP = 20
_LONGEST_MAP = 5.0  # s
_STEP_NS = 200_000_000
_STANDS_NS = 5_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    time_ns: NDArray[np.int64]
    T_enu_imu: NDArray[np.float64]
    T_odo_imu: NDArray[np.float64]
    graph: MapGraph
    at: NDArray[np.intp]

    def fixes(self, config: GnssConfig, seed: int = 1) -> GnssFixes:
        return simulate_gnss(self.time_ns, self.T_enu_imu, ORIGIN, config, seed)

    def off(self, found: Georeference) -> NDArray[np.float64]:
        """(n,) distance of the local maps from where they are on the ground [m]; nothing is aligned."""
        assert found.fit is not None and found.frame is not None
        p = se3.compose(found.fit.T_enu_map, found.fit.T_map)[:, 4:]
        truth = found.frame.to_enu(ORIGIN.to_geodetic(self.T_enu_imu[self.at, 4:]))
        return np.asarray(np.linalg.norm((p - truth)[:, :2], axis=1))


def drive(route: ArrayLike, seed: int = 1, config: DriftConfig | None = None, stops: Sequence[tuple[float, float]] = ()) -> Drive:
    """Args: stops: (share of the poses before it, how long it lasts [s]) where the platform stands."""
    config = config if config is not None else DriftConfig()
    time_ns, truth, odometry, covariance = simulate_drift(route, config, seed)
    random = np.random.default_rng(seed)
    yaw = random.uniform(-np.pi, np.pi)
    T_enu = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), *random.uniform(-50.0, 50.0, 3)])
    for share, seconds in stops:
        stands = np.arange(len(time_ns)) > int(share * (len(time_ns) - 1))
        time_ns = time_ns + (seconds * 1e9 * stands).astype(np.int64)
    scans = min(_SCANS_OF_A_MAP, max(int(_LONGEST_MAP * config.speed), 2))
    at = np.arange(min(scans // 2, len(time_ns) - 1), len(time_ns), scans)
    steps = [np.zeros((6, 6))]
    for a, b in itertools.pairwise(at):
        Ad = se3.adjoint(se3.compose(se3.inverse(truth[b]), truth[a]))  # P was made along the truth
        steps.append(covariance[b] - Ad @ covariance[a] @ Ad.T + 1e-8 * np.eye(6))
    graph = MapGraph(time_ns[at], odometry[at], odometry[at], np.stack(steps))
    # An odometry that stands goes on: poses at its rate in between.
    every = np.unique(np.concatenate([time_ns, np.arange(time_ns[0], time_ns[-1], _STEP_NS)]))
    of = np.searchsorted(time_ns, every, side="right") - 1
    stood = np.append(np.diff(time_ns) > _STANDS_NS, False)[of]
    kept = np.isin(every, time_ns) | stood
    every, of = every[kept], of[kept]
    return Drive(every, se3.compose(T_enu, truth)[of], odometry[of], graph, np.searchsorted(every, time_ns[at]))
