"""How clear the decision between inliers and outliers was: what can be said of it without knowing the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_cdf, chi_square_quantile

_TAIL = 0.9  # quantile of the inliers' distribution above which kept residuals are compared with how many there should be
_NEAR = 1.2  # a refused residual up to this many thresholds is a close call


@dataclass(frozen=True, slots=True)
class InlierReport:
    """The decision on a group of residuals.

    Attributes:
        innovations: (N,) ‖W r‖ at the solution, in standard deviations; infinite where it cannot be evaluated.
        kept, refused: residuals within the threshold, and the others.
        close: of the refused, those within 1.2 thresholds.
        mean_square: of ‖W r‖² over the kept, per row: 1 where the sigmas are right, less by what the solution has fitted to them.
        purity: share of the kept that the noise explains: one less what lies between the 90 % quantile of χ²(dim) and the
            threshold beyond the number that should. Outliers that the solution has bent itself to lie anywhere, and show here.
    """

    innovations: NDArray[np.float64]
    kept: int
    refused: int
    close: int
    mean_square: float
    purity: float

    def sentence(self, name: str) -> str:
        """`1,204 of 2,000 loops kept, …`."""
        return (
            f"{self.kept:,} of {self.kept + self.refused:,} {name} kept, {self.refused:,} refused ({self.close:,} of these close "
            f"calls); mean square of the kept {self.mean_square:.2f}, the noise explains {100.0 * self.purity:.1f} % of them"
        )


def inlier_report(
    squares: NDArray[np.float64], dim: int, threshold: float, kept_ones: NDArray[np.bool_] | None = None
) -> InlierReport:
    """Of ‖W r‖² (N,) of residuals with `dim` rows, kept up to `threshold` standard deviations or as `kept_ones` (N,) says."""
    within = squares <= threshold**2 if kept_ones is None else kept_ones
    kept = int(np.count_nonzero(within))
    tail = chi_square_quantile(_TAIL, dim)
    inside = chi_square_cdf(threshold**2, dim)
    expected = kept * max(1.0 - _TAIL / inside, 0.0) if inside > 0.0 else 0.0
    excess = max(np.count_nonzero(within & (squares > tail)) - expected, 0.0)
    return InlierReport(
        innovations=np.sqrt(squares),
        kept=kept,
        refused=len(squares) - kept,
        close=int(np.count_nonzero(~within & (squares <= (_NEAR * threshold) ** 2))),
        mean_square=float(squares[within].sum()) / max(kept * dim, 1),
        purity=1.0 - excess / max(kept, 1),
    )
