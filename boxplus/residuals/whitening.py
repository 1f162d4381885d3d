"""The square root of a residual's information: r is whitened to W r with WᵀW = Ω = Σ⁻¹ (docs/least_squares.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError

_SYMMETRY = 1e-6  # largest asymmetry, of the largest entry, that counts as rounding
_ROUNDING = 1e-9  # a negative eigenvalue up to this share of the largest is rounding of what was written to a file
_LEAST_PIVOT = 1e-14  # what is left of a diagonal entry, as a share of it, that does not count as rounding


@dataclass(frozen=True, slots=True)
class Whitening:
    """Square-root information of a group.

    Attributes:
        factors: W, (1, d, d) where all residuals share one, else (N, d, d).
        is_diagonal: every W is diagonal.
    """

    factors: NDArray[np.float64]
    is_diagonal: bool

    @classmethod
    def of(
        cls,
        dim: int,
        count: int,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> Whitening:
        """From exactly one description of the noise; none of them stands for σ = 1.

        Args:
            dim, count: d rows of a residual, N residuals.
            sigma: standard deviation in the unit of the residual: a number, (d,) one for each row of a residual,
                (N, 1) one for each residual, or (N, d).
            covariance, information: (d, d) or (N, d, d), symmetric and positive definite. An information matrix may be
                semi-definite: along its null space the residual says nothing.

        Raises:
            InputError: two descriptions, a wrong shape, a sigma that is not positive and finite, a matrix that is not
                finite, symmetric and positive definite; the message names the first residual concerned.
        """
        given = [
            name
            for name, value in (("sigma", sigma), ("covariance", covariance), ("information", information))
            if value is not None
        ]
        if len(given) > 1:
            raise InputError(
                "one of sigma, covariance, information", " and ".join(given), "they say the same thing: leave out the others"
            )
        if covariance is not None:
            return cls(_from_matrix("covariance", covariance, dim, count, inverse=True), False)
        if information is not None:
            return cls(_from_matrix("information", information, dim, count, inverse=False), False)
        return cls._from_sigma(1.0 if sigma is None else sigma, dim, count)

    @classmethod
    def _from_sigma(cls, sigma: ArrayLike, dim: int, count: int) -> Whitening:
        array = as_floats(sigma, "sigma")
        if array.shape not in ((), (dim,), (count, 1), (count, dim)):
            raise InputError(
                f"sigma as a number, ({dim},), ({count}, 1) or ({count}, {dim})",
                f"shape {array.shape}",
                "give a standard deviation for each row of a residual",
            )
        bad = ~(np.isfinite(array) & (array > 0.0))
        if bad.any():
            where = tuple(int(i) for i in np.argwhere(bad)[0])
            raise InputError(
                "sigma positive and finite",
                f"{array[where]} at {where}",
                "remove the residual instead of giving it no or infinite weight",
            )
        if array.ndim < 2:
            diagonal = np.broadcast_to(1.0 / array, (1, dim))
        else:
            diagonal = np.broadcast_to(1.0 / array, (count, dim))
        factors = np.zeros((len(diagonal), dim, dim))
        factors[:, np.arange(dim), np.arange(dim)] = diagonal
        return cls(factors, True)

    def rows(self, selected: NDArray[np.intp]) -> Whitening:
        """The whitening of the residuals `selected` alone."""
        return self if len(self.factors) == 1 else Whitening(self.factors[selected], self.is_diagonal)


def _from_matrix(name: str, matrix: ArrayLike, dim: int, count: int, *, inverse: bool) -> NDArray[np.float64]:
    """W (1 or N, d, d) of an information matrix, or of a covariance when `inverse`."""
    array = as_floats(matrix, name)
    if array.shape not in ((dim, dim), (count, dim, dim)):
        raise InputError(
            f"{name} of shape ({dim}, {dim}) or ({count}, {dim}, {dim})",
            f"shape {array.shape}",
            "one matrix for all residuals, or one for each",
        )
    array = np.ascontiguousarray(array.reshape(-1, dim, dim))
    n, asymmetry = _first_not_symmetric(array)
    if n >= 0 and not np.isfinite(asymmetry):
        raise InputError(f"{name} finite", f"NaN or infinity in residual {n}", "remove the residual or repair its weight")
    if n >= 0:
        raise InputError(
            f"{name} symmetric",
            f"an asymmetry of {asymmetry:.3g} in residual {n}",
            "check the order in which its entries were read",
        )
    try:
        factor = np.linalg.cholesky(array)
        pivots = np.einsum("nii->ni", factor) ** 2
        definite = bool((pivots > _LEAST_PIVOT * np.einsum("nii->ni", array)).all())
    except np.linalg.LinAlgError:
        definite = False
    if not definite:
        return _of_semidefinite(name, array, allowed=not inverse)
    # Ω = L Lᵀ is whitened by Lᵀ; Σ = C Cᵀ by C⁻¹, which spares the inverse of Σ.
    return np.ascontiguousarray(np.linalg.inv(factor) if inverse else np.swapaxes(factor, 1, 2))


@kernel
def _first_not_symmetric(matrices: NDArray[np.float64]) -> tuple[int, float]:
    """The first matrix that is not finite, else the first that is not symmetric, −1 for none; and its asymmetry."""
    first, worst = -1, 0.0
    for n in range(matrices.shape[0]):
        scale, asymmetry = 0.0, 0.0
        for i in range(matrices.shape[1]):
            for j in range(matrices.shape[1]):
                value = matrices[n, i, j]
                if not math.isfinite(value):
                    return n, math.nan
                scale, asymmetry = max(scale, abs(value)), max(asymmetry, abs(value - matrices[n, j, i]))
        if first < 0 and asymmetry > _SYMMETRY * scale:
            first, worst = n, asymmetry
    return first, worst


def _of_semidefinite(name: str, matrices: NDArray[np.float64], *, allowed: bool) -> NDArray[np.float64]:
    """W = √Λ Vᵀ of information matrices V Λ Vᵀ some of which say nothing along some directions."""
    values, vectors = np.linalg.eigh(matrices)
    largest = values[:, -1]
    bad = (values[:, 0] < (-_ROUNDING if allowed else _LEAST_PIVOT) * largest) | ~(largest > 0.0)
    if bad.any():
        n = int(np.argmax(bad))
        raise InputError(
            f"{name} positive {'semi-' if allowed else ''}definite and not zero",
            f"eigenvalues from {values[n, 0]:.3g} to {values[n, -1]:.3g} in residual {n}",
            "check the order in which its entries were read"
            if allowed
            else "a direction known exactly is no measurement: fix it",
        )
    return np.ascontiguousarray(np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2))
