"""Functions written by users, before they are compiled: taken down as they are now, and a key of all that decides what they do.

A user's function reads constants from around it, may have default arguments and a closure, and calls other functions of the
user's. `snapshot` copies it together with what it refers to, so that what is compiled later, and piece by piece, is what was
there at one moment. `code_key` hashes a snapshot: bytecode, which is what Numba compiles (the text of a file may have been
edited since it was imported), constants, defaults, cells, the globals and attributes of modules that are named in it, the
functions called, with all of the same, and the versions of what compiles them. Two functions of one key behave alike, so that
machine code can be kept on disk under it. Where a function refers to something that cannot be told apart by its value, there
is no key, and what is compiled lasts as long as the process.
"""

from __future__ import annotations

import dis
import hashlib
import itertools
import operator
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import imputils, types
from numba.core.dispatcher import Dispatcher
from numba.core.typing import templates

from boxplus._jit import kernel
from boxplus._source_keys import processor, resolved, source_key

# Their functions are known by name and version.
_KNOWN = ("builtins", "math", "cmath", "operator", "numpy", "numba")
_READ_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME")
_SCALARS = (bool, int, str, bytes, type(None), type(Ellipsis))


@dataclass(frozen=True, eq=False)
class UserCode:
    """A function of a user's as it is now. Two are equal where what they compile to cannot differ, one without a key to itself.

    Attributes:
        function: as it was given.
        key: a hash of all that decides what it does; None where that cannot be told.
    """

    function: Callable[..., Any]
    key: str | None
    _snapshots: dict[bool, FunctionType]

    @classmethod
    def of(cls, function: Callable[..., Any]) -> UserCode:
        """As soon as the function is given, so that what changes later around it is another one's."""
        snapshots = {checked: snapshot(function, checked=checked) for checked in (False, True)}
        return cls(function, code_key(snapshots[True]), snapshots)

    @property
    def name(self) -> str:
        return str(self.function.__name__)

    def snapshot(self, *, checked: bool) -> FunctionType:
        return self._snapshots[checked]

    def cached(self, *variant: str) -> str | bool:
        """What `kernel` takes as `cached` for this function, compiled in one way or another."""
        return cached_name(__file__, "".join(variant), self)

    def __eq__(self, other: object) -> bool:
        if self.key is None or not isinstance(other, UserCode):
            return self is other
        return (self.function, self.key) == (other.function, other.key)

    def __hash__(self) -> int:
        return hash((self.function, self.key))


def cached_name(file: str, text: str, *codes: UserCode | None) -> str | bool:
    """What `kernel` takes as `cached` for code of this text that a file makes around functions; False where one has no key."""
    keys = [code.key for code in codes if code is not None]
    if None in keys:
        return False
    return "user-" + hashlib.sha256("\n".join([*map(str, keys), _file_key(file), text]).encode()).hexdigest()[:24]


Translation = Callable[[Any, frozenset[str]], Any]


def snapshot(function: Callable[..., Any], *, checked: bool, translated: Translation | None = None) -> FunctionType:
    """The function, a plain or a compiled one, with copies of all that it refers to by name, arrays included.

    Functions that a user compiled are compiled again for it, also those that it reaches through a module: one that was compiled
    before may have read constants that changed since. With `checked` they, too, look at the bounds of arrays. Kernels of
    boxplus and functions that call themselves stay.

    Args:
        translated: gives what takes the place of a value that is referred to, out of it and the names of attributes that are
            read; kernels of boxplus are then compiled again, too.
    """
    return _Snapshot(checked, translated).of(getattr(function, "py_func", function))


class _Snapshot:
    def __init__(self, checked: bool, translated: Translation | None) -> None:
        self._checked = checked
        self._translated = translated
        self._outer: list[Any] = []
        self._done: dict[int, Any] = {}
        self._originals: list[Any] = []  # kept, so that no id in `_done` is given away again

    def of(self, function: Any) -> FunctionType:
        self._outer.append(function)
        attributes = _names(function.__code__)
        scope = {
            name: self._replaced(function.__globals__[name], attributes)
            for name in _global_names(function.__code__)
            if name in function.__globals__
        }
        for name in ("__builtins__", "__name__"):
            scope[name] = function.__globals__.get(name, "boxplus._user_code")
        cells = tuple(self._cell(cell, attributes) for cell in function.__closure__ or ())
        copy = FunctionType(function.__code__, scope, function.__name__, self._copied(function.__defaults__), cells)
        copy.__kwdefaults__ = {name: self._copied(value) for name, value in (function.__kwdefaults__ or {}).items()} or None
        copy.__qualname__ = function.__qualname__
        self._outer.pop()
        return copy

    def _cell(self, cell: CellType, attributes: frozenset[str]) -> CellType:
        try:
            return CellType(self._replaced(cell.cell_contents, attributes))
        except ValueError:  # it is still empty
            return cell

    def _replaced(self, value: Any, attributes: frozenset[str]) -> Any:
        if isinstance(value, Dispatcher):
            own = is_kernel(value)
            if value.py_func in self._outer or (own and self._translated is None):
                return value
            if id(value) not in self._done:
                self._originals.append(value)
                inline = not own or bool(value.targetoptions.get("forceinline"))
                self._done[id(value)] = kernel(
                    self.of(value.py_func),
                    inline=inline,
                    cached=False,
                    checked=self._checked,
                    internal=self._translated is not None,
                )
            return self._done[id(value)]
        if isinstance(value, ModuleType) and not _is_known(value.__name__):
            if _is_own(value.__name__) and self._translated is None:
                return value
            copy = copied_module(value)
            for name in attributes & vars(value).keys():
                setattr(copy, name, self._replaced(vars(value)[name], attributes))
            return copy
        return self._copied(value) if self._translated is None else self._translated(value, attributes)

    def _copied(self, value: Any) -> Any:
        """Arrays, also within tuples and lists, as they are now: whoever has the originals may write to them."""
        if self._translated is not None:  # of what was copied before
            return value
        if isinstance(value, np.ndarray | np.void):
            return value.copy("K") if isinstance(value, np.ndarray) else value.copy()
        if type(value) in (tuple, list):
            return type(value)(map(self._copied, value))
        if isinstance(value, tuple) and hasattr(value, "_make"):
            return value._make(map(self._copied, value))
        return value


_copies = itertools.count()


def copied_module(module: ModuleType) -> ModuleType:
    """An empty module in place of one, under another name: what Numba does with NumPy by name concerns no copy of it."""
    return ModuleType(f"{module.__name__}, copy {next(_copies)}")


def code_key(*parts: Any) -> str | None:
    """A hash of snapshots, and of strings and numbers beside them; None where one refers to what has no value of its own."""
    try:
        description = _Description()
        for implementation in _foreign_overloads():
            description.add(implementation)
        for part in parts:
            description.add(part)
    except _Undescribed:
        return None
    return description.digest.hexdigest()[:24]


class _Undescribed(Exception):
    """Something whose value says nothing of what it does."""


class _Description:
    """Feeds values to a hash, each with its type and length, so that no two sequences of values look alike."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []
        versions = (sys.version, numba.__version__, np.__version__, llvmlite.__version__, processor())
        self._write("versions", *versions, _file_key(__file__))

    def _write(self, *texts: object) -> None:
        for text in texts:
            data = text if isinstance(text, bytes) else str(text).encode()
            self.digest.update(len(data).to_bytes(8, "little"))
            self.digest.update(data)

    def add(self, value: Any) -> None:
        kind = type(value)
        if kind in _SCALARS:
            self._write(kind.__name__, repr(value))
        elif kind in (float, complex):
            self._write(kind.__name__, np.array(value).tobytes())  # tells −0 from 0
        elif isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            array = np.asarray(value)
            layout = (kind.__name__, repr(array.dtype), array.shape, array.flags.c_contiguous, array.flags.f_contiguous)
            self._write(*layout, array.flags.writeable, array.tobytes())
        elif kind in (tuple, list):
            self._write(kind.__name__, len(value))
            for item in value:
                self.add(item)
        elif kind is frozenset:
            self._write("frozenset", *sorted(map(repr, value)))
        else:
            self._add_named(value)

    def _add_named(self, value: Any) -> None:
        if id(value) in self._seen:
            self._write("as before", self._seen[id(value)])
            return
        self._seen[id(value)] = len(self._seen)
        self._kept.append(value)
        if isinstance(value, CodeType):
            self._add_code(value)
        elif isinstance(value, ModuleType):
            self._add_module(value)
        elif isinstance(value, types.Type) and type(value).__module__.startswith("numba."):
            self._write("type", repr(value))
        elif is_kernel(value):
            self._write("kernel", value.py_func.__qualname__, _file_key(value.py_func.__code__.co_filename))
        elif isinstance(value, Dispatcher):
            if value.overloads:  # compiled before it was looked at: with what constants, nobody knows
                raise _Undescribed
            self._write("compiled", sorted((name, repr(option)) for name, option in value.targetoptions.items()))
            self._write(value.locals)
            self.add(value.py_func)
        elif _is_known_by_name(value):
            self._write("known", value.__module__ if hasattr(value, "__module__") else "numpy", _qualified_name(value))
        elif isinstance(value, FunctionType):
            self._add_function(value)
        else:
            raise _Undescribed

    def _add_function(self, function: FunctionType) -> None:
        self._write("function", function.__module__, function.__qualname__)
        self._add_code(function.__code__)
        self.add(function.__defaults__)
        self.add(sorted((function.__kwdefaults__ or {}).items()))
        attributes = _names(function.__code__)
        for name in sorted(_global_names(function.__code__)):
            self._write("global", name)
            if name in function.__globals__:
                self._add_reference(function.__globals__[name], attributes)
        for cell in function.__closure__ or ():
            try:
                contents = cell.cell_contents
            except ValueError:
                raise _Undescribed from None
            self._add_reference(contents, attributes)

    def _add_reference(self, value: Any, attributes: frozenset[str]) -> None:
        if isinstance(value, ModuleType) and not _is_known(value.__name__) and not _is_own(value.__name__):
            if "getattr" in attributes:
                raise _Undescribed
            # Which attributes a function reads depends on the function: the module is looked at again for each.
            self._write("module")
            for name in sorted(attributes & vars(value).keys()):
                self._write("attribute", name)
                self._add_reference(vars(value)[name], attributes)
        else:
            self.add(value)

    def _add_module(self, module: ModuleType) -> None:
        if _is_own(module.__name__) and module.__file__:
            self._write("module", module.__name__, _file_key(module.__file__))
        elif _is_known(module.__name__):
            self._write("module", module.__name__)
        else:
            raise _Undescribed

    def _add_code(self, code: CodeType) -> None:
        """All that a compiler sees of a function, which leaves out where it stands and how it is laid out."""
        self._write("code", code.co_code, getattr(code, "co_exceptiontable", b""), code.co_flags)
        self._write(code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
        self._write(code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, len(code.co_consts))
        for constant in code.co_consts:
            self.add(constant)


def is_kernel(value: Any) -> bool:
    """Whether this is a kernel that a file of boxplus defines by name, which the hash of its file tells from others."""
    if not isinstance(value, Dispatcher):
        return False
    module = sys.modules.get(value.py_func.__module__)
    return _is_own(value.py_func.__module__) and getattr(module, value.py_func.__qualname__, None) is value


def _file_key(file: str) -> str:
    return source_key(resolved(file))


def _is_own(module: str | None) -> bool:
    return str(module).partition(".")[0] == "boxplus"


def _is_known(module: str) -> bool:
    return module.partition(".")[0] in _KNOWN


def _qualified_name(value: Any) -> str:
    return str(getattr(value, "__qualname__", getattr(value, "__name__", "")))


def _is_known_by_name(value: Any) -> bool:
    """Whether this is what its name says in Python, NumPy or Numba, whose versions are known."""
    if isinstance(value, np.ufunc):
        return getattr(np, value.__name__, None) is value
    if not isinstance(value, FunctionType | BuiltinFunctionType | type) and not hasattr(value, "__wrapped__"):
        return False
    module = getattr(value, "__module__", None) or ""
    if not _is_known(module) or module not in sys.modules:
        return False
    try:
        return operator.attrgetter(_qualified_name(value))(sys.modules[module]) is value
    except AttributeError:
        return False


def _global_names(code: CodeType) -> frozenset[str]:
    """Names that the code, or a function in it, reads as globals."""
    return frozenset(
        str(instruction.argval)
        for part in _nested(code)
        for instruction in dis.get_instructions(part)
        if instruction.opname in _READ_GLOBAL
    )


def _names(code: CodeType) -> frozenset[str]:
    """All names in the code: those of attributes are among them."""
    return frozenset(name for part in _nested(code) for name in part.co_names)


def _nested(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _nested(constant)


def _foreign_overloads() -> list[FunctionType]:
    """Implementations that others than Numba and boxplus registered for functions in compiled code: any function may call them.

    Raises:
        _Undescribed: one was registered in the form of instructions.
    """
    found = []
    for template in [*templates.builtin_registry.functions, *templates.builtin_registry.attributes]:
        implementation = getattr(template, "_overload_func", None)
        if isinstance(implementation, FunctionType) and not _is_trusted(implementation.__module__):
            found.append(implementation)
    registry = imputils.builtin_registry
    for lowered, *_ in (*registry.functions, *registry.getattrs, *registry.casts, *registry.constants):
        if not _is_trusted(lowered.__module__):
            raise _Undescribed
    return found


def _is_trusted(module: str | None) -> bool:
    """Whether this is a module of Numba or boxplus, or none at all, as of what Numba generates."""
    return module is None or _is_known(module) or _is_own(module)
