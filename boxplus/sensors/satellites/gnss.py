"""Positions by satellite: a block of fixes as a receiver reports them, cleaned of what is no position."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError

NO_FIX = -1
STATUS_NAMES = {NO_FIX: "no fix", 0: "fix", 1: "with SBAS", 2: "with a base station"}
"""Status of sensor_msgs/NavSatStatus."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """N positions of an antenna, in order of time.

    Attributes:
        time_ns: (N,) int64, strictly ascending, in the clock of the recording.
        lat_lon_alt: (N, 3) latitude, longitude [°], height above the ellipsoid of WGS84 [m].
        covariance: (N, 3, 3) along east, north and up [m²]; NaN where the receiver tells none.
        status: (N,) int8 as in sensor_msgs/NavSatStatus: 0 autonomous, 1 with SBAS, 2 with a base station (RTK, DGNSS).
        rejected: fixes left out by reason.
    """

    time_ns: NDArray[np.int64]
    lat_lon_alt: NDArray[np.float64]
    covariance: NDArray[np.float64]
    status: NDArray[np.int8]
    rejected: Counter[str] = field(default_factory=Counter)

    def __len__(self) -> int:
        return len(self.time_ns)

    @classmethod
    def from_arrays(
        cls,
        time_ns: ArrayLike,
        lat_lon_alt: ArrayLike,
        covariance: ArrayLike | None = None,
        status: ArrayLike | None = None,
    ) -> GnssFixes:
        """Check and order fixes; those that are no position are left out and counted in `rejected`.

        Left out are fixes without a position (status below 0, NaN, or 0°, 0° exactly, which receivers report before their first
        one), beyond 90° or 180°, and repeated times.

        Args:
            time_ns: (N,). lat_lon_alt: (N, 3). covariance: (N, 3, 3), NaN or zero where unknown; None: unknown everywhere.
            status: (N,); None: 0 everywhere.

        Raises:
            InputError: arrays whose shapes do not match.
        """
        t = np.atleast_1d(np.asarray(time_ns, dtype=np.int64))
        count = len(t)
        lla = (
            np.asarray(lat_lon_alt, dtype=np.float64).reshape(-1, 3)
            if count == 0
            else np.atleast_2d(np.array(lat_lon_alt, float))
        )
        cov = np.full((count, 3, 3), np.nan) if covariance is None else np.array(covariance, dtype=np.float64)
        state = np.zeros(count, np.int8) if status is None else np.asarray(status).astype(np.int8)
        if t.ndim != 1 or lla.shape != (count, 3) or cov.shape != (count, 3, 3) or state.shape != (count,):
            raise InputError(
                "time_ns (N,), lat_lon_alt (N, 3), covariance (N, 3, 3), status (N,)",
                f"{t.shape}, {lla.shape}, {cov.shape}, {state.shape}", "give one row of each for every fix",
            )  # fmt: skip
        rejected: Counter[str] = Counter()
        keep = np.ones(count, dtype=np.bool_)
        with np.errstate(invalid="ignore"):
            for reason, bad in (
                ("no fix", state < 0),
                ("not finite", ~np.isfinite(lla).all(axis=1)),
                ("0°, 0°: no position yet", (lla[:, :2] == 0.0).all(axis=1)),
                ("beyond 90° of latitude or 180° of longitude", (np.abs(lla[:, 0]) > 90.0) | (np.abs(lla[:, 1]) > 180.0)),
            ):
                if found := int((keep & bad).sum()):
                    rejected[reason] = found
                    keep &= ~bad
        order = np.flatnonzero(keep)[np.argsort(t[keep], kind="stable")]
        again = np.concatenate([[False], np.diff(t[order]) == 0]) if len(order) else np.zeros(0, np.bool_)
        if again.any():
            rejected["repeated time"] = int(again.sum())
            order = order[~again]
        cov = cov[order]
        diagonal = np.diagonal(cov, axis1=1, axis2=2)
        with np.errstate(invalid="ignore"):
            is_known = np.isfinite(cov).all(axis=(1, 2)) & (diagonal > 0.0).all(axis=1)
        cov[~is_known] = np.nan
        return cls(t[order], lla[order], 0.5 * (cov + cov.transpose(0, 2, 1)), state[order], rejected)

    @property
    def has_covariance(self) -> NDArray[np.bool_]:
        """(N,) where the receiver says how good its position is."""
        return np.asarray(np.isfinite(self.covariance[:, 0, 0]))

    def shifted(self, offset_ns: int) -> GnssFixes:
        """With this added to all times [ns]."""
        return GnssFixes(self.time_ns + offset_ns, self.lat_lon_alt, self.covariance, self.status, self.rejected)

    def selected(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> GnssFixes:
        """These rows only."""
        return GnssFixes(self.time_ns[rows], self.lat_lon_alt[rows], self.covariance[rows], self.status[rows], self.rejected)


def antenna_offset(text: str) -> NDArray[np.float64]:
    """Position (3,) of an antenna in the IMU's frame [m], from a text such as `0.1,0,0.85`.

    Raises:
        InputError: something else than three numbers.
    """
    try:
        offset = as_floats([float(part) for part in text.replace(",", " ").split()], "lever arm")
    except ValueError:
        offset = np.empty(0)
    if offset.shape != (3,) or not (np.abs(offset) < 100.0).all():
        raise InputError("a lever arm x,y,z in metres, in the IMU's frame", repr(text), "write --gnss-lever-arm 0.1,0,0.85")
    return offset
