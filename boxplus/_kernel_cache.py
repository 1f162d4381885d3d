"""Where compiled kernels are kept on disk, under which key, and what is believed of what lies there.

Numba's own cache looks at the modification time of the file that defines a function and not at the files its callees
come from, so an edited helper leaves stale machine code behind. Here every kernel is cached under a hash of its own
file, of every boxplus file that file imports (transitively), of Numba's version and of the processor, and under the name
of its module. A stale kernel is impossible, and editing one file recompiles only what depends on it.

What is read back is unpickled, and so can run any code. It is therefore read only from folders and files that nobody but
this user (or root) can write to, and only if it still has the checksum it was written with. Whatever fails is compiled
again, and a warning is logged, once.

Functions of users have a key for every change of a constant. Of these the ones used last are kept.
"""

from __future__ import annotations

import functools
import hashlib
import io
import logging
import os
import pickle
import re
import shutil
import stat
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from numba.core import environment
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator

from boxplus._machine_code import rebuild_function, reduce_function, start_runtime
from boxplus._source_keys import resolved, source_key

_log = logging.getLogger(__name__)
_DIGEST_BYTES = 32
_WRITABLE_FOR_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_OF_A_USER = re.compile(r"user-[0-9a-f]{24}-[0-9a-f]{8}")
_MOST_OF_USERS = 300  # functions, of 20 to 100 kB each
_IN_USE_S = 3600.0  # another process may be about to read what was used within this


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


_told: set[str] = set()


def _warn_once(topic: str, message: str, *details: object) -> None:
    """Log a warning; further ones of the same topic in this process would say the same."""
    if topic not in _told:
        _told.add(topic)
        _log.warning(message, *details)


def _distrusted(path: str | Path, status: os.stat_result) -> bool:
    """Whether others could have written this file or folder; says so once."""
    if os.name == "nt":  # the mode says nothing there, and the user's cache folder is private
        return False
    if status.st_uid not in (0, os.geteuid()):
        what = f"belongs to user {status.st_uid}, not to user {os.geteuid()}"
    elif status.st_mode & _WRITABLE_FOR_OTHERS:
        what = "can be written by other users"
    else:
        return False
    _warn_once(
        "distrusted",
        "expected compiled kernels in a place only this user can write to - %s %s, so it is not used and kernels are compiled "
        "in every process - remove it or take the permission away (chmod -R go-w), or set BOXPLUS_CACHE_DIR to a folder of "
        "your own",
        path,
        what,
    )
    return True


@functools.cache
def _is_usable(folder: Path) -> bool:
    """Whether kernels can be kept in `folder`, which is created, closed to others, where it does not exist."""
    root = cache_root()
    chain = [folder, *folder.parents]
    own = chain[: chain.index(root) + 1][::-1]
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        for path in own:
            with suppress(FileExistsError):
                path.mkdir(mode=0o700)
            if _distrusted(path, path.stat()):
                return False
    except OSError:
        return False
    return os.access(folder, os.W_OK)


class _KeyedLocator(_CacheLocator):  # type: ignore[misc]
    """Tells Numba to keep a function's machine code under the hash of everything it was compiled from."""

    key: str | None = None
    """Of a function that a user wrote; that of one of ours comes from its file."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        # Machine code imports, by name, the module its function was defined in: a file that was run as a script and is
        # imported now, or imported under another name, is another one.
        module = hashlib.sha256(py_func.__module__.encode()).hexdigest()[:8]
        # What a user wrote is known by what it does, wherever it stands.
        self._line = 0 if self.key else py_func.__code__.co_firstlineno
        self._folder = cache_root() / "kernels" / f"{self.key or source_key(resolved(py_file))}-{module}"

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _KeyedLocator | None:
        locator = cls(py_func, py_file)
        return locator if _is_usable(locator._folder) else None


def _rebuilt_environment(module: str, constants: list[Any], name: str) -> environment.Environment:
    """As Numba's, but for modules of Numba that nothing has needed yet: compiled code asks for constants, not for their globals.

    These are most of what its compiler imports, a quarter of a second.
    """
    if module.partition(".")[0] != "numba" or module in sys.modules:
        return environment._rebuild_env(module, constants, name)  # type: ignore[no-untyped-call, no-any-return]
    found: environment.Environment | None = environment.lookup_environment(name)  # type: ignore[no-untyped-call]
    if found is None:
        found = environment.Environment({"__name__": module})
        found.consts[:] = constants
        found.env_name = name
        environment.Environment._memo[name] = found
    return found


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numba.core.environment", "_rebuild_env"):
            return _rebuilt_environment
        return super().find_class(module, name)


def _unpickle(path: str, content: bytes) -> Any:
    """What was saved, or None where it cannot be restored here: it is compiled again."""
    try:
        return _Unpickler(io.BytesIO(content)).load()
    except Exception as error:  # noqa: BLE001 - whatever its imports raise: a cache must never stop a program
        _warn_once("unrestorable", "%s cannot be restored (%r): its kernel is compiled again", path, error)
        return None


def _read(path: str) -> bytes | None:
    """What was written to `path`, if all of it is there and nobody else can have written it."""
    try:
        with open(path, "rb") as file:
            if _distrusted(path, os.fstat(file.fileno())):
                return None
            content = file.read()
    except OSError:
        return None
    digest, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.sha256(payload).digest() == digest:
        return payload
    _warn_once("damaged", "%s is damaged (cut or changed): it is discarded and its kernel compiled again", path)
    with suppress(OSError):
        os.unlink(path)
    return None


def _write(path: str, payload: bytes) -> None:
    with _replacing(path) as file:
        file.write(hashlib.sha256(payload).digest())
        file.write(payload)


class _VerifiedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """The index and the machine code of one function, each behind a checksum that is looked at before anything is unpickled."""

    def _load_index(self) -> dict[Any, str]:
        content = _read(self._index_path)
        if content is None:
            return {}
        stamp, overloads = _unpickle(self._index_path, content) or (None, {})
        return overloads if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        _write(self._index_path, self._dump((self._source_stamp, overloads)))  # type: ignore[no-untyped-call]

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)  # type: ignore[no-untyped-call]
        content = _read(path)
        return None if content is None else _unpickle(path, content)

    def _save_data(self, name: str, data: Any) -> None:
        _write(self._data_path(name), self._dump(data))  # type: ignore[no-untyped-call]


@contextmanager
def _replacing(path: str) -> Iterator[BinaryIO]:
    """A file of this user alone that takes the place of `path` when it is whole; several processes may do so at once."""
    temporary = f"{path}.tmp.{uuid.uuid4().hex[:16]}"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        with os.fdopen(os.open(temporary, flags, 0o600), "wb") as file:
            yield file
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise


def _note_use(folder: Path) -> None:
    """A user's function is used: the date of its folder says when, and those that were not used for long make room for it."""
    with suppress(OSError):
        os.utime(folder)
    _forget_old(folder.parent)


@functools.cache
def _forget_old(kernels: Path) -> None:
    """Remove what users compiled, the longest unused first, until no more is left than is kept; once in a process."""
    used: list[tuple[float, Path]] = []
    with suppress(OSError):
        for entry in kernels.iterdir():
            if _OF_A_USER.fullmatch(entry.name) and not entry.is_symlink():
                used.append((entry.stat().st_mtime, entry))
    used.sort(reverse=True)
    for when, folder in used[_MOST_OF_USERS:]:
        if time.time() - when > _IN_USE_S:
            shutil.rmtree(folder, ignore_errors=True)


class _KeyedCacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = [_KeyedLocator]  # noqa: RUF012

    def reduce(self, compiled: Any) -> tuple[Any, ...]:
        return reduce_function(compiled)

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> Any:
        return rebuild_function(target_context, payload)

    def check_cachable(self, compiled: Any) -> bool:
        """Not what holds an address of this process, such as that of a large array among a user's globals."""
        return not compiled.lifted and not compiled.library.has_dynamic_globals


class KernelCache(FunctionCache):  # type: ignore[misc]
    """What a dispatcher loads its machine code from, and saves it to; does neither where there is no folder that can be used.

    Args:
        key: of a function that a user wrote, a hash of all that decides what it does; a function of ours is kept under the
            hash of its file and of what that imports.
    """

    _impl_class: type[Any] = _KeyedCacheImpl

    def __init__(self, py_func: Callable[..., Any], key: str | None = None) -> None:
        self._py_func, self._key, self._found = py_func, key, False
        if key is None:
            # Now, before somebody edits the file; the folder is asked for by the few functions that are called.
            source_key(resolved(py_func.__code__.co_filename))

    def _find(self) -> None:
        self._found = True
        if self._key is not None:
            locator_class = type("_Locator", (_KeyedLocator,), {"key": self._key})
            self._impl_class = type("_Impl", (_KeyedCacheImpl,), {"_locator_classes": [locator_class]})
        try:
            super().__init__(self._py_func)  # type: ignore[no-untyped-call]
        except RuntimeError:  # no folder that is safe to use: it compiles again in the next process
            self.disable()  # type: ignore[no-untyped-call]
            return
        locator = self._impl.locator
        if self._key is not None:
            _note_use(Path(locator.get_cache_path()))
        self._cache_file = _VerifiedFiles(  # type: ignore[no-untyped-call]
            cache_path=locator.get_cache_path(), filename_base=self._impl.filename_base, source_stamp=locator.get_source_stamp()
        )

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """As Numba's, but without its hash of closures, which is another one in every process, where our key has their values."""
        if self._key is None:
            return super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        return sig, codegen.magic_tuple()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As Numba's, but without importing all that its compiler knows, a quarter of a second, where nothing is compiled.

        Machine code needs the symbols of Numba's runtime. Those of hashing, which come with the compiler, only functions of
        users may need.
        """
        start_runtime(target_context, _load_runtime, _save_runtime)
        if not self._found:
            self._find()
        if self._key is not None:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        with self._guard_against_spurious_io_errors():  # type: ignore[no-untyped-call]
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def save_overload(self, sig: Any, data: Any) -> None:
        """As Numba's, of what was asked for with `load_overload` before; not having room for it is no error."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:  # a full disk, a folder removed meanwhile: the kernel is compiled all the same
            _warn_once("unwritable", "compiled kernels cannot be kept in %s: %s", self._cache_path, error)


def _runtime_file(target_context: Any) -> Path:
    target = hashlib.sha256(repr(target_context.codegen().magic_tuple()).encode()).hexdigest()[:8]
    return cache_root() / "kernels" / f"{source_key(resolved(__file__))}-runtime" / f"{target}.runtime"


def _load_runtime(target_context: Any) -> Any:
    file = _runtime_file(target_context)
    content = _read(str(file)) if _is_usable(file.parent) else None
    return None if content is None else _unpickle(str(file), content)


def _save_runtime(target_context: Any, runtime: Any) -> None:
    file = _runtime_file(target_context)
    with suppress(OSError):
        if _is_usable(file.parent):
            _write(str(file), pickle.dumps(runtime))
