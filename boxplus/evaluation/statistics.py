"""The figures by which a list of errors is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def rms(errors: NDArray[np.float64]) -> float:
    """Root mean square of all given errors, at least one, in their unit."""
    return float(np.sqrt(np.mean(errors**2)))


@dataclass(frozen=True, slots=True)
class Statistics:
    """Figures of N errors, in the unit of the errors; `std` is that of the errors about their mean (divided by N)."""

    count: int
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: NDArray[np.float64]) -> Statistics:
        """The figures of (N,) errors, N ≥ 1."""
        return cls(
            count=len(errors),
            rmse=rms(errors),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
        )

    def line(self, unit: str) -> str:
        """All figures in one line, six decimals."""
        figures = ("rmse", "mean", "median", "max", "std")
        return ", ".join(f"{name} {getattr(self, name):.6f}" for name in figures) + f" {unit}"
