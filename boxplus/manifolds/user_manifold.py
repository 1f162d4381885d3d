"""Manifolds that a user writes as functions of one point, compiled: as fast as the shipped ones (docs/extending.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba.core import config as numba_config
from numba.core import types
from numba.core.errors import NumbaError
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus._user_code import UserCode
from boxplus._user_loops import Store, check_arguments, compiled, generated, indented, summary
from boxplus.differentiation.dual import partials_into, seeded, zeros
from boxplus.differentiation.dual_snapshot import dual_snapshot
from boxplus.errors import InputError
from boxplus.manifolds._kernel_manifold import KernelManifold, checked_rows

_STEP = 1e-5  # of differences, where compilation is switched off
_ROUNDING = 1e-9
_SLOPE = 1e-6  # of derivatives that are the identity but for rounding
_LINE = types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
_STACK = types.Array(types.float64, 3, "C")


class UserManifold(KernelManifold):
    """A manifold given by ⊞ and ⊟ of one point, plain Python functions that are compiled and kept on disk.

        def plus(x, delta):      # rows (size,) and (dof,); x ⊞ δ as `size` numbers, a tuple or an array
        def minus(x, base):      # rows (size,) and (size,); x ⊟ base as `dof` numbers

    They may call kernels of `boxplus.manifolds` and functions of your own under `numba.njit`; which entries of their arguments
    they read must not depend on the values. What has to hold are the axioms

        x ⊞ 0 = x,   x ⊞ (y ⊟ x) = y,   (x ⊞ δ) ⊟ x = δ

    (Hertzberg et al., Integrating generic sensor fusion algorithms, 2013, section 3), which are looked at near `identity` when
    the manifold is made, with the derivative of the last at δ = 0, by which tangents are compared. Jacobians come from the
    compiled functions by automatic differentiation (docs/differentiation.md), or from functions of your own. Two are equal where
    what they compile to cannot differ.

    Args:
        name: as a user writes it, for messages.
        size, dof: numbers stored for a point, numbers of a tangent.
        plus, minus: as above; they must not change their arguments.
        identity: (size,) the origin.
        tangent_names: (dof,) what each tangent direction moves, with its unit; numbered otherwise.
        plus_jacobian: takes (x, delta, J) and fills J (dof, dof), zeros, with ∂((x ⊞ (δ + ε)) ⊟ (x ⊞ δ))/∂ε at ε = 0.
        minus_jacobian: takes (x, base, J) and fills it with ∂((x ⊞ ε) ⊟ base)/∂ε at ε = 0.
        brought_onto: takes (n, size) finite numbers and returns them brought onto the manifold where they are off by rounding
            only, or raises an InputError; NumPy, once for every block of variables.

    Raises:
        InputError: functions that do not compile, return another number of values, cannot be differentiated, or break an axiom.

    Example:
        >>> def grown(x, delta):
        ...     return (x[0] * np.exp(delta[0]),)
        >>> def growth(x, base):
        ...     return (np.log(x[0] / base[0]),)
        >>> Scale = bp.UserManifold("Scale", size=1, dof=1, plus=grown, minus=growth, identity=[1.0], tangent_names=["scale [1]"])
        >>> Scale.boxplus([2.0], [np.log(3.0)]).round(12), Scale
        (array([6.]), Scale)
    """

    def __init__(
        self,
        name: str,
        *,
        size: int,
        dof: int,
        plus: Callable[..., Any],
        minus: Callable[..., Any],
        identity: ArrayLike,
        tangent_names: Sequence[str] | None = None,
        plus_jacobian: Callable[..., Any] | None = None,
        minus_jacobian: Callable[..., Any] | None = None,
        brought_onto: Callable[[NDArray[np.float64]], ArrayLike] | None = None,
    ) -> None:
        if size < 1 or dof < 1:
            raise InputError("size ≥ 1 and dof ≥ 1", f"{size} and {dof}", "count the numbers of a point and of a tangent")
        self.name, self.size, self.dof = name, size, dof
        self.tangent_names = tuple(tangent_names or (f"{name} {k}" for k in range(dof)))
        if len(self.tangent_names) != dof:
            raise InputError(f"{dof} tangent_names", f"{len(self.tangent_names)}", "give one for each direction")
        for role, function in (("plus", plus), ("minus", minus)):
            check_arguments(role, function, 2, "x and delta" if role == "plus" else "x and base")
        for role, jacobian in (("plus_jacobian", plus_jacobian), ("minus_jacobian", minus_jacobian)):
            if jacobian is not None:
                check_arguments(role, jacobian, 3, "those of the function, and then J (dof, dof) to fill")
        self.plus, self.minus = UserCode.of(plus), UserCode.of(minus)
        self._jacobians = tuple(None if j is None else UserCode.of(j) for j in (plus_jacobian, minus_jacobian))
        self._brought_onto = brought_onto
        self._identity = checked_rows("identity", identity, size, name)[0]
        # An index beyond an array is looked for here, where the axioms are; to look in every call would take twice the time.
        self._plus = self._mapping("plus", self.plus, size, checked=True)
        self._minus = self._mapping("minus", self.minus, dof, checked=True)
        self._check_axioms()
        self._plus = self._mapping("plus", self.plus, size, checked=False)
        self._minus = self._mapping("minus", self.minus, dof, checked=False)
        self._plus_jacobian = self._jacobian("plus_jacobian", self._jacobians[0])
        self._minus_jacobian = self._jacobian("minus_jacobian", self._jacobians[1])
        self._check_derivatives_at_zero()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UserManifold) and self._parts == other._parts

    def __hash__(self) -> int:
        return hash(self._parts)

    @property
    def _parts(self) -> tuple[Any, ...]:
        return self.name, self.size, self.dof, self.plus, self.minus, self._jacobians, self._brought_onto

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        self._run(self._plus, "plus", self.size, x, delta, out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        self._run(self._minus, "minus", self.dof, x, base, out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        self._plus_jacobian(x, delta, J)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        self._minus_jacobian(x, base, J)

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        rows = checked_rows(name, x, self.size, self.name)
        if self._brought_onto is None:
            return rows
        brought = as_floats(self._brought_onto(rows), f"{name} brought onto {self.name}")
        return checked_rows(name, brought, self.size, self.name)

    def identity(self) -> NDArray[np.float64]:
        return np.array(self._identity)

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Tangents of unit normal numbers away from the identity."""
        return self.boxplus(self._identity, rng.normal(size=(count, self.dof)))

    def tangent_basis(self) -> Any:
        """A kernel (x (size,), unit, basis, row, column) that writes ∂(x ⊞ δ)/∂δ at δ = 0 to basis[row:, column:]; `unit` are the
        dual numbers of a tangent of zeros, one direction each."""
        function = self._dual(self.plus)
        entries = "\n".join(
            f"partials_into(moved[{i}], basis, np.uint64(row + {i}), np.uint64(column), 0, {self.dof})" for i in range(self.size)
        )
        source = f"def user_basis(x, unit, basis, row, column):\n    moved = function(x, unit)\n{indented(entries, 4)}\n"
        scope = {"function": function, "partials_into": partials_into, "np": np, "__name__": __name__}
        exec(compile(source, "<boxplus user_basis>", "exec"), scope)
        return kernel(scope["user_basis"], inline=True, cached=False, internal=True)

    def _basis(self, x: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(size, dof) what `tangent_basis` gives at x (size,); None where ⊞ is not differentiated."""
        if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
            return None
        source = f"""
def basis_at(x, basis):
    unit, eye = zeros(({self.dof},), {self.dof}), np.eye({self.dof})
    for k in range(np.uint64({self.dof})):
        unit[k] = seeded(0.0, eye, k, np.uint64(0), {self.dof})
    user_basis(x, unit, basis, 0, 0)
"""
        try:
            names = {"np": np, "zeros": zeros, "seeded": seeded, "user_basis": self.tangent_basis()}
            loop = generated(__file__, "basis_at", source, names, self.plus)
            loop.compile((_LINE, _TABLE))
        except NumbaError:  # with Jacobians of one's own it need not be differentiable
            return None
        basis = np.zeros((self.size, self.dof))
        loop(x, basis)
        return basis

    def _dual(self, code: UserCode) -> Any:
        return kernel(dual_snapshot(code.snapshot(checked=False), self.dof), inline=True, cached=False, internal=True)

    def _mapping(self, role: str, code: UserCode, count: int, *, checked: bool) -> Callable[..., int]:
        function, returned = compiled("function", code, (_LINE, _LINE), checked=checked)
        store = Store(returned, count, code.name)
        if returned is not None and store.can_be_none:
            raise InputError(f"{count} numbers from {code.name}", "None at times", f"let {role} have a value everywhere")
        guard = "\n".join(line for line in store.guard("function(x[n], other[n])", "pass").splitlines() if "present" not in line)
        if returned is None:
            guard = f"found = function(x[n], other[n])\nif len(found) != {count}:\n    return len(found) + 1"
        # All numbers are there before the first is written: `out` may be x.
        taken = ", ".join(store.entries())
        source = f"""
def {role}(x, other, out):
    for n in range(np.uint64(x.shape[0])):
{indented(guard, 8)}
        {", ".join(f"e{i}" for i in range(count))}, = {taken},
{indented(chr(10).join(f"out[n, {i}] = e{i}" for i in range(count)), 8)}
    return 0
"""
        name = f"# {'with' if checked else 'without'} a look at bounds"
        loop: Callable[..., int] = generated(__file__, role, name + source, {"function": function, "np": np}, code)
        return loop

    def _run(
        self, loop: Callable[..., int], role: str, count: int, x: NDArray[np.float64], other: NDArray[np.float64], out: Any
    ) -> None:
        code = self.plus if role == "plus" else self.minus
        try:
            wrong = loop(x, other, out)
        except IndexError:
            raise InputError(
                f"indices within x ({self.size},) and {'delta' if role == 'plus' else 'base'} ({other.shape[1]},) in {code.name}",
                "one beyond the end",
                "correct the index",
            ) from None
        if wrong:
            raise InputError(f"{count} numbers from {code.name}", f"{wrong - 1}", "return as many as size and dof say")

    def _jacobian(self, role: str, written: UserCode | None) -> Callable[..., Any]:
        if written is not None:
            function, _ = compiled("jacobian", written, (_LINE, _LINE, _TABLE), checked=True)
            source = (
                f"def {role}(x, other, J):\n    for n in range(np.uint64(x.shape[0])):\n        function(x[n], other[n], J[n])\n"
            )
            loop: Callable[..., Any] = generated(__file__, role, source, {"function": function, "np": np}, written)
            return loop
        if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
            return self._differences(role)
        # What is differentiated is (x ⊞ (δ + ε)) ⊟ (x ⊞ δ), or (x ⊞ ε) ⊟ base.
        is_plus = role == "plus_jacobian"
        at, base = ("other[n, k]", "here") if is_plus else ("0.0", "other[n]")
        moved = "\n".join(f"y[{i}] = moved[{i}]" for i in range(self.size))
        there = ["found = plus(x[n], other[n])", *(f"here[{i}] = found[{i}]" for i in range(self.size))] if is_plus else []
        slopes = "\n".join(f"partials_into(e[{i}], J[n], np.uint64({i}), np.uint64(0), 0, {self.dof})" for i in range(self.dof))
        source = f"""
def {role}(x, other, J):
    unit, here = np.eye({self.dof}), np.empty({self.size})
    d, y = zeros(({self.dof},), {self.dof}), zeros(({self.size},), {self.dof})
    for n in range(np.uint64(x.shape[0])):
{indented(chr(10).join(there), 8)}
        for k in range(np.uint64({self.dof})):
            d[k] = seeded({at}, unit, k, np.uint64(0), {self.dof})
        moved = plus_dual(x[n], d)
{indented(moved, 8)}
        e = minus_dual(y, {base})
{indented(slopes, 8)}
"""
        plain = kernel(self.plus.snapshot(checked=False), inline=True, cached=False)
        names = {"np": np, "zeros": zeros, "seeded": seeded, "partials_into": partials_into, "plus": plain}
        names |= {"plus_dual": self._dual(self.plus), "minus_dual": self._dual(self.minus)}
        automatic = generated(__file__, role, source, names, self.plus, self.minus)
        try:
            automatic.compile((_TABLE, _TABLE, _STACK))
        except Exception as error:
            raise InputError(
                f"a plus and a minus of {self.name} that can be differentiated automatically",
                summary(error),
                f"see docs/differentiation.md for what can, or give {role}",
            ) from error
        return automatic  # type: ignore[no-any-return]

    def _differences(self, role: str) -> Callable[..., Any]:
        def fill(x: NDArray[np.float64], other: NDArray[np.float64], J: NDArray[np.float64]) -> None:
            for k, e in enumerate(_STEP * np.eye(self.dof)):
                if role == "plus_jacobian":
                    base, ahead, behind = self.boxplus(x, other), self.boxplus(x, other + e), self.boxplus(x, other - e)
                else:
                    base, ahead, behind = other, self.boxplus(x, e), self.boxplus(x, -e)
                J[:, :, k] = (self.boxminus(ahead, base) - self.boxminus(behind, base)) / (2.0 * _STEP)

        return fill

    def _check_axioms(self) -> None:
        """Near the identity, where every manifold is smooth and far from its ends."""
        x, delta = self._identity, 0.1 * np.cos(np.arange(1.0, 1.0 + self.dof))
        y = self.boxplus(x, delta)
        for what, got, expected in (
            ("x ⊞ 0 = x", self.boxplus(x, np.zeros(self.dof)), x),
            ("(x ⊞ δ) ⊟ x = δ", self.boxminus(y, x), delta),
            ("x ⊞ (y ⊟ x) = y", self.boxplus(x, self.boxminus(y, x)), y),
        ):
            if not np.abs(got - expected).max() <= _ROUNDING * max(1.0, np.abs(expected).max()):
                raise InputError(
                    f"{what} on {self.name}, at the identity {x} and δ = {delta.round(4)}",
                    f"{got} where {expected} is expected",
                    "let minus undo what plus does",
                )

    def _check_derivatives_at_zero(self) -> None:
        """∂((x ⊞ δ) ⊟ x)/∂δ is the identity at δ = 0: a function that leaves early there has other derivatives than beside it."""
        x = self._identity
        points = np.array([x, self.boxplus(x, 0.1 * np.cos(np.arange(1.0, 1.0 + self.dof)))])
        advice = "let no branch at δ = 0 or x = base leave early (if n < eps: return x): let it choose a factor, not the result"
        is_compiled = not numba_config.DISABLE_JIT  # type: ignore[attr-defined]
        for role, own, J in (
            ("plus", self._jacobians[0], self.boxplus_jacobian(points, np.zeros((2, self.dof)))),
            ("minus", self._jacobians[1], self.boxminus_jacobian(points, points)),
        ):
            if (is_compiled or own is not None) and not np.abs(J - np.eye(self.dof)).max() <= _SLOPE:
                source = f"{role}_jacobian" if own else "the derivatives of plus and minus"
                raise InputError(
                    f"∂((x ⊞ δ) ⊟ x)/∂δ = 1 at δ = 0 on {self.name}, the derivative of an axiom",
                    f"{J[0].round(6).tolist()} at x = {x} from {source}",
                    "correct it" if own else advice,
                )
        if any(self._jacobians) and (basis := self._basis(x)) is not None:  # otherwise it is part of what was looked at
            e = _STEP * np.eye(self.dof)
            expected = ((self.boxplus(x, e) - self.boxplus(x, -e)) / (2.0 * _STEP)).T
            if not np.abs(basis - expected).max() <= 1e-5 * max(1.0, np.abs(expected).max(), np.abs(x).max()):
                raise InputError(
                    f"derivatives {expected.round(6).tolist()} of x ⊞ δ at δ = 0 on {self.name}, as differences give them",
                    f"{basis.round(6).tolist()} from plus",
                    advice,
                )
