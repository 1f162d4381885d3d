"""A loss that a user writes: compiled, and its derivatives believed only where differences agree with them."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import config as numba_config
from numba.core import types
from numba.core.errors import NumbaError, UnsupportedBytecodeError

from boxplus._jit import kernel
from boxplus._user_code import UserCode, cached_name
from boxplus.errors import InputError

Derivatives = Callable[[float], tuple[float, float, float]]

# Where a loss is looked at: over all that residuals reach, at numbers on which nobody puts a kink.
_GRID = 10.0 ** np.linspace(-4.03, 8.017, 49)
_STEP = 1e-4  # of the differences, as a share of s: truncation stays below 1e-7 of a smooth derivative, rounding below 1e-8
_AGREES = 1e-5  # of the largest of what is compared
_FADES = 0.99  # a residual that pulls less than this share of the most that any pulls is being forgotten


def taken_down(function: Derivatives) -> UserCode:
    """The function as it is now.

    Raises:
        InputError: not a function, or one that does not compile or is no loss, as for `compiled_loss`.
    """
    if not (inspect.isfunction(function) or inspect.isfunction(getattr(function, "py_func", None))):
        raise InputError("a function of s as a loss", repr(function), "write `def loss(s): return rho, first, second`")
    code = UserCode.of(function)
    compiled_loss(code)
    return code


@functools.lru_cache(maxsize=64)
def compiled_loss(code: UserCode) -> tuple[Callable[..., None], bool]:
    """The loop that fills (ρ, ρ′, ρ″) for every residual, and whether the loss forgets large ones.

    Raises:
        InputError: a function that Numba does not compile, that does not return three numbers, whose ρ(0) is not zero, whose
            ρ′ is negative or not finite somewhere, or whose derivatives are not those of its ρ.
    """
    one = _compiled(code)
    _check(code.name, one)

    def fill(begin: int, end: int, scale: float, r: Any, valid: Any, derivatives: Any) -> None:
        c2 = scale * scale
        for n in range(begin, end):
            if valid[n]:
                s = 0.0
                for i in range(r.shape[1]):
                    s += r[n, i] * r[n, i]
                rho, first, second = one(s / c2)
                derivatives[n, 0], derivatives[n, 1], derivatives[n, 2] = c2 * rho, first, second / c2

    pull = np.array([math.sqrt(s) * one(s)[1] for s in _GRID])
    return kernel(fill, cached=cached_name(__file__, "loss", code)), bool(pull[-1] < _FADES * pull.max())


def _compiled(code: UserCode) -> Any:
    if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        plain = getattr(code.function, "py_func", code.function)
        found = plain(1.0)  # no types to look at
        if not (isinstance(found, tuple) and len(found) == 3 and all(isinstance(number, int | float) for number in found)):
            raise _not_three(code.name, repr(found))
        return plain
    one = kernel(code.snapshot(checked=False), inline=True, cached=code.cached())
    try:
        one.compile((types.float64,))
    except (NumbaError, UnsupportedBytecodeError, TypeError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise InputError("a loss that Numba can compile", f"{code.name}: {reason}", "use numbers and `math` only") from error
    returned: Any = one.overloads[(types.float64,)].signature.return_type
    if not (_is_three_numbers(returned)):
        raise _not_three(code.name, str(returned))
    return one


def _not_three(name: str, returned: str) -> InputError:
    return InputError(f"three numbers from {name}", returned, "return ρ(s), ρ′(s), ρ″(s)")


def _is_three_numbers(returned: Any) -> bool:
    return isinstance(returned, types.BaseTuple) and [isinstance(t, types.Number) for t in returned] == [True] * 3  # type: ignore[attr-defined]


def _check(name: str, one: Derivatives) -> None:
    """Raises InputError where the three numbers cannot be a loss and its derivatives."""
    start = one(0.0)
    if start[0] != 0.0 or not all(map(math.isfinite, start)):
        raise InputError(f"ρ(0) = 0 of {name}, and finite derivatives there", f"{start}", "take the value at zero from it")
    for s in _GRID:
        h = _STEP * s
        here, ahead, behind = one(s), one(s + h), one(s - h)
        if not all(map(math.isfinite, here)) or here[1] < 0.0:
            raise InputError(f"a loss {name} that is finite and does not fall", f"{here} at s = {s:.4g}", "give ρ′ ≥ 0 for all s")
        for order, what in ((0, "ρ′"), (1, "ρ″")):
            difference = (ahead[order] - behind[order]) / (2.0 * h)
            # Rounding of the values over the step, beside what the derivative itself may be off by.
            rounding = 4e-16 * max(abs(ahead[order]), abs(behind[order])) / h
            if abs(difference - here[order + 1]) > _AGREES * max(abs(difference), abs(here[order + 1])) + 4.0 * rounding:
                raise InputError(
                    f"the derivative of {name} as {what}",
                    f"{here[order + 1]:.8g} at s = {s:.4g}, where differences say {difference:.8g}",
                    "differentiate by s = ‖r‖², not by ‖r‖",
                )
