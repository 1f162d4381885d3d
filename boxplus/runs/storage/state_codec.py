"""Objects of boxplus as a file of arrays and JSON, and back: what a checkpoint is made of.

Reading one runs no code of the file, as unpickling would: only classes of boxplus are made, without calling anything of them.
An object is what the code made of it that wrote the file: other code may expect other attributes, and nothing would say so before
it asks for one. A file is therefore read by the code alone that wrote it.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import threading
from array import array
from collections import Counter, deque
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

import boxplus
from boxplus.errors import InputError
from boxplus.formats.output import atomic_file

_PLAIN = (bool, int, float, str, type(None))
_LOCK = type(threading.Lock())
_WITHOUT_STATES = ("cli", "report", "simulation")  # nothing that estimates imports these rooms


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Write `state` in one step: numbers, text, containers, arrays, and objects of boxplus made of these.

    What runs on another thread becomes None: whoever began it has to begin it again. So does what an object makes anew from the
    rest of itself, the attributes that its class names in `MADE_ANEW`. A lock is read as a new one that is open.

    Raises:
        OutputError: the disk is full; the file before stays.
        TypeError: something else is in it.
    """
    encoder = _Encoder()
    tree = encoder.encode(state)
    text, program = (np.frombuffer(words.encode(), np.uint8) for words in (json.dumps(tree), _PROGRAM))
    with atomic_file(path) as file:
        arrays: dict[str, Any] = {f"a{k}": values for k, values in enumerate(encoder.arrays)}
        np.savez(file, tree=text, program=program, **arrays)


def read_state(path: Path) -> dict[str, Any]:
    """What `write_state` wrote.

    Raises:
        InputError: missing, damaged, or written by another version of boxplus.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            program = _program_of(stored)
            if program != _PROGRAM:
                raise InputError(
                    f"the checkpoint of a run, of this version of boxplus ({_PROGRAM})",
                    f"one of {program} ({path})",
                    "start the run anew, or go on with the boxplus that it began with",
                )
            tree = json.loads(stored["tree"].tobytes())
            found = _Decoder([stored[f"a{k}"] for k in range(len(stored.files) - 2)]).decode(tree)
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            "the checkpoint of a run, of this version of boxplus",
            f"a damaged one ({path}: {type(error).__name__})",  # NumPy's own words advise to run what is in it
            "start the run anew",
        ) from error
    if not isinstance(found, dict):
        raise InputError("the checkpoint of a run", f"something else in {path}", "start the run anew")
    return found


def is_of_this_program(path: Path) -> bool:
    """Whether a checkpoint was written by the code that runs now, so that it can be gone on from; a damaged one was by nobody."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return _program_of(stored) == _PROGRAM
    except Exception:  # noqa: BLE001 - NumPy and zipfile find many ways to say that a file is damaged
        return False


def _program_of(stored: Any) -> str:
    return str(stored["program"].tobytes().decode()) if "program" in stored.files else "an earlier boxplus"


def program_of_files(package: Path) -> str:
    """The version, and a digest of the code that can have a part in a state, as it lies in this folder."""
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        inside = source.relative_to(package)
        if inside.parts[0] not in _WITHOUT_STATES:
            digest.update(inside.as_posix().encode() + b"\0" + source.read_bytes())
    return f"boxplus {boxplus.__version__}, code {digest.hexdigest()[:12]}"


# Before a run begins, not when it first writes: an upgrade in between would give old states the name of the new code.
_PROGRAM = program_of_files(Path(boxplus.__file__).parent)


class _Encoder:
    def __init__(self) -> None:
        self.arrays: list[NDArray[Any]] = []
        self._known: dict[int, int] = {}
        self._alive: list[object] = []  # an id is only its object's while that lives

    def encode(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, _PLAIN):
            return value
        if isinstance(value, Executor | Future):
            return None
        if isinstance(value, np.ndarray):
            self.arrays.append(value)
            return {"array": len(self.arrays) - 1}
        if isinstance(value, list):
            return [self.encode(entry) for entry in value]
        if type(value) in (tuple, set):  # one with names of its own would come back without them
            return {type(value).__name__: [self.encode(entry) for entry in value]}
        if isinstance(value, deque):
            return {"deque": [self.encode(entry) for entry in value], "maxlen": value.maxlen}
        if isinstance(value, slice):
            return {"slice": [self.encode(entry) for entry in (value.start, value.stop, value.step)]}
        if isinstance(value, _LOCK):
            return {"lock": None}
        if isinstance(value, array):
            return {"numbers": value.tolist(), "typecode": value.typecode}
        if isinstance(value, dict):
            kind = "counter" if isinstance(value, Counter) else "dict"
            return {kind: [[self.encode(key), self.encode(entry)] for key, entry in value.items()]}
        return self._encode_object(value)

    def _encode_object(self, value: Any) -> Any:
        kind = type(value)
        if not kind.__module__.startswith("boxplus.") or isinstance(value, tuple):
            raise TypeError(f"a checkpoint holds no {kind.__module__}.{kind.__qualname__}")
        if id(value) in self._known:
            return {"same": self._known[id(value)]}
        self._known[id(value)] = len(self._known)
        self._alive.append(value)
        name = f"{kind.__module__}:{kind.__qualname__}"
        if isinstance(value, BaseModel):
            return {"model": name, "json": value.model_dump_json()}
        slots = [slot for base in kind.__mro__ for slot in getattr(base, "__slots__", ()) if hasattr(value, slot)]
        names = [*getattr(value, "__dict__", {}), *slots]
        anew = getattr(kind, "MADE_ANEW", ())
        kept = {attribute: None if attribute in anew else self.encode(getattr(value, attribute)) for attribute in names}
        return {"object": name, "attributes": kept}


class _Decoder:
    def __init__(self, arrays: list[NDArray[Any]]) -> None:
        self._arrays = arrays
        self._objects: list[Any] = []

    def decode(self, tree: Any) -> Any:
        if isinstance(tree, _PLAIN):
            return tree
        if isinstance(tree, list):
            return [self.decode(entry) for entry in tree]
        kind, content = next(iter(tree.items()))
        if kind == "array":
            return self._arrays[content]
        if kind == "same":
            return self._objects[content]
        if kind in ("model", "object"):
            return self._decode_object(content, tree)
        if kind == "lock":
            return threading.Lock()
        if kind == "slice":
            return slice(*map(self.decode, content))
        if kind == "numbers":
            return array(tree["typecode"], content)
        if kind in ("dict", "counter"):
            pairs = {self.decode(key): self.decode(entry) for key, entry in content}
            return Counter(pairs) if kind == "counter" else pairs
        entries = [self.decode(entry) for entry in content]
        return deque(entries, tree["maxlen"]) if kind == "deque" else {"tuple": tuple, "set": set}[kind](entries)

    def _decode_object(self, name: str, tree: Any) -> Any:
        module, _, qualified = name.partition(":")
        if not module.startswith("boxplus.") or not qualified.isidentifier():
            raise TypeError(f"{name} is no class of boxplus")
        kind = getattr(importlib.import_module(module), qualified)
        if not isinstance(kind, type) or kind.__module__ != module:
            raise TypeError(f"{name} is no class of boxplus")
        if issubclass(kind, BaseModel):
            self._objects.append(kind.model_validate_json(tree["json"]))
            return self._objects[-1]
        made = object.__new__(kind)
        self._objects.append(made)
        for attribute, value in tree["attributes"].items():
            object.__setattr__(made, attribute, self.decode(value))
        return made
