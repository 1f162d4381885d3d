"""What the library says with the names of its arguments, said with the options of the command that passes them on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from boxplus.errors import InputError

if TYPE_CHECKING:
    from boxplus.evaluation.evaluation import Evaluation

EVALUATION: Mapping[str, str] = {
    r"\bmax_difference_s\b": "--max-diff",
    r"\bmax_gap_s\b": "--max-gap",
    r"\bmin_matches\b": "--min-matches",
    r"\boffset_s=": "--offset ",
    r"\boffset_s\b": "--offset",
    r"\balign_by_first\b": "--n-to-align",
    r'\bmethod="interpolate"': "--interpolate",
    r'\balignment="(\w+)"': r"--align \1",
    r'\bDelta\(value, "m"\)': "--rpe-distance",
    r'\bDelta\(value, "s"\)': "--rpe-time",
    r'\bDelta\(value, "deg"\)': "--rpe-turn",
    r'\bDelta\(value, "frames"\)': "--rpe-frames",
    r'\bpairs="consecutive"': "--rpe-pairs consecutive",
}
"""Patterns of what `evaluate` takes, and the options of `boxplus eval`."""

POSE_GRAPH: Mapping[str, str] = {r"\bignore_unknown\b": "--ignore-unknown"}
"""The same of `read_pose_graph` and `boxplus pgo`."""


def in_options(text: str, options: Mapping[str, str]) -> str:
    """The text with options in the place of arguments.

    Args:
        options: patterns of arguments, and what to put there; they are tried in this order.

    Example:
        >>> in_options("raise max_difference_s", EVALUATION)
        'raise --max-diff'
    """
    for pattern, option in options.items():
        text = re.sub(rf"(?<![/\\.]){pattern}(?!\.\w)", option, text)  # no names of files
    return text


@contextmanager
def saying(options: Mapping[str, str]) -> Iterator[None]:
    """What is refused in this block, or by the command that this decorates, names options.

    Raises:
        InputError: that which the block raised, in these words.
    """
    try:
        yield
    except InputError as error:
        parts = [in_options(part, options) for part in (error.expected, error.got, error.advice)]
        if parts == [error.expected, error.got, error.advice]:
            raise
        raise type(error)(*parts) from error


def evaluation_in_options(evaluation: Evaluation) -> Evaluation:
    """The same, its warnings with the options of `boxplus eval`."""
    return replace(evaluation, warnings=tuple(in_options(warning, EVALUATION) for warning in evaluation.warnings))
