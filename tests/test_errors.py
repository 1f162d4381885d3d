"""Errors have one form, what was expected – what came – what to do, and one family."""

from __future__ import annotations

import pytest

from boxplus.errors import AmbiguityError, BoxplusError, InputError, OutputError, RecordingError, printable
from boxplus.recordings.info import Evidence


@pytest.mark.parametrize("kind", [InputError, RecordingError, AmbiguityError])
def test_the_message_has_three_parts(kind: type[InputError]) -> None:
    error = kind("a length in metres", "-1", "give a positive number")
    assert str(error) == "expected a length in metres – got -1 – give a positive number"
    assert (error.expected, error.got, error.advice) == ("a length in metres", "-1", "give a positive number")


def test_one_family() -> None:
    for kind in (InputError, RecordingError, AmbiguityError, OutputError):
        assert issubclass(kind, BoxplusError)
    # What callers without knowledge of boxplus would catch.
    assert issubclass(InputError, ValueError)
    assert issubclass(OutputError, OSError)
    assert issubclass(AmbiguityError, RecordingError)
    assert issubclass(RecordingError, InputError)


def test_what_steers_a_terminal_is_written_out() -> None:
    """A topic or a file may be named so that a terminal hides the line, or shows another one."""
    hostile = "/lidar\x1b[2K\x1b]0;owned\x07\r\x9b31m\u202e"
    shown = "/lidar\\x1b[2K\\x1b]0;owned\\x07\\x0d\\x9b31m\\u202e"
    assert printable(hostile) == shown
    assert str(InputError("a topic", hostile, "choose one")) == f"expected a topic – got {shown} – choose one"
    assert str(OutputError(hostile)) == shown
    finding = Evidence("lidar_topic", hostile, "ok", hostile)
    assert (finding.value, finding.text) == (shown, shown)
    assert printable("Größe 3 µm\tω\n") == "Größe 3 µm\tω\n"
