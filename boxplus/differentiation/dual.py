"""Dual numbers in compiled code: a value with its derivatives along several directions (docs/differentiation.md).

A `Dual(width)` is v + Σ pₖ εₖ with εᵢ εⱼ = 0. It is a scalar of compiled code as a float is: arrays hold it, tuples return it,
and a float becomes one, without derivatives, wherever the two meet. The derivatives lie in one vector of the processor, so that
an operation costs a few instructions for all directions together.
"""

# mypy: disable-error-code="no-untyped-call, call-arg"
# Numba's machinery has no types, and what it compiles has others than Python sees.

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.typeconv.castgraph import Conversion
from numba.extending import intrinsic, lower_cast, register_model
from numba.np import arrayobj

_DOUBLE = ir.DoubleType()


class Dual(types.Type):
    """The type of a dual number with derivatives along `width` directions."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"dual({width})")

    def unify(self, typingctx: Any, other: Any) -> Dual | None:
        return self if isinstance(other, types.Number) else None

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        return Conversion.safe if isinstance(other, types.Number) else None


@register_model(Dual)
class _DualModel(models.DataModel):  # type: ignore[misc]
    """As a value {double, <width x double>}; in memory 1 + width doubles one after the other, which ask for no alignment."""

    def __init__(self, manager: Any, dual: Dual) -> None:
        super().__init__(manager, dual)
        self._width = dual.width
        self._value = value_type(dual.width)
        self._data = ir.ArrayType(_DOUBLE, 1 + dual.width)

    def get_value_type(self) -> Any:
        return self._value

    def get_data_type(self) -> Any:
        return self._data

    def get_argument_type(self) -> Any:
        return self._value

    def get_return_type(self) -> Any:
        return self._data

    def as_data(self, builder: Any, value: Any) -> Any:
        data = builder.insert_value(ir.Constant(self._data, ir.Undefined), builder.extract_value(value, 0), 0)
        partials = builder.extract_value(value, 1)
        for k in range(self._width):
            data = builder.insert_value(data, builder.extract_element(partials, _index(k)), 1 + k)
        return data

    def from_data(self, builder: Any, data: Any) -> Any:
        partials = ir.Constant(self._value.elements[1], ir.Undefined)
        for k in range(self._width):
            partials = builder.insert_element(partials, builder.extract_value(data, 1 + k), _index(k))
        return assembled(builder, self._width, builder.extract_value(data, 0), partials)

    def as_argument(self, builder: Any, value: Any) -> Any:
        return value

    def from_argument(self, builder: Any, value: Any) -> Any:
        return value

    def as_return(self, builder: Any, value: Any) -> Any:
        return self.as_data(builder, value)

    def from_return(self, builder: Any, value: Any) -> Any:
        return self.from_data(builder, value)


def _index(k: int) -> Any:
    return ir.Constant(ir.IntType(32), k)


def value_type(width: int) -> Any:
    return ir.LiteralStructType([_DOUBLE, ir.VectorType(_DOUBLE, width)])


def assembled(builder: Any, width: int, value: Any, partials: Any | None) -> Any:
    """The dual number of a value and its derivatives; None where there are none."""
    kind = value_type(width)
    if partials is None:
        partials = ir.Constant(kind.elements[1], [0.0] * width)
    dual = builder.insert_value(ir.Constant(kind, ir.Undefined), value, 0)
    return builder.insert_value(dual, partials, 1)


def parts(context: Any, builder: Any, kind: Any, value: Any) -> tuple[Any, Any | None]:
    """The value of a dual or plain number, and the vector of its derivatives; None for a plain one."""
    if isinstance(kind, Dual):
        return builder.extract_value(value, 0), builder.extract_value(value, 1)
    return context.cast(builder, value, kind, types.float64), None


def scaled(builder: Any, scalar: Any, vector: Any) -> Any:
    """scalar · vector."""
    width = vector.type.count
    single = builder.insert_element(ir.Constant(vector.type, ir.Undefined), scalar, _index(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width)
    return builder.fmul(builder.shuffle_vector(single, single, zeros), vector, flags=("contract",))


def added(builder: Any, a: Any | None, b: Any | None) -> Any | None:
    """a + b of two vectors, None standing for zero."""
    if a is None or b is None:
        return b if a is None else a
    return builder.fadd(a, b, flags=("contract",))


@lower_cast(types.Number, Dual)
def _number_to_dual(context: Any, builder: Any, number: Any, dual: Dual, value: Any) -> Any:
    return assembled(builder, dual.width, context.cast(builder, value, number, types.float64), None)


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def seeded(typing_context: Any, value: Any, seeds: Any, row: Any, column: Any, width: Any) -> Any:
    """value + Σ seeds[row, column + k] εₖ, k < width."""
    dual = Dual(width.literal_value)
    signature = dual(types.float64, seeds, types.uint64, types.uint64, width)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[1])(context, builder, arguments[1])
        pointer = cgutils.get_item_pointer(context, builder, signature.args[1], array, list(arguments[2:4]))
        pointer = builder.bitcast(pointer, ir.PointerType(ir.VectorType(_DOUBLE, dual.width)))
        return assembled(builder, dual.width, arguments[0], builder.load(pointer, align=8))

    return signature, generate


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def partials_into(typing_context: Any, number: Any, J: Any, row: Any, first: Any, begin: Any, end: Any) -> Any:
    """J[row, first + k − begin] = derivative k of a number, begin ≤ k < end."""
    bounds = begin.literal_value, end.literal_value

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[1]
        array = context.make_array(kind)(context, builder, arguments[1])
        _, partials = parts(context, builder, signature.args[0], arguments[0])
        for k in range(*bounds):
            column = builder.add(arguments[3], ir.Constant(arguments[3].type, k - bounds[0]))
            pointer = cgutils.get_item_pointer(context, builder, kind, array, [arguments[2], column])
            entry = ir.Constant(_DOUBLE, 0.0) if partials is None else builder.extract_element(partials, _index(k))
            builder.store(entry, pointer)
        return context.get_dummy_value()

    return types.void(number, J, types.uint64, types.uint64, begin, end), generate


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def zeros(typing_context: Any, shape: Any, width: Any) -> Any:
    """A new array of dual zeros; the shape is a tuple of integers."""
    array = types.Array(Dual(width.literal_value), len(shape), "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lengths = [
            context.cast(builder, length, kind, types.intp)
            for length, kind in zip(cgutils.unpack_tuple(builder, arguments[0]), signature.args[0], strict=True)
        ]
        made = arrayobj._empty_nd_impl(context, builder, array, lengths)
        cgutils.memset(builder, made.data, builder.mul(made.itemsize, made.nitems), 0)
        return made._getvalue()

    return array(shape, width), generate
