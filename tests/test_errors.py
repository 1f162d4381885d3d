"""Errors have one form, what was expected – what came – what to do, and one family."""

from __future__ import annotations

import pytest

from boxplus.errors import AmbiguityError, BoxplusError, InputError, OutputError, RecordingError


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
