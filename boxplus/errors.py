"""The errors boxplus raises, all with messages of one form: what was expected – what came – what to do."""

from __future__ import annotations


class BoxplusError(Exception):
    """Base of every error raised on purpose by boxplus."""


class InputError(BoxplusError, ValueError):
    """An argument, a configuration value or a file does not have the form that was asked for.

    The message reads `expected … – got … – do …`.
    """

    def __init__(self, expected: str, got: str, advice: str) -> None:
        super().__init__(f"expected {expected} – got {got} – {advice}")
        self.expected = expected
        self.got = got
        self.advice = advice


class RecordingError(InputError):
    """A recording cannot be read: missing topic, unknown layout, corrupt or truncated file."""


class AmbiguityError(RecordingError):
    """The data fits two readings (of a unit, a time base, a topic); the message says which option decides."""


class NotFiniteError(InputError):
    """A residual or a Jacobian is NaN or infinite; the message names the group, the residual and its variables."""


class SingularProblemError(BoxplusError):
    """A least-squares problem does not determine its variables; the message says which, along which directions, and why."""


class OutputError(BoxplusError, OSError):
    """A result could not be written: full disk, unwritable folder."""
