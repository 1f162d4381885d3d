"""The χ² distribution without SciPy, whose special functions take longer to import than a graph to optimise.

P(a, x) and Q(a, x) = 1 − P, the regularised incomplete gamma functions at a = dof/2 and half of χ², are a series below x = a + 1
and a continued fraction above (Press et al., Numerical Recipes, 2007, section 6.2); quantiles are found by halving.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

_EPSILON = 1e-16
_TINY = 1e-300


def chi_square_cdf(x: float, dof: float) -> float:
    """Probability that χ² of `dof` degrees of freedom is at most x."""
    return _incomplete_gamma(0.5 * dof, 0.5 * x)[0]


def chi_square_sf(x: float, dof: float) -> float:
    """Probability that it is above x, to all digits however small (1 − `chi_square_cdf` has none left beyond 1e-16)."""
    return _incomplete_gamma(0.5 * dof, 0.5 * x)[1]


def chi_square_quantile(probability: float, dof: float) -> float:
    """What χ² of `dof` degrees of freedom stays below with this probability."""
    if probability > 0.5:  # where the share above has more digits
        return chi_square_exceeded(1.0 - probability, dof)
    return _crossing(probability, dof, False)


def chi_square_exceeded(probability: float, dof: float) -> float:
    """What it exceeds with this probability, be it small."""
    return _crossing(probability, dof, True)


@functools.lru_cache(maxsize=512)  # graphs ask for the same few, once a pair of closures
def _crossing(probability: float, dof: float, is_above: bool) -> float:
    """Where the probability of χ² above x, or below, comes to this."""
    if is_above:
        return _first(lambda x: chi_square_sf(x, dof) <= probability, dof)
    return _first(lambda x: chi_square_cdf(x, dof) >= probability, dof)


def _first(is_beyond: Callable[[float], bool], dof: float) -> float:
    """The smallest x beyond, to rounding."""
    low, high = 0.0, 2.0 * dof
    while not is_beyond(high):
        low, high = high, 2.0 * high
        if math.isinf(high):
            return high
    while high - low > 4.0 * _EPSILON * high:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (low, middle) if is_beyond(middle) else (middle, high)
    return high


def _incomplete_gamma(a: float, x: float) -> tuple[float, float]:
    """P(a, x) and Q(a, x)."""
    if not x > 0.0:
        return (0.0, 1.0) if x <= 0.0 else (math.nan, math.nan)
    if math.isinf(x):
        return 1.0, 0.0
    front = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        n = a
        while term > _EPSILON * total:
            n += 1.0
            term *= x / n
            total += term
        below = min(front * total, 1.0)
        return below, 1.0 - below
    b = x + 1.0 - a
    c, d = 1.0 / _TINY, 1.0 / b
    h, n = d, 0.0
    while True:  # Lentz
        n += 1.0
        factor = -n * (n - a)
        b += 2.0
        d = 1.0 / _nonzero(factor * d + b)
        c = _nonzero(b + factor / c)
        h *= c * d
        if abs(c * d - 1.0) <= 4.0 * _EPSILON:
            break
    above = min(front * h, 1.0)
    return 1.0 - above, above


def _nonzero(value: float) -> float:
    return value if abs(value) > _TINY else _TINY
