"""What dual numbers do in compiled code: + − · /, comparisons, and functions by their slopes (docs/differentiation.md)."""

# mypy: disable-error-code="no-untyped-call, arg-type, misc, assignment"
# Numba's machinery has no types, and what it compiles has others than Python sees.

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.compiler import Flags
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

from boxplus.differentiation.dual import Dual, added, assembled, parts, scaled
from boxplus.differentiation.slopes import BINARY, POWERS, TESTS, UNARY, power, power_of_integer

_COMPARISONS = {
    operator.lt: "<",
    operator.le: "<=",
    operator.gt: ">",
    operator.ge: ">=",
    operator.eq: "==",
    operator.ne: "!=",
}


def _dual_of(arguments: Any) -> Dual | None:
    """The dual type among arguments that are all numbers; None where there is none, or another kind of argument."""
    found = [kind for kind in arguments if isinstance(kind, Dual)]
    others = all(isinstance(kind, types.Number | types.Boolean | Dual) for kind in arguments)
    return found[0] if found and others else None


def _register(key: Any, arity: int, lower: Callable[..., Any], returns: Any = None, *, keeps_integers: bool = False) -> None:
    """Type and lower `key` for `arity` arguments one of which is dual; it returns a dual number, or the type given."""

    kept = {False: Dual, True: (Dual, types.Integer)}

    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, arguments: Any, keywords: Any) -> Any:
            dual = _dual_of(arguments) if len(arguments) == arity and not keywords else None
            if dual is None:
                return None
            kinds = [
                kind if isinstance(kind, kept[n == 1 and keeps_integers]) else types.float64 for n, kind in enumerate(arguments)
            ]
            return signature(dual if returns is None else returns, *kinds)

    infer_global(key)(Template)
    kinds: list[tuple[Any, ...]] = [(Dual,)]
    if arity == 2:
        kinds = [(Dual, Dual), (Dual, types.Float), (types.Float, Dual)]
    for kind in kinds:
        lower_builtin(key, *kind)(lower)


def _add(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    (a, da), (b, db) = (parts(context, builder, *pair) for pair in zip(sig.args, arguments, strict=True))
    return assembled(builder, sig.return_type.width, builder.fadd(a, b), added(builder, da, db))


def _subtract(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    (a, da), (b, db) = (parts(context, builder, *pair) for pair in zip(sig.args, arguments, strict=True))
    if db is None:
        difference = da
    else:
        difference = builder.fneg(db) if da is None else builder.fsub(da, db)
    return assembled(builder, sig.return_type.width, builder.fsub(a, b), difference)


def _multiply(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    (a, da), (b, db) = (parts(context, builder, *pair) for pair in zip(sig.args, arguments, strict=True))
    by_a = None if da is None else scaled(builder, b, da)
    by_b = None if db is None else scaled(builder, a, db)
    return assembled(builder, sig.return_type.width, builder.fmul(a, b), added(builder, by_a, by_b))


def _divide(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    (a, da), (b, db) = (parts(context, builder, *pair) for pair in zip(sig.args, arguments, strict=True))
    quotient, inverse = builder.fdiv(a, b), builder.fdiv(ir.Constant(a.type, 1.0), b)
    by_a = None if da is None else scaled(builder, inverse, da)
    by_b = None if db is None else scaled(builder, builder.fneg(builder.fmul(quotient, inverse)), db)
    return assembled(builder, sig.return_type.width, quotient, added(builder, by_a, by_b))


def _negate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    a, da = parts(context, builder, sig.args[0], arguments[0])
    return assembled(builder, sig.return_type.width, builder.fneg(a), builder.fneg(da))


def _same(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    return arguments[0]


def _comparison(symbol: str) -> Callable[..., Any]:
    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        (a, _), (b, _) = (parts(context, builder, *pair) for pair in zip(sig.args, arguments, strict=True))
        return (builder.fcmp_unordered if symbol == "!=" else builder.fcmp_ordered)(symbol, a, b)

    return lower


def _register_choice(key: Any, symbol: str) -> None:
    """min and max of several, as Python has them: the first unless another is beyond it."""

    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, arguments: Any, keywords: Any) -> Any:
            dual = _dual_of(arguments)
            return None if dual is None or keywords or len(arguments) < 2 else signature(dual, *[dual] * len(arguments))

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        chosen = arguments[0]
        for other in arguments[1:]:
            beyond = builder.fcmp_ordered(symbol, builder.extract_value(other, 0), builder.extract_value(chosen, 0))
            picked = [builder.select(beyond, builder.extract_value(other, k), builder.extract_value(chosen, k)) for k in (0, 1)]
            chosen = assembled(builder, sig.return_type.width, *picked)
        return chosen

    infer_global(key)(Template)
    lower_builtin(key, Dual, types.VarArg(Dual))(lower)


def by_slopes(rule: Callable[..., tuple[float, ...]]) -> Callable[..., Any]:
    """Lower a function whose rule gives, of plain numbers, its value and then its derivative by each argument.

    Along a direction in which an argument stands still its derivative does not count, be it infinite: √(x² + y²) of two constant
    zeros has derivative zero.
    """

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        values, vectors = zip(
            *(
                (value, None) if isinstance(kind, types.Integer) else parts(context, builder, kind, value)
                for kind, value in zip(sig.args, arguments, strict=True)
            ),
            strict=True,
        )
        plain = [kind if isinstance(kind, types.Integer) else types.float64 for kind in sig.args]
        results = types.UniTuple(types.float64, 1 + len(values))
        call = signature(results, *plain)
        flags = Flags()
        flags.error_model = "numpy"  # at a corner a slope is infinite, not an exception
        compiled = context.compile_subroutine(builder, rule, call, flags=flags)
        found = cgutils.unpack_tuple(builder, context.call_internal(builder, compiled.fndesc, call, values))
        total = None
        for slope, vector in zip(found[1:], vectors, strict=True):
            if vector is not None:
                nothing = ir.Constant(vector.type, [0.0] * vector.type.count)
                moves = builder.fcmp_unordered("!=", vector, nothing)
                total = added(builder, total, builder.select(moves, scaled(builder, slope, vector), nothing))
        return assembled(builder, sig.return_type.width, found[0], total)

    return lower


def _of_value(function: Any) -> Callable[..., Any]:
    """A question about the value alone, such as whether it is finite."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value, _ = parts(context, builder, sig.args[0], arguments[0])
        return context.compile_internal(builder, lambda x: function(x), signature(types.boolean, types.float64), [value])

    return lower


for _key, _inplace, _lower in (
    (operator.add, operator.iadd, _add),
    (operator.sub, operator.isub, _subtract),
    (operator.mul, operator.imul, _multiply),
    (operator.truediv, operator.itruediv, _divide),
):
    _register(_key, 2, _lower)
    _register(_inplace, 2, _lower)
_register(operator.neg, 1, _negate)
_register(operator.pos, 1, _same)
_register(float, 1, _same)
for _key, _symbol in _COMPARISONS.items():
    _register(_key, 2, _comparison(_symbol), types.boolean)
_register_choice(min, "<")
_register_choice(max, ">")
for _keys, _rule in UNARY:
    for _key in _keys:
        _register(_key, 1, by_slopes(_rule))
for _keys, _rule in BINARY:
    for _key in _keys:
        _register(_key, 2, by_slopes(_rule))
for _key in POWERS:
    # Whole exponents have a rule of their own: a negative number has powers, and zero has derivatives.
    _register(_key, 2, by_slopes(power), keeps_integers=True)
    lower_builtin(_key, Dual, types.Integer)(by_slopes(power_of_integer))
for _key in TESTS:
    _register(_key, 1, _of_value(_key), types.boolean)
