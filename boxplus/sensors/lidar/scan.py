"""What a LiDAR delivers: points with a time each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_array
from boxplus.errors import InputError


@dataclass(frozen=True, slots=True)
class Scan:
    """One sweep of a LiDAR: only valid points, with everything that belongs to a point kept in step.

    Attributes:
        p_lidar: (N, 3) float32, LiDAR frame [m].
        time_ns: (N,) int64, absolute time of each point [ns].
        intensity: (N,) float32 or None, in the sensor's own unit.
        start_ns, end_ns: first and last instant of the sweep (of its points, rejected ones included).
        rejected: how many points were dropped on construction, by reason.
        lidar: (N,) uint8, which LiDAR saw each point, where several were merged (docs/several_lidars.md); None: all the same.

    Example:
        >>> scan = bp.Scan.from_arrays([[4.0, 1.0, 0.2], [0.1, 0.0, 0.0]], [1_000_000_000, 1_000_050_000], min_range=0.5)
        >>> len(scan), dict(scan.rejected)
        (1, {'nearer than min_range': 1})
    """

    p_lidar: NDArray[np.float32]
    time_ns: NDArray[np.int64]
    intensity: NDArray[np.float32] | None
    start_ns: int
    end_ns: int
    rejected: Mapping[str, int] = field(default_factory=dict)
    lidar: NDArray[np.uint8] | None = None

    @classmethod
    def from_arrays(
        cls,
        p_lidar: ArrayLike,
        time_ns: ArrayLike,
        intensity: ArrayLike | None = None,
        *,
        min_range: float = 0.0,
        max_range: float = np.inf,
        lidar: ArrayLike | None = None,
    ) -> Scan:
        """Build a scan from arrays and drop, together with all that belongs to them, the points that are not returns.

        Args:
            p_lidar: (N, 3), LiDAR frame, metres.
            time_ns: (N,) integers, absolute nanoseconds, in any order.
            intensity: (N,) or None.
            min_range: points nearer than this are dropped (the robot itself) [m].
            max_range: points farther than this are dropped [m].
            lidar: (N,) which of several LiDARs saw each point, 0 to 255, or None.

        Raises:
            InputError: wrong shape, counts that do not match, or times that are not integers.
        """
        points = as_array(p_lidar, "p_lidar")
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
            raise InputError(
                "p_lidar as numbers of shape (N, 3)", f"{points.dtype} of shape {points.shape}", "give one row x, y, z per point"
            )
        time = as_array(time_ns, "time_ns")
        if time.dtype.kind not in "iu" or time.shape != (len(points),):
            raise InputError(
                f"time_ns as integer nanoseconds of shape ({len(points)},), one per point",
                f"{time.dtype} of shape {time.shape}",
                "give every point its own absolute time; points without times cannot be corrected for motion",
            )
        time = time.astype(np.int64, copy=False)
        strength = None
        if intensity is not None:
            given = as_array(intensity, "intensity")
            if given.shape != (len(points),) or given.dtype.kind not in "fiu":
                raise InputError(
                    f"intensity as numbers of shape ({len(points)},), one per point",
                    f"{given.dtype} of shape {given.shape}",
                    "give one value per point or None",
                )
            strength = given.astype(np.float32)
        numbers = None if lidar is None else as_array(lidar, "lidar")
        if numbers is not None and (numbers.shape != time.shape or numbers.dtype.kind not in "iu"):
            got = f"{numbers.dtype} of shape {numbers.shape}"
            raise InputError(f"lidar as integers of shape {time.shape}, as time_ns", got, "give one number a point, or none")
        if numbers is not None and len(numbers) and not (numbers.min() >= 0 and numbers.max() <= 255):
            raise InputError("numbers of LiDARs from 0 to 255", f"{numbers.min()} to {numbers.max()}", "count them from 0")
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is counted so
            xyz = points.astype(np.float32, copy=False)
        squared = np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64)
        not_finite = ~np.isfinite(squared)
        zero = squared == 0.0
        near = (squared < min_range**2) & ~zero
        far = (squared > max_range**2) & ~not_finite
        keep = ~(not_finite | zero | near | far)
        rejected = {
            reason: count
            for reason, count in (
                ("not finite", int(not_finite.sum())),
                ("zero (no return)", int(zero.sum())),
                ("nearer than min_range", int(near.sum())),
                ("farther than max_range", int(far.sum())),
            )
            if count
        }
        start, end = (int(time.min()), int(time.max())) if len(time) else (0, 0)
        if rejected:
            xyz, time = xyz[keep], time[keep]
            strength = None if strength is None else strength[keep]
            numbers = None if numbers is None else numbers[keep]
        seen_by = None if numbers is None else np.ascontiguousarray(numbers, dtype=np.uint8)
        return cls(np.ascontiguousarray(xyz), np.ascontiguousarray(time), strength, start, end, rejected, seen_by)

    def shifted(self, offset_ns: int) -> Scan:
        """The same scan, this much later [ns]."""
        return replace(self, time_ns=self.time_ns + offset_ns, start_ns=self.start_ns + offset_ns, end_ns=self.end_ns + offset_ns)

    def where(self, keep: NDArray[np.bool_]) -> Scan:
        """Only the points chosen by (N,) bool; start, end and what was dropped on construction stay."""
        return replace(
            self,
            p_lidar=self.p_lidar[keep],
            time_ns=self.time_ns[keep],
            intensity=None if self.intensity is None else self.intensity[keep],
            lidar=None if self.lidar is None else self.lidar[keep],
        )

    def of_lidar(self, index: int) -> Scan:
        """Only what this one of several LiDARs saw; without `lidar` all points are those of the first one, 0."""
        return self.where(np.full(len(self), index == 0) if self.lidar is None else self.lidar == index)

    def without_strays(self, longest_ns: int = 1_000_000_000) -> Scan:
        """A scan that takes longer than this has points with impossible times: only those near the median time are kept [ns]."""
        if self.end_ns - self.start_ns <= longest_ns or not len(self):
            return self
        middle = int(np.partition(self.time_ns, len(self) // 2)[len(self) // 2])
        kept = self.where(np.abs(self.time_ns - middle) < longest_ns // 2)
        return replace(kept, start_ns=int(kept.time_ns.min()), end_ns=int(kept.time_ns.max()))

    def __len__(self) -> int:
        return int(self.time_ns.size)


def in_order(scans: Iterable[Scan]) -> list[Scan]:
    """The scans that end after all before them: what is recorded twice, or comes late, is left out.

    Example:
        >>> from boxplus.sensors.lidar.scan import in_order
        >>> first = bp.Scan.from_arrays([[4.0, 1.0, 0.2]], [1_000_000_000])
        >>> len(in_order([first, first, first.shifted(100_000_000)]))
        2
    """
    kept: list[Scan] = []
    for scan in scans:
        if not kept or scan.end_ns > kept[-1].end_ns:
            kept.append(scan)
    return kept
