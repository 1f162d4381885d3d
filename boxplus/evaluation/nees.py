"""Whether covariances mean what they say: the normalised estimation error squared (Bar-Shalom et al. 2001, section 5.4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.errors import InputError


def nees(errors: ArrayLike, covariances: ArrayLike) -> NDArray[np.float64]:
    """εᵢ = eᵢᵀ Pᵢ⁻¹ eᵢ, chi-square distributed with d degrees of freedom when the covariances are right; its mean is d.

    Args:
        errors: (N, d) errors in the tangent the covariances belong to (rotations by ⊟, in the same frame and order).
        covariances: (N, d, d), symmetric positive definite.

    Raises:
        InputError: shapes that do not match, values that are not finite, or a covariance that is not positive definite.
    """
    e, P = np.asarray(errors, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    if e.ndim != 2 or P.shape != (*e.shape, e.shape[-1]):
        raise InputError(
            "errors of shape (N, d) and covariances of shape (N, d, d)",
            f"{e.shape} and {P.shape}",
            "give one of each per instant",
        )
    finite = np.isfinite(e).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
    if not finite.all():
        row = int(np.flatnonzero(~finite)[0])
        raise InputError("finite errors and covariances", f"NaN or infinity in row {row}", "find out why the estimator gave it")
    smallest = np.linalg.eigvalsh(P)[:, 0] if len(P) else np.ones(0)
    if (smallest <= 0.0).any():
        row = int(np.argmin(smallest))
        raise InputError(
            "positive definite covariances",
            f"smallest eigenvalue {smallest[row]:.3e} in row {row}",
            "check the filter's covariance",
        )
    return np.asarray(np.einsum("ni,ni->n", e, np.linalg.solve(P, e[:, :, None])[:, :, 0]))


def nees_band(dof: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Bounds of the average NEES over independent runs: an honest filter stays between them `confidence` of the time.

    Args:
        dof: dimension d of the error.
        runs: how many independent runs are averaged.
        confidence: two-sided probability, between 0 and 1.

    Raises:
        InputError: arguments that are not positive, or a confidence outside of (0, 1).
    """
    if dof < 1 or runs < 1 or not 0.0 < confidence < 1.0:
        raise InputError("dof ≥ 1, runs ≥ 1 and 0 < confidence < 1", f"{dof}, {runs} and {confidence}", "correct the arguments")
    tail = 0.5 * (1.0 - confidence)
    return float(chi_square_quantile(tail, dof * runs) / runs), float(chi_square_quantile(1.0 - tail, dof * runs) / runs)
