"""Where commands print: lines of a terminal are wrapped at its width, lines in a pipe or a file are not."""

from __future__ import annotations

import re
import sys
from typing import TextIO

from rich.console import Console

_UNWRAPPED = 100_000
"""Columns of what is no terminal."""
_PADDING = re.compile(r"[ \t]+(?=\n)|(?<=─{78})─+")


class _Trimmed:
    """A stream without what fills tables up to their width: blanks at the ends of lines, and rules longer than a line."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self.encoding = stream, stream.encoding

    def isatty(self) -> bool:
        """Nobody looks at it as it is written."""
        return False

    def write(self, text: str) -> int:
        """Write the text that is to be seen."""
        self._stream.write(_PADDING.sub("", text))
        return len(text)

    def flush(self) -> None:
        """That of the stream."""
        self._stream.flush()


def make_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """On the standard output or the standard error; a quiet one prints nothing."""
    console = Console(highlight=False, stderr=stderr, quiet=quiet)
    if console.is_terminal:
        return console
    stream = sys.stderr if stderr else sys.stdout
    return Console(highlight=False, file=_Trimmed(stream), quiet=quiet, width=_UNWRAPPED)  # type: ignore[arg-type]
