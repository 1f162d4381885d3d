"""Robust losses ρ(s) of the whitened squared residual s = ‖r‖²; a group costs ½ Σ ρ(s).

A loss enters Gauss-Newton through Triggs' scaling (Triggs et al., Bundle adjustment – a modern synthesis, 2000, section 4.3):
the gradient is exact, ρ′ Jᵀr, and so is the curvature, Jᵀ(ρ′ I + 2 ρ″ r rᵀ) J, as long as half of it or more is left along r.
Further out, where it would vanish or turn negative and steps along r would know no bound, the curvature is that of
reweighted least squares, ρ′ JᵀJ, which converges linearly.

A loss is a code that the compiled kernels branch on; `UserLoss` is one that is given from outside, as a function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from boxplus._jit import kernel
from boxplus._user_code import UserCode
from boxplus.errors import InputError
from boxplus.optimization.user_loss import Derivatives, compiled_loss, taken_down

SQUARED, HUBER, CAUCHY, TUKEY, GEMAN_MCCLURE, WELSCH, TRUNCATED, USER = 0, 1, 2, 3, 4, 5, 6, 7
# Share of ρ′ that must be left along the residual for its second-order term to be used. It matters little: over pose graphs and
# bundle adjustments with 0 to 20 % outliers and all losses below, 0.5 took 0 to 10 % fewer iterations than reweighted least
# squares alone in most cases. 0.1 saved a quarter in one (Cauchy at half a standard deviation), but its steps were often too
# long: up to a fifth of them rejected (Welsch), against next to none with 0.5.
_LEAST_CURVATURE = 0.5


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss by its code and its scale c, in standard deviations of the whitened residual.

    Attributes:
        function: of a `UserLoss`; None for those that the kernels know.
        taken_down: that function as it was when the loss was made.

    Example:
        >>> bp.losses.Huber(1.5).with_scale(3.0)
        Huber(3)
    """

    code: int
    scale: float
    name: str
    function: Derivatives | None = None
    taken_down: UserCode | None = None

    def __repr__(self) -> str:
        return self.name if self.code == SQUARED else f"{self.name}({self.scale:g})"

    @property
    def is_redescending(self) -> bool:
        """Whether a residual pulls the less the larger it is, far out: the cost then has minima that depend on the start."""
        return compiled_loss(self.taken_down)[1] if self.taken_down is not None else self.code not in (SQUARED, HUBER)

    def with_scale(self, scale: float) -> Loss:
        """The same loss with another scale."""
        return replace(_loss(self.code, scale, self.name), function=self.function, taken_down=self.taken_down)


def _loss(code: int, scale: float, name: str) -> Loss:
    if not (math.isfinite(scale) and scale > 0.0):
        raise InputError(
            f"{name} scale positive and finite", f"{scale}", "give it in standard deviations of the residual, such as 1.0"
        )
    return Loss(code, float(scale), name)


def Squared() -> Loss:
    """ρ = s: least squares.

    Example:
        >>> bp.losses.Squared(), bp.losses.Squared().is_redescending
        (Squared, False)
    """
    return Loss(SQUARED, 1.0, "Squared")


def Huber(scale: float) -> Loss:
    """ρ = s up to c², then 2c√s − c²: large residuals count linearly (Huber 1964).

    Example:
        >>> bp.losses.Huber(1.5), bp.losses.Huber(1.5).is_redescending
        (Huber(1.5), False)
    """
    return _loss(HUBER, scale, "Huber")


def Cauchy(scale: float) -> Loss:
    """ρ = c² ln(1 + s/c²): large residuals count by their logarithm (Cauchy's or Lorentz' distribution).

    Example:
        >>> bp.losses.Cauchy(1.0), bp.losses.Cauchy(1.0).is_redescending
        (Cauchy(1), True)
    """
    return _loss(CAUCHY, scale, "Cauchy")


def Tukey(scale: float) -> Loss:
    """ρ = c²/3 (1 − (1 − s/c²)³) up to c², then c²/3: residuals beyond c do not count at all (Beaton and Tukey 1974).

    Example:
        >>> bp.losses.Tukey(4.7), bp.losses.Tukey(4.7).is_redescending
        (Tukey(4.7), True)
    """
    return _loss(TUKEY, scale, "Tukey")


def GemanMcClure(scale: float) -> Loss:
    """ρ = c² s/(c² + s): never costs more than c² (Geman and McClure 1987); `graduate` starts from afar with it.

    Example:
        >>> bp.losses.GemanMcClure(1.0), bp.losses.GemanMcClure(1.0).is_redescending
        (GemanMcClure(1), True)
    """
    return _loss(GEMAN_MCCLURE, scale, "GemanMcClure")


def Welsch(scale: float) -> Loss:
    """ρ = c² (1 − exp(−s/c²)): never costs more than c² (Dennis and Welsch 1978).

    Example:
        >>> bp.losses.Welsch(3.0), bp.losses.Welsch(3.0).is_redescending
        (Welsch(3), True)
    """
    return _loss(WELSCH, scale, "Welsch")


def Truncated(scale: float) -> Loss:
    """ρ = s up to c², then c²: least squares over the residuals within c, where the others cost as much as the last of these.

    Example:
        >>> bp.losses.Truncated(2.0), bp.losses.Truncated(2.0).is_redescending
        (Truncated(2), True)
    """
    return _loss(TRUNCATED, scale, "Truncated")


def UserLoss(function: Derivatives, scale: float = 1.0) -> Loss:
    """A loss of one's own: ρ(s) = c² f(s/c²), with c the scale, as all losses here are made.

    Args:
        function: takes s = ‖r‖² in squares of the scale and returns f(s), f′(s), f″(s); compiled by Numba. f(0) = 0, f′ ≥ 0, and
            f′(0) = 1 if small residuals are to count as in least squares.
        scale: c, in standard deviations of the whitened residual.

    Raises:
        InputError: a function that does not compile or does not return three numbers, a loss that falls or is not finite, or
            derivatives that differences do not confirm: all are looked at for s from 10⁻⁴ to 10⁸.

    Example:
        >>> def pseudo_huber(s):
        ...     root = np.sqrt(1.0 + s)
        ...     return 2.0 * root - 2.0, 1.0 / root, -0.5 / (root * root * root)
        >>> bp.losses.UserLoss(pseudo_huber, scale=1.5)
        pseudo_huber(1.5)
    """
    code = taken_down(function)
    return replace(_loss(USER, scale, code.name), function=function, taken_down=code)


@kernel(inline=True)
def loss_at(code: int, scale: float, s: float) -> tuple[float, float, float]:
    """ρ(s), ρ′(s), ρ″(s)."""
    c2 = scale * scale
    if code == HUBER:
        if s <= c2:
            return s, 1.0, 0.0
        root = math.sqrt(s)
        return 2.0 * scale * root - c2, scale / root, -0.5 * scale / (s * root)
    if code == CAUCHY:
        w = 1.0 / (1.0 + s / c2)
        return c2 * math.log1p(s / c2), w, -w * w / c2
    if code == TUKEY:
        if s >= c2:
            return c2 / 3.0, 0.0, 0.0
        u = 1.0 - s / c2
        return c2 / 3.0 * (1.0 - u * u * u), u * u, -2.0 * u / c2
    if code == GEMAN_MCCLURE:
        w = c2 / (c2 + s)
        return w * s, w * w, -2.0 * w * w / (c2 + s)
    if code == WELSCH:
        w = math.exp(-s / c2)
        return -c2 * math.expm1(-s / c2), w, -w / c2
    if code == TRUNCATED:
        return (s, 1.0, 0.0) if s <= c2 else (c2, 0.0, 0.0)
    return s, 1.0, 0.0


@kernel(inline=True)
def triggs(code: int, scale: float, s: float) -> tuple[float, float, float]:
    """ρ, the factor √ρ′ of residual and Jacobian, and α of Triggs: r̃ = √ρ′/(1 − α) r, J̃ = √ρ′ (I − α r rᵀ/s) J."""
    rho, first, second = loss_at(code, scale, s)
    value, factor, alpha = triggs_factors(rho, first, second, s)
    return value, factor, alpha


@kernel(inline=True)
def triggs_factors(rho: float, first: float, second: float, s: float) -> tuple[float, float, float]:
    """As `triggs`, of ρ(s), ρ′(s) and ρ″(s)."""
    if first <= 0.0:
        return rho, 0.0, 0.0
    curvature = 1.0 + 2.0 * s * second / first
    if curvature < _LEAST_CURVATURE:
        curvature = 1.0
    return rho, math.sqrt(first), 1.0 - math.sqrt(curvature)
