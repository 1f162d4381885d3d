"""What a public function was given: another kind of thing is refused where it enters, in the form of every other input."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from boxplus.errors import InputError

if TYPE_CHECKING:
    from boxplus._settings import Settings

SettingsT = TypeVar("SettingsT", bound="Settings")
_NONE: Mapping[str, Any] = MappingProxyType({})


def shown(value: object) -> str:
    """A value as a message has it: short, and a class by its name."""
    text = value.__name__ if isinstance(value, type) else repr(value)
    text = " ".join(text.split())
    return f"{type(value).__name__} {text[:77]}…" if len(text) > 80 else text


def require(value: object, kinds: type | tuple[type, ...], expected: str, advice: str) -> None:
    """Refuse what is of none of these kinds.

    Raises:
        InputError: with what was expected and what to do.
    """
    if not isinstance(value, kinds):
        raise InputError(expected, shown(value), advice)


def as_path(path: object, what: str) -> Path:
    """A path that was given as text or as one.

    Raises:
        InputError: something else.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"the path of {what}, as text", shown(path), "give its name")
    return Path(path)


def as_settings(kind: type[SettingsT], given: object, settings: Mapping[str, Any] = _NONE) -> SettingsT:
    """Settings that were given whole, or one by one; those of the defaults where neither was.

    Raises:
        InputError: another kind of thing, both, or settings that do not fit.
    """
    if given is None:
        return kind(**settings)
    if settings:
        raise InputError("options or single settings", "both", "put the settings into the options")
    if not isinstance(given, kind):
        raise InputError(f"a {kind.__name__}", shown(given), f"write {kind.__name__}(…), with settings by name")
    return given


def choice(value: object, choices: Iterable[str], what: str) -> None:
    """Refuse what is none of some words.

    Raises:
        InputError: naming them.
    """
    words = list(choices)
    if not (isinstance(value, str) and value in words):
        raise InputError(f"{what} {', '.join(words[:-1])} or {words[-1]}", shown(value), "choose one of them")
