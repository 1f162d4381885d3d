"""The only door to Numba: the `kernel` decorator, where compiled code is cached, and the thread pool.

Numba's own cache looks at the modification time of the file that defines a function and not at the files its callees
come from, so an edited helper leaves stale machine code behind. Here every kernel is cached under a hash of its own
file, of every boxplus file that file imports (transitively), of Numba's version and of the processor. A stale kernel is
impossible, and editing one file recompiles only what depends on it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config as numba_config
from numba.core import event as numba_event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

_PACKAGE_ROOT = Path(__file__).resolve().parent
_IMPORT = re.compile(
    r"^\s*(?:from\s+((?:boxplus|\.)[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+(boxplus[\w.]+))", re.MULTILINE
)
_Function = TypeVar("_Function", bound=Callable[..., Any])


def cache_root() -> Path:
    """Folder of compiled kernels: `$BOXPLUS_CACHE_DIR`, else the user's cache folder."""
    override = os.environ.get("BOXPLUS_CACHE_DIR")
    if override:
        return Path(override)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", str(Path.home() / "AppData" / "Local")))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")))
    return base / "boxplus"


def _module_files(dotted_name: str) -> list[Path]:
    """The file of a module; of a package also its stub, which says where the names come from that it imports on first use."""
    path = _PACKAGE_ROOT.joinpath(*dotted_name.split(".")[1:])
    candidates = (path.with_suffix(".py"), path / "__init__.py", path / "__init__.pyi")
    return [candidate for candidate in candidates if candidate.is_file()]


@functools.cache
def _imported_files(file: Path) -> frozenset[Path]:
    """The boxplus files that `file` imports directly."""
    found: set[Path] = set()
    for package, names, module in _IMPORT.findall(file.read_text(encoding="utf-8")):
        if package.startswith("."):  # in the stubs; those of a user's file lead to no file of boxplus
            if not file.is_relative_to(_PACKAGE_ROOT):
                continue
            package = ".".join(["boxplus", *file.parent.relative_to(_PACKAGE_ROOT).parts]) + package.rstrip(".")
        candidates = [module] if module else [package]
        candidates += [f"{package}.{name.split(' as ')[0].strip()}" for name in names.strip("()").split(",") if package]
        found.update(path for name in candidates for path in _module_files(name))
    return frozenset(found)


@functools.cache
def _source_key(file: Path) -> str:
    """Hash of `file`, of every boxplus file it depends on, of Numba's version and of the processor."""
    pending, seen = [file], {file}
    while pending:
        for dependency in _imported_files(pending.pop()) - seen:
            seen.add(dependency)
            pending.append(dependency)
    digest = hashlib.sha256(f"{numba.__version__} {sys.implementation.cache_tag} {_processor()}".encode())
    for path in sorted(seen):
        digest.update(str(path).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:24]


@functools.cache
def _processor() -> str:
    from llvmlite import binding

    return f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}"


class _KeyedLocator(_CacheLocator):  # type: ignore[misc]
    """Tells Numba to keep a function's machine code under the hash of everything it was compiled from."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        file = Path(py_file).resolve()
        self._line = py_func.__code__.co_firstlineno
        self._folder = cache_root() / "kernels" / _source_key(file)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _KeyedLocator | None:
        locator = cls(py_func, py_file)
        try:
            locator.ensure_cache_path()  # type: ignore[no-untyped-call]
        except OSError:
            return None
        return locator


class _KeyedCacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [_KeyedLocator]  # noqa: RUF012


class _KeyedCache(FunctionCache):  # type: ignore[misc]
    _impl_class = _KeyedCacheImpl


def kernel(
    function: _Function | None = None, *, fastmath: bool = False, inline: bool = False, borrow: bool = False, cached: bool = True
) -> Any:
    """Compile a function to native code: releases the GIL, divides like C, and is cached on disk.

    `fastmath` allows contraction and reassociation only; NaN and infinity keep their meaning. `inline` asks LLVM to
    inline the function wherever it is called (small helpers of a hot loop). `borrow` leaves the reference counts of the
    arguments alone, which are otherwise raised and lowered, atomically, in every call of a function with a loop: for
    kernels that are called once a point, or on the same arrays by several threads. Such a kernel cannot allocate. What is
    not `cached` is compiled in every process: functions of users, whose sources the cache does not know.
    """
    if function is None:
        return lambda f: kernel(f, fastmath=fastmath, inline=inline, borrow=borrow, cached=cached)
    flags = {"contract", "reassoc"} if fastmath else False
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": flags, "_nrt": not borrow}
    if inline:
        options["forceinline"] = True
    dispatcher = numba.njit(**options)(function)
    if cached and not numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        # Without a writable cache folder the kernel still works; it compiles again in the next process.
        with contextlib.suppress(RuntimeError):
            dispatcher._cache = _KeyedCache(dispatcher.py_func)  # type: ignore[no-untyped-call]
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
