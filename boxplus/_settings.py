"""Settings that users give by name: what does not fit is refused like any other input, with what was meant."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Self, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from boxplus._arguments import shown
from boxplus.errors import InputError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _Refusing
else:

    class _Refusing(type(BaseModel)):
        """Makes settings from values by name; that pydantic does so inside of others stays as it is."""

        def __call__(cls, *values, **settings):
            if values:
                advice = f"write e.g. {cls.__name__}({next(iter(cls.model_fields))}=…), or {cls.__name__}(**settings)"
                raise InputError(f"settings of {cls.__name__} by name", shown(values[0]), advice)
            try:
                return super().__call__(**settings)
            except ValidationError as error:
                raise refusal(cls, error) from None


class Settings(BaseModel, metaclass=_Refusing):
    """Frozen settings that refuse unknown names and values that do not fit.

    Raises:
        InputError: a setting is unknown, missing or out of range.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except ValidationError:
            change = f"model_copy(update={{{name!r}: …}})"
            raise InputError(f"{type(self).__name__} as it was made", f"another {name}", f"make a new one, or {change}") from None

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """The same settings, with other values for some; these are looked at like any.

        Raises:
            InputError: a setting is unknown or out of range.
        """
        copied = super().model_copy(deep=deep)
        if not update:
            return copied
        return type(self)(**{**{name: getattr(copied, name) for name in copied.model_fields_set}, **update})


Place = tuple[str | int, ...]
"""The names that lead to a setting, and numbers where one of several is meant."""


def refusal(kind: type[BaseModel], error: ValidationError, named: Callable[[Place], str] | None = None) -> InputError:
    """What is wrong with settings, all of it, and what was meant.

    Args:
        named: what whoever gave them calls a setting, such as the option of a command; of no name at all, the whole.
    """
    found: dict[Place, InputError] = {}
    for one in error.errors():
        place = _place(kind, one["loc"])
        if place not in found:  # of a value that may be one thing or another, there is one for each of them
            found[place] = _refusal_of_one(kind, one, place, named or (lambda place: f"{_dotted(place)} of {kind.__name__}"))
    refusals = list(found.values())
    if len(refusals) == 1:
        return refusals[0]
    expected, got = ("; ".join(parts) for parts in zip(*((one.expected, one.got) for one in refusals), strict=True))
    return InputError(expected, got, "; ".join(dict.fromkeys(one.advice for one in refusals)))


def _refusal_of_one(kind: type[BaseModel], one: Any, place: Place, named: Callable[[Place], str]) -> InputError:
    cause = one.get("ctx", {}).get("error")
    if isinstance(cause, InputError):  # of what a check raises pydantic gathers ValueErrors only: no other of boxplus' errors
        return cause
    owner, name = _owner(kind, place), str(place[-1]) if place else "the whole"
    if one["type"] == "extra_forbidden":
        return InputError(f"a setting of {owner.__name__}", repr(name), suggestion(name, owner.model_fields, "setting"))
    field = owner.model_fields.get(name)
    meaning = f" ({field.description})" if field is not None and field.description else ""
    if one["type"] == "missing":
        return InputError(f"{named(place)}{meaning}", "nothing", f"give {_dotted(place)}=…")
    return InputError(f"a valid value for {named(place)}{meaning}", f"{shown(one['input'])} ({one['msg']})", "correct the value")


def _dotted(place: Place) -> str:
    return ".".join(map(str, place)) or "the whole"


def suggestion(word: str, known: Iterable[str], kind: str) -> str:
    """`did you mean …?` where names are near, or hold the word as one of their words; then all that there are.

    Args:
        known: names, those in sections with a dot.
        kind: what they are, in the singular.
    """
    names = list(known)
    last = {name: name.rpartition(".")[2] for name in names}
    near = [name for name in names if last[name] == word]
    near += [name for name in names if name not in near and word.lower() in last[name].lower().split("_")]
    for close in difflib.get_close_matches(word.lower(), sorted({name.lower() for name in last.values()}), n=1):
        near += [name for name in names if last[name].lower() == close and name not in near]
    hint = f"did you mean {' or '.join(near[:4])}? " if near else ""
    return f"{hint}the {kind}s are: {', '.join(names)}"


def _place(kind: type[BaseModel], where: Place) -> Place:
    """The part of pydantic's place of an error that names settings; the rest are the types that it tried."""
    model: type[BaseModel] | None = kind
    for depth, name in enumerate(where):
        if model is None:
            return where[: depth + 1] if isinstance(name, int) else where[:depth]
        model = model if isinstance(name, int) else _held(model, str(name))
    return where


def _owner(kind: type[BaseModel], place: Place) -> type[BaseModel]:
    """The model that the last name of a place belongs to: settings may hold others."""
    for name in place[:-1]:
        kind = kind if isinstance(name, int) else _held(kind, str(name)) or kind
    return kind


def _held(kind: type[BaseModel], name: str) -> type[BaseModel] | None:
    """The model that a setting holds, or several of, where it does."""
    field = kind.model_fields.get(name)
    kinds = [] if field is None else [field.annotation]
    for one in kinds:
        if isinstance(one, type) and issubclass(one, BaseModel):
            return one
        kinds += get_args(one)
    return None
