"""The only door to Numba: the `kernel` decorator, and the thread pool."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numba
from numba.core import config as numba_config
from numba.core import event as numba_event

from boxplus._kernel_cache import KernelCache

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(
    function: _Function | None = None,
    *,
    fastmath: bool = False,
    inline: bool = False,
    borrow: bool = False,
    cached: bool | str = True,
    checked: bool = False,
    internal: bool = False,
) -> Any:
    """Compile a function to native code: releases the GIL, divides like C, and is cached on disk.

    `fastmath` allows contraction and reassociation only; NaN and infinity keep their meaning. `inline` asks LLVM to
    inline the function wherever it is called (small helpers of a hot loop). `borrow` leaves the reference counts of the
    arguments alone, which are otherwise raised and lowered, atomically, in every call of a function with a loop: for
    kernels that are called once a point, or on the same arrays by several threads. Such a kernel cannot allocate. What is
    not `cached` is compiled in every process; what is `cached` under a name of its own, which stands for all that decides what it
    does, is a function that a user wrote or that is generated around one (`_user_code.py`). What is `checked` raises IndexError
    where it would read or write beyond an array: functions of users. What is `internal` is called by other kernels only, with
    values that Python does not know.
    """
    if function is None:
        return lambda f: kernel(
            f, fastmath=fastmath, inline=inline, borrow=borrow, cached=cached, checked=checked, internal=internal
        )
    flags = {"contract", "reassoc"} if fastmath else False
    options: dict[str, Any] = {
        "nogil": True,
        "error_model": "numpy",
        "fastmath": flags,
        "_nrt": not borrow,
        "boundscheck": checked,
        "no_cfunc_wrapper": True,  # of functions that are passed as values, which none of ours is; 5 % of compiling
    }
    if inline:
        options["forceinline"] = True
    if internal:
        options["no_cpython_wrapper"] = True
    dispatcher = numba.njit(**options)(function)
    if cached and not numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        dispatcher._cache = KernelCache(dispatcher.py_func, cached if isinstance(cached, str) else None)
    return dispatcher


@contextlib.contextmanager
def on_compilation(callback: Callable[[str], None]) -> Iterator[None]:
    """While the block runs, call `callback(kernel_name)` whenever a kernel has to be compiled (not when it is cached)."""

    class Listener(numba_event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            callback(str(event.data["dispatcher"].py_func.__name__))

        def on_end(self, event: Any) -> None:
            pass

    with numba_event.install_listener("numba:compile", Listener()):
        yield


_pools: dict[int, ThreadPoolExecutor] = {}
_pools_lock = threading.Lock()


def _pool(threads: int) -> ThreadPoolExecutor:
    with _pools_lock:
        if threads not in _pools:
            _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="boxplus")
        return _pools[threads]


def run_chunks(work: Callable[[int, int, int], None], items: int, chunk: int, threads: int) -> int:
    """Call `work(chunk_index, begin, end)` over fixed chunks of `range(items)`, on `threads` threads.

    The chunks depend only on `items` and `chunk`, never on `threads`: a caller that lets every chunk write its own
    partial result and adds the partial results in chunk order gets the same bits for any number of threads. Returns the
    number of chunks. `work` should spend its time in kernels, which release the GIL.
    """
    if 0 < items <= chunk:
        work(0, 0, items)
        return 1
    bounds = [(index, begin, min(begin + chunk, items)) for index, begin in enumerate(range(0, items, chunk))]
    if threads <= 1 or len(bounds) <= 1:
        for bound in bounds:
            work(*bound)
        return len(bounds)
    pending = iter(bounds)  # taking the next one is atomic

    def drain() -> None:
        for bound in pending:
            work(*bound)

    # The caller works too: it need not wait for a thread to wake up, and a short piece of work is over before one does.
    helpers = [_pool(threads).submit(drain) for _ in range(min(threads, len(bounds)) - 1)]
    try:
        drain()
    finally:
        for helper in helpers:
            helper.result()
    return len(bounds)
