"""The door to Numba: chunks that do not depend on the threads."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import threading
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba.core import config as numba_config
from numba.core.dispatcher import Dispatcher

import boxplus
from boxplus import _jit


@given(st.integers(0, 50), st.integers(1, 20), st.integers(1, 4))
def test_chunks_cover_everything_once(items: int, chunk: int, threads: int) -> None:
    done: dict[int, tuple[int, int]] = {}
    count = _jit.run_chunks(lambda index, begin, end: done.__setitem__(index, (begin, end)), items, chunk, threads)
    assert count == len(done) == -(-items // chunk)
    assert [row for index in range(count) for row in range(*done[index])] == list(range(items))
    assert all(end - begin <= chunk for begin, end in done.values())


@given(st.integers(0, 2**32 - 1), st.integers(1, 64))
def test_partial_sums_do_not_depend_on_the_threads(seed: int, chunk: int) -> None:
    values = np.random.default_rng(seed).normal(size=200) * 10.0 ** np.arange(-100, 100)
    totals = []
    for threads in (1, 2, 3):
        parts = np.zeros(200)

        def work(index: int, begin: int, end: int, parts: np.ndarray = parts) -> None:
            parts[index] = values[begin:end].sum()

        count = _jit.run_chunks(work, len(values), chunk, threads)
        total = 0.0
        for part in parts[:count]:
            total += part
        totals.append(total)
    assert totals[0] == totals[1] == totals[2]


def test_one_thread_is_the_callers_own() -> None:
    seen = set()
    _jit.run_chunks(lambda *_: seen.add(threading.get_ident()), 10, 3, 1)
    assert seen == {threading.get_ident()}


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_chunk_comes_out(threads: int) -> None:
    def work(index: int, begin: int, end: int) -> None:
        if index == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _jit.run_chunks(work, 10, 3, threads)


def _called_by(kernel: Dispatcher) -> Iterator[Dispatcher]:
    """Kernels that a kernel calls, by their own name or as attributes of a module."""
    code = kernel.py_func.__code__
    known = inspect.getclosurevars(kernel.py_func)
    for value in (*known.globals.values(), *known.nonlocals.values()):
        attributes = [getattr(value, name, None) for name in code.co_names] if isinstance(value, ModuleType) else [value]
        yield from (attribute for attribute in attributes if isinstance(attribute, Dispatcher))


def _is_inlined(kernel: Dispatcher) -> bool:
    return bool(kernel.targetoptions.get("forceinline"))


def _reassociates(kernel: Dispatcher) -> bool:
    """Whether its machine code has fast mathematics, its own or that of what is inlined into it."""
    return bool(kernel.targetoptions["fastmath"]) or any(
        _reassociates(called) for called in _called_by(kernel) if _is_inlined(called)
    )


def _bits_depend_on_the_copy(kernels: list[Dispatcher]) -> set[str]:
    """Kernels with fast mathematics that others call: a process runs the copy of their code that it loads first."""
    called = {id(helper): helper for kernel in kernels for helper in _called_by(kernel) if helper is not kernel}
    return {helper.py_func.__name__ for helper in called.values() if not _is_inlined(helper) and _reassociates(helper)}


@pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="nothing is compiled")
def test_fast_mathematics_that_is_called_is_inlined() -> None:
    modules = [
        importlib.import_module(f.name) for f in pkgutil.walk_packages(boxplus.__path__, "boxplus.") if "__main__" not in f.name
    ]
    kernels = {id(value): value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    assert len(kernels) > 400
    assert _bits_depend_on_the_copy(list(kernels.values())) == set()


@_jit.kernel(fastmath=True)
def _called(x: float) -> float:
    return x * x + x


@_jit.kernel(fastmath=True, inline=True)
def _inlined(x: float) -> float:
    return x * x + x


@_jit.kernel
def _with_inlined(x: float) -> float:
    return _inlined(x) - 1.0


@_jit.kernel
def _outermost(x: float) -> float:
    return _called(x) + _with_inlined(x) + _inlined(x)


@pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="nothing is compiled")
def test_what_is_inlined_into_a_helper_counts() -> None:
    assert _bits_depend_on_the_copy([_called, _inlined, _with_inlined, _outermost]) == {"_called", "_with_inlined"}
