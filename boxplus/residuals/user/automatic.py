"""Jacobians of a user's function by automatic differentiation: a loop that runs it on dual numbers (docs/differentiation.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import config as numba_config
from numba.core import types

from boxplus._jit import kernel
from boxplus._user_code import UserCode
from boxplus._user_loops import Store, entries_of, generated, indented, names_of, present, summary
from boxplus.differentiation.dual import partials_into, seeded, zeros
from boxplus.differentiation.dual_snapshot import dual_snapshot
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.tangents.basis import BasisPart, basis_parts, tangent_basis_into

# Directions that one run of the function carries along. More in one run do the elementary functions fewer times; beyond this, the
# derivatives of intermediate results no longer fit into the registers.
_WIDEST = 12


class NotDifferentiableError(InputError):
    """A function, or the manifold of a variable, whose derivatives compiled code cannot be made to give."""


def automatic_loop(
    code: UserCode,
    store: Store,
    manifolds: tuple[Manifold, ...],
    data: tuple[tuple[str, int, bool], ...],
) -> tuple[Any, tuple[Any, ...]]:
    """The loop that fills the Jacobians of valid residuals, and the arrays that it takes after the data.

    Raises:
        NotDifferentiableError: the function uses what dual numbers cannot do, or a manifold is not compiled.
    """
    if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise _refused(code, "compilation is switched off")
    found = [basis_parts(manifold) for manifold in manifolds]
    foreign = [manifold.name for manifold, parts in zip(manifolds, found, strict=True) if parts is None]
    if foreign:
        raise _refused(code, f"how {', '.join(foreign)} moves is not compiled code")
    parts = [part for part in found if part is not None]
    directions = sum(manifold.dof for manifold in manifolds)
    runs = -(-directions // _WIDEST)
    width = -(-directions // runs)
    function = kernel(dual_snapshot(code.snapshot(checked=False), width), inline=True, cached=False, internal=True)
    names: dict[str, Any] = {
        "function": function,
        "np": np,
        "zeros": zeros,
        "seeded": seeded,
        "partials_into": partials_into,
        "present": present,
        "tangent_basis_into": tangent_basis_into,
    }
    users: list[UserCode] = []
    for s, several in enumerate(parts):
        for part in several:
            if part.manifold is not None:
                names[f"user_{s}_{part.stored}"] = part.manifold.tangent_basis()
                users.append(part.manifold.plus)
    source = _source(manifolds, parts, [shared for _, _, shared in data], store, runs, width)
    loop = generated(__file__, "differentiate", source, names, code, *users)
    tables = tuple(part.steps for several in parts for part in several if part.steps is not None)
    try:
        loop.compile(_argument_types(len(manifolds), data, len(tables)))
    except Exception as error:
        raise _refused(code, summary(error)) from error
    return loop, tables


def _refused(code: UserCode, reason: str) -> NotDifferentiableError:
    return NotDifferentiableError(
        f"a function {code.name} that can be differentiated automatically",
        reason,
        'see docs/differentiation.md for what can, or give its Jacobian, or ask for jacobian="differences"',
    )


def _argument_types(variables: int, data: tuple[tuple[str, int, bool], ...], tables: int) -> tuple[types.Type, ...]:
    def array(dtype: Any, axes: int) -> types.Type:
        return types.Array(dtype, axes, "C")

    floats = [array(types.float64, 2)] * variables + [array(types.uint32, 1)] * variables
    measured = [array(getattr(types, dtype), axes) for dtype, axes, _ in data]
    steps = [array(types.int64, 2)] * tables
    jacobians = [array(types.float64, 3)] * variables
    return (types.int64, types.int64, *floats, *measured, *steps, *jacobians, array(types.boolean, 1))


def _source(
    manifolds: tuple[Manifold, ...],
    parts: list[tuple[BasisPart, ...]],
    data: list[bool],
    store: Store,
    runs: int,
    width: int,
) -> str:
    """Dual numbers are made of the stored numbers of each variable and of how these move with its tangent.

    `basis` has a row for every stored number of all variables, a column for every direction of all tangents. The loop returns −1
    where a row of a Jacobian is all zeros, as behind a branch that leaves early at this very point.
    """
    variables = len(manifolds)
    rows = np.concatenate([[0], np.cumsum([manifold.size for manifold in manifolds])])
    columns = np.concatenate([[0], np.cumsum([manifold.dof for manifold in manifolds])])
    directions = columns[-1]
    made, seeds, bases, nothing, filled, table = [], [], [], [], [], 0
    for s, manifold in enumerate(manifolds):
        made.append(f"y{s} = zeros(({manifold.size},), {width})")
        for part in parts[s]:
            row, column = rows[s] + part.stored, columns[s] + part.tangent
            if part.manifold is None:
                bases.append(f"tangent_basis_into(steps{table}, x{s}[index{s}[n]][{part.stored}:], basis, {row}, {column})")
                table += 1
                continue
            name, size, dof = f"user_{s}_{part.stored}", part.manifold.size, part.manifold.dof
            made += [f"unit_{name} = zeros(({dof},), {dof})", f"eye_{name} = np.eye({dof})", f"for k in range(np.uint64({dof})):"]
            made += [f"    unit_{name}[k] = seeded(0.0, eye_{name}, k, np.uint64(0), {dof})"]
            own = f"x{s}[index{s}[n]][{part.stored}:{part.stored + size}]"
            bases.append(f"{name}({own}, unit_{name}, basis, {row}, {column})")
        seeds.append(f"for i in range(np.uint64({manifold.size})):")
        seeds.append(f"    at = np.uint64({rows[s]}) + i")
        seeds.append(f"    y{s}[i] = seeded(x{s}[index{s}[n], i], basis, at, np.uint64(run * {width}), {width})")
        nothing.append(f"J{s}[n, :, :] = 0.0")
        filled.append(f"for k in range(np.uint64({manifold.dof})):")
        filled.append(f"    J{s}[n, c, k] = slopes[c, np.uint64({columns[s]}) + k]")
    filled += ["k = np.uint64(0)", f"while k < np.uint64({directions}) and slopes[c, k] == 0.0:", "    k += np.uint64(1)"]
    filled += [f"if k == np.uint64({directions}):", "    flat = -1"]
    call = ", ".join([*(f"y{s}" for s in range(variables)), *entries_of(data)])
    guard = store.guard("function(" + call + ")", "valid[n] = False; break")
    slopes = [
        f"partials_into({entry}, slopes, np.uint64({c}), np.uint64(run * {width}), 0, {width})"
        for c, entry in enumerate(store.entries())
    ]
    new_line = "\n"
    return f"""
def differentiate(
    begin, end, {names_of("x", variables)}{names_of("index", variables)}{names_of("data", len(data))}
    {names_of("steps", table)}{names_of("J", variables)}valid
):
    basis = np.zeros(({rows[-1]}, {runs * width}))
    slopes = np.zeros(({store.dim}, {runs * width}))
    flat = 0
{indented(new_line.join(made), 4)}
    for n in range(np.uint64(begin), np.uint64(end)):
        if valid[n]:
{indented(new_line.join(bases), 12)}
            for run in range({runs}):
{indented(new_line.join(seeds), 16)}
{indented(guard, 16)}
{indented(new_line.join(slopes), 16)}
        if not valid[n]:
{indented(new_line.join(nothing), 12)}
            continue
        for c in range(np.uint64({store.dim})):
{indented(new_line.join(filled), 12)}
    return flat
"""
