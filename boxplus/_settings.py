"""Settings that users give by name: what does not fit is refused like any other input, with what was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError

from boxplus.errors import BoxplusError, InputError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _Refusing
else:

    class _Refusing(type(BaseModel)):
        """Makes settings from values by name; that pydantic does so inside of others stays as it is."""

        def __call__(cls, *values, **settings):
            if values:
                advice = f"write e.g. {cls.__name__}({next(iter(cls.model_fields))}=…), or {cls.__name__}(**settings)"
                raise InputError(f"settings of {cls.__name__} by name", _short(values[0]), advice)
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


def refusal(kind: type[BaseModel], error: ValidationError) -> BoxplusError:
    """What is wrong with settings, and what was meant."""
    first = error.errors()[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, BoxplusError):
        return cause
    place = [str(part) for part in first["loc"]]
    where, owner = ".".join(place) or "the whole", _owner(kind, place)
    if first["type"] == "extra_forbidden":
        name = place[-1]
        return InputError(f"a setting of {owner.__name__}", repr(name), suggestion(name, owner.model_fields, "setting"))
    field = owner.model_fields.get(place[-1]) if place else None
    if first["type"] == "missing":
        return InputError(f"{where} of {kind.__name__}{_described(field)}", "nothing", f"give {where}=…")
    got = f"{_short(first['input'])} ({first['msg']})"
    return InputError(f"a valid value for {where} of {kind.__name__}{_described(field)}", got, "correct the value")


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


def _owner(kind: type[BaseModel], place: list[str]) -> type[BaseModel]:
    """The model that the last name of a place belongs to: settings may hold others."""
    for name in place[:-1]:
        field = kind.model_fields.get(name)
        if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            break
        kind = field.annotation
    return kind


def _described(field: Any) -> str:
    return f" ({field.description})" if field is not None and field.description else ""


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 120 else f"{text[:117]}…"
