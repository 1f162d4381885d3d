"""Options of a command from the fields of a model, such as those that decide how a recording is read."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer
from pydantic import BaseModel, ValidationError

from boxplus._settings import Place, refusal
from boxplus.recordings.options import OtherLidar, RecordingOptions

_TEXTS: dict[Any, Any] = {tuple[str, ...] | None: list[str] | None, tuple[OtherLidar, ...] | None: list[str] | None}
"""What a command line can take, for what it cannot."""

_PANEL = "Reading the recording (found from the data unless given)"


def takes_recording_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of a recording with a LiDAR; see `takes_options`."""
    return takes_options(RecordingOptions)(command)


def takes_options(model: type[BaseModel]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command one option for every field of a model, and pass them to it as `options`.

    `--point-time-unit` sets `point_time_unit`; the unit at the end of a name (`start_s`) is left out. A tuple of texts is an
    option that may be repeated.

    Raises, when the command is called:
        InputError: a value outside its range.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True)
        fields = model.model_fields

        @functools.wraps(command)
        def with_options(**words: Any) -> None:
            given = {name: words.pop(name) for name in fields}
            given = {name: None if value == [] else value for name, value in given.items()}
            try:
                options = model.model_validate(given)
            except ValidationError as error:
                raise refusal(model, error, _option) from None
            command(**words, options=options)

        added = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=Annotated[
                    _TEXTS.get(field.annotation, field.annotation),
                    typer.Option(_flag(name), help=_sentence(field.description or ""), rich_help_panel=_PANEL),
                ],
            )
            for name, field in fields.items()
        ]
        kept = [parameter for name, parameter in own.parameters.items() if name != "options"]
        with_options.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        return with_options

    return decorate


def _option(place: Place) -> str:
    return _flag(str(place[0])) if place else "these options together"


def _flag(name: str) -> str:
    return "--" + name.removesuffix("_s").removesuffix("_hz").removesuffix("_m").replace("_", "-")


def _sentence(description: str) -> str:
    return f"{description[0].upper()}{description[1:]}."
