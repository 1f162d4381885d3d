"""Ask for memory ahead of its use, where the processor cannot know what comes next: a walk through a tree."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core import config as numba_config
from numba.extending import intrinsic

_INT = ir.IntType(32)
_TO_READ, _KEPT, _DATA = 0, 3, 1  # LLVM's arguments: not to write, in all caches, not instructions


def _emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0])  # type: ignore[no-untyped-call]
    place = builder.bitcast(builder.gep(array.data, [arguments[1]]), ir.PointerType(ir.IntType(8)))
    kind = ir.FunctionType(ir.VoidType(), [place.type, _INT, _INT, _INT])
    fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")  # type: ignore[no-untyped-call]
    builder.call(fetch, [place, _INT(_TO_READ), _INT(_KEPT), _INT(_DATA)])
    return context.get_dummy_value()


@intrinsic  # type: ignore[untyped-decorator]
def _prefetch(typing: Any, array: Any, index: Any) -> Any:
    return types.void(array, index), _emit


def _ignore(array: Any, index: Any) -> None:
    """Nothing: where Numba does not compile, memory is not what takes time."""


prefetch: Any = _ignore if numba_config.DISABLE_JIT else _prefetch  # type: ignore[attr-defined]
"""`prefetch(array, index)` fetches the cache line of an element of a contiguous array; any index will do, nothing is read."""
