"""A user's functions compiled, what they return, and the text of loops around them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import config as numba_config
from numba.core import types
from numba.core.errors import NumbaError, UnsupportedBytecodeError
from numba.extending import intrinsic

from boxplus._jit import kernel
from boxplus._user_code import UserCode, cached_name
from boxplus.errors import InputError


def row_type(dtype: str, axes: int) -> types.Type:
    scalar = types.int64 if dtype == "int64" else types.float64
    return scalar if axes == 1 else types.Array(scalar, axes - 1, "C")


def check_arguments(role: str, function: Callable[..., Any], count: int, what: str) -> None:
    if not (inspect.isfunction(function) or inspect.isfunction(getattr(function, "py_func", None))):
        raise InputError(
            f"a plain Python function as {role}",
            f"{function!r}",
            "wrap it in a function, or give a batch function, which runs as it is",
        )
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError as error:
        raise InputError(
            f"a {role} of {count} arguments ({what})",
            f"{function.__name__}{inspect.signature(function)}: {error}",
            "let it take one residual's values, in this order",
        ) from None


def compiled(role: str, code: UserCode, arguments: tuple[types.Type, ...], *, checked: bool) -> tuple[Any, types.Type | None]:
    """The function in native code and the type it returns; None when compilation is switched off."""
    if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        return (_as_sequence(code.function) if role == "function" else code.function), None
    name = code.cached("checked" * checked)
    dispatcher: Any = kernel(code.snapshot(checked=checked), inline=True, cached=name, checked=checked)
    try:
        dispatcher.compile(arguments)
    except (NumbaError, UnsupportedBytecodeError) as error:
        raise InputError(
            f"a {role} that Numba can compile",
            f"{code.name}: {summary(error)}",
            "use scalars, NumPy arrays, math and kernels from boxplus.manifolds only, or give a batch function",
        ) from error
    return dispatcher, dispatcher.overloads[arguments].signature.return_type


@intrinsic  # type: ignore[untyped-decorator]
def present(typing_context: Any, value: Any) -> Any:
    """A value that may be None, and is not: Numba does not index a tuple that may be None."""
    inner = value.type if isinstance(value, types.Optional) else value

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.cast(builder, arguments[0], value, inner)

    return inner(value), generate


def as_it_is(value: Any) -> Any:
    return value


def _as_sequence(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as it is, a single number as an array of one: what compiled code learns from types."""

    def call(*arguments: Any) -> Any:
        value = function(*arguments)
        return None if value is None else np.atleast_1d(value)

    return call


def summary(error: Exception) -> str:
    """What Numba complains about and the line it concerns, out of its page of text."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [line.strip() for line in plain.splitlines()]
    noise = ("Failed in", "During:", "File ", "- Resolution failure", "Overload", "There are", "<source", "[1]", "[2]")
    reasons = [line for line in lines if line and not line.startswith(noise)]
    place = re.findall(r'File "([^"]+)", line (\d+)', plain)
    text = reasons[0] if reasons else plain.strip()
    if text.endswith(":") and len(reasons) > 1:
        text = f"{text} {reasons[1].removeprefix('>>> ')}"
    return f"{text} ({Path(place[-1][0]).name}, line {place[-1][1]})" if place else text


def _is_number_tuple(value: Any, dim: int) -> bool:
    return isinstance(value, types.BaseTuple) and [isinstance(v, types.Number) for v in value] == [True] * dim  # type: ignore[attr-defined]


class Store:
    """Source lines that check one returned value and copy it, by the type Numba found."""

    def __init__(self, returned: types.Type | None, dim: int, name: str) -> None:
        self.dim = dim
        self.can_be_none = returned is None or isinstance(returned, types.Optional | types.NoneType)
        value: Any = returned.type if isinstance(returned, types.Optional) else returned
        self.is_scalar = isinstance(value, types.Number)
        self.has_length = value is None or isinstance(value, types.Array | types.List)
        fits = (
            value is None
            or (self.is_scalar and dim == 1)
            or _is_number_tuple(value, dim)
            or (isinstance(value, types.Array) and value.ndim == 1)
            or (isinstance(value, types.List) and isinstance(value.dtype, types.Number))
        )
        if not fits:
            got = f"a tuple of {len(value)}" if isinstance(value, types.BaseTuple) else str(value)
            raise InputError(
                f"{dim} numbers from {name}",
                got,
                "return them as a tuple or a one-dimensional array, and give their number as dim",
            )

    def guard(self, value: str, on_none: str) -> str:
        """Lines that leave with `on_none` where there is no residual, else name it `found`, and return if its length is wrong."""
        lines = [f"if {value} is None:", *(f"    {line}" for line in on_none.split("; "))] if self.can_be_none else []
        lines += [f"found = present({value})"] if self.can_be_none else [f"found = {value}"]
        if self.has_length:
            lines += [f"if len(found) != {self.dim}:", "    return len(found) + 1"]
        return "\n".join(lines)

    def entries(self) -> list[str]:
        return ["found"] if self.is_scalar else [f"found[{c}]" for c in range(self.dim)]


def arguments_of(variables: int, data: list[bool]) -> list[str]:
    return [f"x{s}[index{s}[n]]" for s in range(variables)] + entries_of(data)


def entries_of(data: list[bool]) -> list[str]:
    """The row of every data array; `data` says which have one for all residuals."""
    return [f"data{k}[0]" if is_shared else f"data{k}[n]" for k, is_shared in enumerate(data)]


def names_of(stem: str, count: int) -> str:
    return "".join(f"{stem}{k}, " for k in range(count))


def indented(text: str, width: int) -> str:
    return "\n".join(" " * width + line for line in text.splitlines() if line)


def generated(file: str, name: str, source: str, names: dict[str, Any], *codes: UserCode | None) -> Any:
    """The loop of this text, which a file generates around functions."""
    scope = {**names, "__name__": __name__}
    exec(compile(source, f"<boxplus {name} loop>", "exec"), scope)
    return kernel(scope[name], cached=cached_name(file, source, *codes))
