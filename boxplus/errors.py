"""The errors boxplus raises, all with messages of one form: what was expected – what came – what to do."""

from __future__ import annotations

_UNSEEN = [*range(9), *range(11, 32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A)]
_AS_TEXT = {code: f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}" for code in _UNSEEN}


def printable(text: str) -> str:
    """`text` with what steers a terminal written out: names in files may hold escape sequences that hide or fake output.

    These are control characters, tabs and line ends aside, and what turns the direction of writing.

    Example:
        >>> printable("/lidar\\x1b[2K")
        '/lidar\\\\x1b[2K'
    """
    return text.translate(_AS_TEXT)


class BoxplusError(Exception):
    """Base of every error raised on purpose by boxplus."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


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
