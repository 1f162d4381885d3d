"""What a run knows beside its scans and its IMU: loops, and positions by satellite."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RunLoops:
    """L loops between local maps of a run, of which there are n.

    Attributes:
        time_ns: (n,) ascending, of the frames of the local maps; T_imu_map: (n, 7) these frames in the IMU's at that time.
        place, query: (L,) numbers of local maps, the earlier one and the later one.
        T_place_query: (L, 7) measured; information: (L, 6, 6) of it, [w, v] on the right.
    """

    time_ns: Ints
    T_imu_map: Floats
    place: Ints
    query: Ints
    T_place_query: Floats
    information: Floats

    def __len__(self) -> int:
        return len(self.place)


@dataclass(frozen=True, slots=True, eq=False)
class Receiver:
    """Where the world of a run lies on the Earth, and what is known of the receiver that says so.

    Attributes:
        T_enu_world: (7,). lever: (3,) antenna in the IMU's frame [m]. delay_s: by which fixes are stamped late.
        sigma: (10,) standard deviations of T_enu_world [w, v], lever and delay; zero for what is held, NaN until they are known.
    """

    T_enu_world: Floats
    lever: Floats
    delay_s: float
    sigma: Floats


@dataclass(frozen=True, slots=True, eq=False)
class RunFixes:
    """N fixes that a run rests on.

    Attributes:
        time_ns: (N,) of them, in the clock of the LiDAR. p_enu: (N, 3) [m]; covariance: (N, 3, 3) as it is believed.
        start: the receiver as the run has it.
        lever_sigma: of a lever arm that nobody gave, about zero [m]; None where it was given.
        delay_sigma: of the delay, about zero [s]. vertical_sigma: of the run's vertical [rad].
    """

    time_ns: NDArray[np.int64]
    p_enu: Floats
    covariance: Floats
    start: Receiver
    lever_sigma: float | None
    delay_sigma: float
    vertical_sigma: float

    def __len__(self) -> int:
        return len(self.time_ns)
