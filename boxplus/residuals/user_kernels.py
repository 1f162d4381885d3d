"""Compiled loops around a user's functions of one residual.

Numba cannot take functions as arguments without giving up speed, so the loops are written out for the number of variables
and data arrays at hand and compiled around the functions. They are not kept on disk: what else the functions call is not known.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numpy as np
from numba.core import config as numba_config
from numba.core import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError, UnsupportedBytecodeError
from numba.extending import intrinsic

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.tangent_step import copy_into, step_into


@dataclass(frozen=True, slots=True)
class Loops:
    """The compiled loops: `evaluate`, and `linearize` with the user's Jacobian or differences.

    Both return 0, or one more than the wrong number of values that a call returned. `linearize` is None where neither a
    Jacobian is given nor the steps of a manifold are compiled. An index beyond an array raises IndexError, but for the
    `linearize` with differences, which would take almost twice the time: the function is evaluated before, at the same point.
    """

    evaluate: Callable[..., int]
    linearize: Callable[..., int] | None


@functools.lru_cache(maxsize=128)
def compiled_loops(
    function: Callable[..., Any],
    jacobian: Callable[..., Any] | None,
    dim: int,
    dofs: tuple[int, ...],
    data: tuple[tuple[str, int, bool], ...],
    has_steps: bool,
) -> Loops:
    """Loops for a function and its Jacobian; dofs are those of its variables, data (dtype, number of axes, whether one row
    is for all residuals) of every data array.

    Raises:
        InputError: a function that does not take these arguments, does not compile, or returns something else than
            `dim` numbers.
    """
    variables, shared = len(dofs), [is_shared for _, _, is_shared in data]
    rows: list[types.Type] = [types.Array(types.float64, 1, "C")] * variables
    rows += [_row_type(dtype, axes) for dtype, axes, _ in data]
    _check_arguments("function", function, len(rows), "one row for each variable, then one for each data array")
    compute, returned = _compiled("function", function, tuple(rows), checked=True)
    store = _Store(returned, dim, function.__name__)
    names: dict[str, Any] = {"function": compute, "np": np, "step_into": step_into, "copy_into": copy_into}
    names["present"] = present if returned is not None else _as_it_is
    evaluate = _loop("evaluate", _evaluate_source(variables, shared, store), names)
    if jacobian is not None:
        expected = f"the arguments of {function.__name__} and then one (dim, dof) array to fill for each variable"
        _check_arguments("jacobian", jacobian, len(rows) + variables, expected)
        matrices = [types.Array(types.float64, 2, "C")] * variables
        names["jacobian"], _ = _compiled("jacobian", jacobian, (*rows, *matrices), checked=True)
        source = _analytic_source(variables, shared, store)
    elif has_steps:
        names["function"], _ = _compiled("function", function, tuple(rows), checked=False)
        source = _numeric_source(variables, shared, store, dofs)
    else:
        return Loops(evaluate, None)
    return Loops(evaluate, _loop("linearize", source, names))


def _row_type(dtype: str, axes: int) -> types.Type:
    scalar = types.int64 if dtype == "int64" else types.float64
    return scalar if axes == 1 else types.Array(scalar, axes - 1, "C")


def _check_arguments(role: str, function: Callable[..., Any], count: int, what: str) -> None:
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


def _compiled(
    role: str, function: Callable[..., Any], arguments: tuple[types.Type, ...], *, checked: bool
) -> tuple[Any, types.Type | None]:
    """The function in native code and the type it returns; None when compilation is switched off."""
    if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        return (_as_sequence(function) if role == "function" else function), None
    plain = getattr(function, "py_func", function)
    dispatcher: Any = function
    if checked:
        dispatcher = kernel(_with_checked_helpers(plain), inline=True, cached=False, checked=True)
    elif plain is function:
        dispatcher = kernel(plain, inline=True, cached=False)
    try:
        dispatcher.compile(arguments)
    except (NumbaError, UnsupportedBytecodeError) as error:
        raise InputError(
            f"a {role} that Numba can compile",
            f"{function.__name__}: {_summary(error)}",
            "use scalars, NumPy arrays, math and kernels from boxplus.manifolds only, or give a batch function",
        ) from error
    return dispatcher, dispatcher.overloads[arguments].signature.return_type


def _with_checked_helpers(function: Any, outer: tuple[Any, ...] = ()) -> Any:
    """The function with bounds checked in the functions as well that it calls and a user compiled; those of boxplus stay."""
    scope = inspect.getclosurevars(function)
    found = {
        name: kernel(_with_checked_helpers(value.py_func, (*outer, function)), inline=True, cached=False, checked=True)
        for name, value in {**scope.globals, **scope.nonlocals}.items()
        if isinstance(value, Dispatcher)
        and not (value.__module__ or "").startswith("boxplus.")
        and value.py_func not in (*outer, function)
    }
    if not found:
        return function
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    closure = tuple(CellType(found[name]) if name in found else cell for name, cell in cells)
    return FunctionType(function.__code__, {**function.__globals__, **found}, function.__name__, function.__defaults__, closure)


@intrinsic  # type: ignore[untyped-decorator]
def present(typing_context: Any, value: Any) -> Any:
    """A value that may be None, and is not: Numba does not index a tuple that may be None."""
    inner = value.type if isinstance(value, types.Optional) else value

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.cast(builder, arguments[0], value, inner)

    return inner(value), generate


def _as_it_is(value: Any) -> Any:
    return value


def _as_sequence(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as it is, a single number as an array of one: what compiled code learns from types."""

    def call(*arguments: Any) -> Any:
        value = function(*arguments)
        return None if value is None else np.atleast_1d(value)

    return call


def _summary(error: Exception) -> str:
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


class _Store:
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


def _evaluate_source(variables: int, data: list[bool], store: _Store) -> str:
    arguments = _arguments(variables, data)
    return f"""
def evaluate(begin, end, {_names("x", variables)}{_names("index", variables)}{_names("data", len(data))}r, valid):
    for n in range(np.uint64(begin), np.uint64(end)):
        e = function({", ".join(arguments)})
{_residual(store)}
        valid[n] = True
    return 0
"""


def _analytic_source(variables: int, data: list[bool], store: _Store) -> str:
    arguments = _arguments(variables, data)
    zero = "\n".join(f"        J{s}[n, :, :] = 0.0" for s in range(variables))
    return f"""
def linearize(
    begin, end, {_names("x", variables)}{_names("index", variables)}{_names("data", len(data))}r, {_names("J", variables)}valid
):
    for n in range(np.uint64(begin), np.uint64(end)):
{zero}
        e = function({", ".join(arguments)})
{_residual(store)}
        valid[n] = True
        jacobian({", ".join([*arguments, *(f"J{s}[n]" for s in range(variables))])})
    return 0
"""


def _numeric_source(variables: int, data: list[bool], store: _Store, dofs: tuple[int, ...]) -> str:
    """Every residual at its point (probe 0) and one step ahead and one behind along each direction of each tangent.

    All moved variables are written first and read later, which spares the processor waiting for its own stores; there is a
    single call of the function in the loop, so that it can be inlined.
    """
    scratch, fill, rows, moved, differences, begin = [], [], [], [], [], 1
    for s, dof in enumerate(dofs):
        scratch.append(f"    y{s} = np.empty(({2 * dof + 1}, x{s}.shape[1]))")
        fill.append(f"""
        copy_into(x{s}[index{s}[n]], y{s}[0])
        for k in range(np.uint64({dof})):
            h, cos_half, sin_half = h{s}[k, 0], h{s}[k, 1], h{s}[k, 2]
            step_into(steps{s}, k, h, cos_half, sin_half, x{s}[index{s}[n]], y{s}[two * k + one])
            step_into(steps{s}, k, -h, cos_half, -sin_half, x{s}[index{s}[n]], y{s}[two * k + two])""")
        rows.append(
            f"            row{s} = probe - np.uint64({begin - 1}) if {begin} <= probe < {begin + 2 * dof} else np.uint64(0)"
        )
        moved.append(f"y{s}[row{s}]")
        differences.append(f"""
        for k in range(np.uint64({dof})):
            ahead = np.uint64({begin}) + two * k
            reach = known[ahead] + known[ahead + one]
            scale = 1.0 / (reach * h{s}[k, 0]) if reach > 0.0 else 0.0
            for c in range(np.uint64({store.dim})):
                J{s}[n, c, k] = scale * (e_of[ahead, c] - e_of[ahead + one, c])""")
        begin += 2 * dof
    copies = "\n".join(f"            e_of[probe, {c}] = {entry}" for c, entry in enumerate(store.entries()))
    # Beside a neighbour without residual the difference is one-sided, from the residual itself.
    on_none = "; ".join(
        [
            "if probe == np.uint64(0):",
            "    valid[n] = False",
            "    break",
            "known[probe] = 0.0",
            "e_of[probe] = e_of[0]",
            "continue",
        ]
    )
    call = ", ".join([*moved, *_entries(data)])
    zeros = "\n".join(f"            J{s}[n, :, :] = 0.0" for s in range(variables))
    new_line = "\n"
    return f"""
def linearize(
    begin, end, {_names("x", variables)}{_names("index", variables)}{_names("data", len(data))}
    {_names("steps", variables)}{_names("h", variables)}r, {_names("J", variables)}valid
):
    one, two = np.uint64(1), np.uint64(2)
    e_of, known = np.empty(({begin}, {store.dim})), np.ones({begin})
{new_line.join(scratch)}
    for n in range(np.uint64(begin), np.uint64(end)):
        valid[n] = True{"".join(fill)}
        for probe in range(np.uint64({begin})):
{new_line.join(rows)}
            e = function({call})
{_indent(store.guard("e", on_none), 12)}
{copies}
            known[probe] = 1.0
        if not valid[n]:
            r[n, :] = 0.0
{zeros}
            continue
        for c in range(np.uint64({store.dim})):
            r[n, c] = e_of[0, c]{"".join(differences)}
    return 0
"""


def _residual(store: _Store) -> str:
    lines = [store.guard("e", "valid[n] = False; r[n, :] = 0.0; continue")]
    lines += [f"r[n, {c}] = {entry}" for c, entry in enumerate(store.entries())]
    return _indent("\n".join(lines), 8)


def _arguments(variables: int, data: list[bool]) -> list[str]:
    return [f"x{s}[index{s}[n]]" for s in range(variables)] + _entries(data)


def _entries(data: list[bool]) -> list[str]:
    """The row of every data array; `data` says which have one for all residuals."""
    return [f"data{k}[0]" if is_shared else f"data{k}[n]" for k, is_shared in enumerate(data)]


def _names(stem: str, count: int) -> str:
    return "".join(f"{stem}{k}, " for k in range(count))


def _indent(text: str, width: int) -> str:
    return "\n".join(" " * width + line for line in text.splitlines() if line)


def _loop(name: str, source: str, names: dict[str, Any]) -> Callable[..., int]:
    scope = dict(names)
    exec(compile(source, f"<boxplus {name} loop>", "exec"), scope)
    loop: Callable[..., int] = kernel(scope[name], cached=False)
    return loop
