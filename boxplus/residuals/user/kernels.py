"""Compiled loops around a user's functions of one residual.

Numba cannot take functions as arguments without giving up speed, so the loops are written out for the number of variables
and data arrays at hand and compiled around the functions. Both are kept on disk under a hash of all that the functions refer to.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numba.core import types

from boxplus._user_code import UserCode
from boxplus._user_loops import (
    Store,
    arguments_of,
    as_it_is,
    check_arguments,
    compiled,
    entries_of,
    generated,
    indented,
    names_of,
    present,
    row_type,
)
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.tangents.step import copy_into, step_into, tangent_steps
from boxplus.residuals.user.automatic import NotDifferentiableError, automatic_loop

Derivative = Literal["analytic", "automatic", "numeric"]


@dataclass(frozen=True, slots=True)
class Loops:
    """The compiled loops around one function.

    Attributes:
        evaluate: residuals and validity. Like `linearize`, it returns 0, or one more than the wrong number of values that a call
            returned; an index beyond an array raises IndexError. An automatic one returns −1 where a row is all zeros.
        derivative: how Jacobians are had.
        linearize: the same with Jacobians; or only Jacobians, of what was evaluated at the same point before, where these are
            automatic or numeric: it does not look at bounds again, which would take almost twice the time. None where
            differences are to be taken of a manifold that is not compiled.
        tables: arrays that `linearize` takes after the data.
        note: why Jacobians are differences where automatic ones were possible to ask for.
    """

    evaluate: Callable[..., int]
    derivative: Derivative
    linearize: Callable[..., int] | None
    tables: tuple[Any, ...] = ()
    note: str = ""


def compiled_loops(
    function: Callable[..., Any],
    jacobian: Callable[..., Any] | None,
    derivative: Derivative | None,
    dim: int,
    manifolds: tuple[Manifold, ...],
    data: tuple[tuple[str, int, bool], ...],
) -> Loops:
    """Loops for a function of variables on these manifolds and its Jacobian; data is (dtype, number of axes, whether one row
    is for all residuals) of every data array. Without a `derivative`, it is automatic where that can be.

    Raises:
        InputError: a function that does not take these arguments, does not compile, returns something else than `dim` numbers,
            or is to be differentiated automatically and cannot.
    """
    variables, count = len(manifolds), len(manifolds) + len(data)
    check_arguments("function", function, count, "one row for each variable, then one for each data array")
    if jacobian is not None:
        expected = f"the arguments of {function.__name__} and then one (dim, dof) array to fill for each variable"
        check_arguments("jacobian", jacobian, count + variables, expected)
    written = None if jacobian is None else UserCode.of(jacobian)
    return _loops(UserCode.of(function), written, derivative, dim, manifolds, data)


@functools.lru_cache(maxsize=128)
def _loops(
    function: UserCode,
    jacobian: UserCode | None,
    derivative: Derivative | None,
    dim: int,
    manifolds: tuple[Manifold, ...],
    data: tuple[tuple[str, int, bool], ...],
) -> Loops:
    variables, shared = len(manifolds), [is_shared for _, _, is_shared in data]
    rows: list[types.Type] = [types.Array(types.float64, 1, "C")] * variables
    rows += [row_type(dtype, axes) for dtype, axes, _ in data]
    compute, returned = compiled("function", function, tuple(rows), checked=True)
    store = Store(returned, dim, function.name)
    names: dict[str, Any] = {"function": compute, "np": np, "step_into": step_into, "copy_into": copy_into}
    names["present"] = present if returned is not None else as_it_is
    evaluate = generated(__file__, "evaluate", _evaluate_source(variables, shared, store), names, function)
    if jacobian is not None:
        matrices = [types.Array(types.float64, 2, "C")] * variables
        names["jacobian"], _ = compiled("jacobian", jacobian, (*rows, *matrices), checked=True)
        source = _analytic_source(variables, shared, store)
        return Loops(evaluate, "analytic", generated(__file__, "linearize", source, names, function, jacobian))
    note = ""
    if derivative != "numeric":
        try:
            return Loops(evaluate, "automatic", *automatic_loop(function, store, manifolds, data))
        except NotDifferentiableError as error:
            if derivative == "automatic":
                raise
            note = f"{function.name} is differentiated by differences, not automatically: {error.got}"
    tables = tuple(tangent_steps(manifold) for manifold in manifolds)
    if any(table is None for table in tables):
        return Loops(evaluate, "numeric", None, note=note)
    names["function"], _ = compiled("function", function, tuple(rows), checked=False)
    source = _numeric_source(variables, shared, store, tuple(manifold.dof for manifold in manifolds))
    return Loops(evaluate, "numeric", generated(__file__, "linearize", source, names, function), tables, note)


def _evaluate_source(variables: int, data: list[bool], store: Store) -> str:
    arguments = arguments_of(variables, data)
    return f"""
def evaluate(begin, end, {names_of("x", variables)}{names_of("index", variables)}{names_of("data", len(data))}r, valid):
    for n in range(np.uint64(begin), np.uint64(end)):
        e = function({", ".join(arguments)})
{_residual(store)}
        valid[n] = True
    return 0
"""


def _analytic_source(variables: int, data: list[bool], store: Store) -> str:
    arguments = arguments_of(variables, data)
    zero = "\n".join(f"        J{s}[n, :, :] = 0.0" for s in range(variables))
    return f"""
def linearize(
    begin, end, {names_of("x", variables)}{names_of("index", variables)}{names_of("data", len(data))}
    r, {names_of("J", variables)}valid
):
    for n in range(np.uint64(begin), np.uint64(end)):
{zero}
        e = function({", ".join(arguments)})
{_residual(store)}
        valid[n] = True
        jacobian({", ".join([*arguments, *(f"J{s}[n]" for s in range(variables))])})
    return 0
"""


def _numeric_source(variables: int, data: list[bool], store: Store, dofs: tuple[int, ...]) -> str:
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
    call = ", ".join([*moved, *entries_of(data)])
    zeros = "\n".join(f"            J{s}[n, :, :] = 0.0" for s in range(variables))
    new_line = "\n"
    return f"""
def linearize(
    begin, end, {names_of("x", variables)}{names_of("index", variables)}{names_of("data", len(data))}
    {names_of("steps", variables)}{names_of("h", variables)}r, {names_of("J", variables)}valid
):
    one, two = np.uint64(1), np.uint64(2)
    e_of, known = np.empty(({begin}, {store.dim})), np.ones({begin})
{new_line.join(scratch)}
    for n in range(np.uint64(begin), np.uint64(end)):
        valid[n] = True{"".join(fill)}
        for probe in range(np.uint64({begin})):
{new_line.join(rows)}
            e = function({call})
{indented(store.guard("e", on_none), 12)}
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


def _residual(store: Store) -> str:
    lines = [store.guard("e", "valid[n] = False; r[n, :] = 0.0; continue")]
    lines += [f"r[n, {c}] = {entry}" for c, entry in enumerate(store.entries())]
    return indented("\n".join(lines), 8)
