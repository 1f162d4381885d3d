"""Other readings of a LiDAR whose points lie nowhere near what the first one saw: mounted another way up, in another unit.

That its points lie beside all surfaces of the first one proves nothing: the two may look at different things. But where they lie
on these surfaces once they are turned by quarters about the LiDAR's axes, or multiplied by a unit of length, and pose and clock
are determined there, it is that which was declared wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._words import signed
from boxplus.manifolds import so3
from boxplus.systems.several_lidars.motion import LidarMotion
from boxplus.systems.several_lidars.pair import PairFit, fit_pair
from boxplus.systems.several_lidars.surfaces import Surfaces

_UNITS = {
    0.3048: "in feet",
    0.001: "in millimetres",
    0.01: "in centimetres",
    1.0 / 0.3048: "divided by 3.28",
    1e3: "in kilometres",
}
_LOOKED = 800  # points, for a first look
_REACH_M, _ON_M = 1.0, 0.4  # of a plane, for that
_BEST, _LEAST_ON = 3, 0.2  # readings that are fitted after it, and the share of points on planes that is asked for
_LEAST_NEAR, _LEAST_FITTING = 0.4, 0.85


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Points p of a LiDAR read as factor · R p.

    Attributes:
        cause: what is declared wrongly; text: in words, with what to do.
    """

    R: NDArray[np.float64]
    factor: float
    cause: Literal["pose", "unit"]
    text: str


def other_reading(
    motion: LidarMotion,
    surfaces: Surfaces,
    p_other: NDArray[np.float64],
    time_ns: NDArray[np.int64],
    T_declared: NDArray[np.float64],
    largest_sigma: NDArray[np.float64],
) -> tuple[Reading, PairFit] | None:
    """The reading under which the points lie on the first LiDAR's surfaces, and how they fit there; None where none does.

    Args:
        motion, surfaces, p_other, time_ns, T_declared: as of `fit_pair`.
        largest_sigma: (7,) standard deviations, as of `PairFit.difference`, that are asked for.
    """
    some = slice(None, None, -(-len(p_other) // _LOOKED))
    seconds = (time_ns[some] - motion.begin_ns).astype(np.float64) * 1e-9
    R_world, p_world, _, _ = motion.at(np.clip(seconds, 0.0, motion.seconds))
    looked: list[tuple[float, Reading, NDArray[np.float64]]] = []
    for reading in _readings():
        T = T_declared.copy()
        T[:3, :3] = T_declared[:3, :3] @ reading.R
        m = reading.factor * p_other[some] @ T[:3, :3].T + T[:3, 3]
        has, _, r = surfaces.beside(np.einsum("nij,nj->ni", R_world, m) + p_world, _REACH_M)
        looked.append((float(np.count_nonzero(np.abs(r) < _ON_M)) / len(has), reading, T))
    looked.sort(key=lambda entry: -entry[0])
    found: list[tuple[float, Reading, PairFit]] = []
    for share, reading, T in looked[:_BEST]:
        if share < _LEAST_ON:
            break
        fit = fit_pair(motion, surfaces, reading.factor * p_other, time_ns, T)
        if fit is None or fit.near < _LEAST_NEAR or fit.fitting < _LEAST_FITTING:
            continue
        if (np.sqrt(np.diag(fit.covariance)) < largest_sigma).all():
            found.append((fit.near * fit.fitting, reading, fit))
    if not found:
        return None
    _, reading, fit = max(found, key=lambda entry: entry[0])
    return reading, fit


def _readings() -> Iterator[Reading]:
    """Every turn by quarters but none, and every unit of length but metres."""
    for axes, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        R = np.eye(3)[list(axes)] * np.array(signs)[:, None]
        if np.linalg.det(R) > 0.0 and not np.array_equal(R, np.eye(3)):
            theta = so3.log(R)
            angle = float(np.linalg.norm(theta))
            yield Reading(
                R, 1.0, "pose",
                f"once it is turned by {np.degrees(angle):.0f} deg about {signed(theta / angle, 2)} in its own frame: "
                "T_lidar_other is wrong by that (mounted upside down, or axes named otherwise)",
            )  # fmt: skip
    for factor, name in _UNITS.items():
        text = f"once they are multiplied by {factor:.4g}: they come {name}; give them in metres"
        yield Reading(np.eye(3), factor, "unit", text)
