"""The inner node of an ikd-tree, and the distances from a point to the boxes of both its children: one LLVM vector.

As in `leaf`, the plain Python function runs without the compiler, and its compiled counterpart gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

# One cache line: a visit reads both children's boxes here and never touches a child it prunes.
INNER = np.dtype(
    [
        ("box", np.float32, (2, 6)),  # per child: low x, y, z, high x, y, z; covers every stored point below
        ("child", np.uint32, 2),
        ("split", np.float32),  # left ≤ split ≤ right on `axis`
        ("axis", np.uint8),
        ("label", np.uint8, 2),
        ("queued", np.uint8),  # already noted as out of balance
    ],
    align=True,
)

_BYTE, _LANE, _WORD, _SIZE = ir.IntType(8), ir.FloatType(), ir.IntType(32), ir.IntType(64)
_CORNER = ir.VectorType(_LANE, 4)  # x, y, z and a lane that is not used
_CORNERS = ir.VectorType(_LANE, 8)  # of both children
_LOW, _HIGH = (0, 24), (12, 36)  # bytes from the start of the record, left and right


def boxes_sq(
    inner: NDArray[np.void], index: np.uint32, x: np.float32, y: np.float32, z: np.float32
) -> tuple[np.float32, np.float32]:
    """Squared distances from a point to the boxes of the left and the right child."""
    box, point = inner[index]["box"], np.array([x, y, z], np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # the box of an empty slot reaches from inf to -inf
        offset = np.maximum(np.maximum(box[:, :3] - point, point - box[:, 3:]), np.float32(0))
        square = offset * offset
        total = square[:, 0] + square[:, 1] + square[:, 2]
    return total[0], total[1]


@intrinsic  # type: ignore[misc]
def _boxes_sq(_: Any, inner: Any, index: Any, x: Any, y: Any, z: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        array, row, *query = arguments
        data = context.make_array(inner)(context, builder, array).data
        place = builder.mul(builder.zext(row, _SIZE), ir.Constant(_SIZE, INNER.itemsize))
        record = builder.gep(builder.bitcast(data, _BYTE.as_pointer()), [place])

        def corners(offsets: tuple[int, int]) -> ir.Value:
            left, right = (builder.gep(record, [ir.Constant(_SIZE, offset)]) for offset in offsets)
            pair = [builder.load(builder.bitcast(side, _CORNER.as_pointer()), align=4) for side in (left, right)]
            return _shuffle(builder, pair[0], pair[1], range(8))

        def larger(a: ir.Value, b: ir.Value) -> ir.Value:
            return builder.select(builder.fcmp_ordered(">", a, b), a, b)

        point = ir.Constant(_CORNER, ir.Undefined)
        for lane, coordinate in enumerate((*query, query[2])):
            point = builder.insert_element(point, coordinate, ir.Constant(_WORD, lane))
        point = _shuffle(builder, point, point, (0, 1, 2, 3, 0, 1, 2, 3))
        offset = larger(builder.fsub(corners(_LOW), point), builder.fsub(point, corners(_HIGH)))
        offset = larger(offset, ir.Constant(_CORNERS, [0.0] * 8))
        square = builder.fmul(offset, offset)
        total = builder.fadd(square, _shuffle(builder, square, square, (1, 1, 1, 1, 5, 5, 5, 5)))
        total = builder.fadd(total, _shuffle(builder, square, square, (2, 2, 2, 2, 6, 6, 6, 6)))
        sides = [builder.extract_element(total, ir.Constant(_WORD, lane)) for lane in (0, 4)]
        return context.make_tuple(builder, signature.return_type, sides)

    single = types.float32
    pair = types.UniTuple(single, 2)  # type: ignore[no-untyped-call]
    return pair(inner, types.uint32, single, single, single), generate


def _shuffle(builder: Any, a: ir.Value, b: ir.Value, lanes: Any) -> ir.Value:
    """Lanes of two vectors, in a new order."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_WORD, len(lanes)), list(lanes)))


@overload(boxes_sq, strict=False)  # type: ignore[misc]
def _compile_boxes_sq(inner: Any, index: Any, x: Any, y: Any, z: Any) -> Callable[..., Any]:
    return lambda inner, index, x, y, z: _boxes_sq(inner, index, x, y, z)  # type: ignore[call-arg]
