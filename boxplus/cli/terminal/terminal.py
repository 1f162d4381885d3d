"""Where a command prints, and how loudly: `--quiet` and `--json`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from rich.table import Table
from rich.text import Text

from boxplus.cli.terminal.console import make_console
from boxplus.errors import printable


class Terminal:
    """Prints on the standard output.

    Args:
        quiet: print warnings, what is not to be trusted or not finished, and the answer to Ctrl-C alone, on the standard error.
        as_json: leave the standard output to JSON, and print on the standard error.

    Attributes:
        console: for what `quiet` leaves out; alarms: for what it does not.
    """

    stopping = "finishing the files"
    """What goes on after a first Ctrl-C."""

    def __init__(self, *, quiet: bool = False, as_json: bool = False) -> None:
        self.console = make_console(stderr=as_json, quiet=quiet)
        self.alarms = make_console(stderr=True) if quiet else self.console

    def status(self, text: str) -> AbstractContextManager[object]:
        """A line that stands while something takes its time."""
        return self.console.status(text)

    def announce_stop(self) -> None:
        """Say that Ctrl-C was heard: who pressed it waits for an answer, in a quiet run as well."""
        self.alarms.print(f"interrupted: {self.stopping}; Ctrl-C again stops at once")

    def say(self, text: str, *, copied: bool = False) -> None:
        """A line; one that is there to be copied is not wrapped."""
        self.console.print(Text(printable(text)), soft_wrap=copied)

    @contextmanager
    def working(self, text: str) -> Iterator[Callable[[float], None]]:
        """A bar that is gone at the end; yields what is to be called with the share that is done, in [0, 1]."""
        from rich.progress import Progress

        with Progress(console=self.console, transient=True, disable=not self.console.is_terminal) as progress:
            task = progress.add_task(text, total=1.0)
            yield lambda done: progress.update(task, completed=done)

    def print_rows(self, rows: Iterable[tuple[str, str]]) -> None:
        """Names, and what they are."""
        table = Table(box=None, show_header=False, pad_edge=False)
        table.add_column(style="bold", no_wrap=True)
        table.add_column(overflow="fold")
        for name, text in rows:
            table.add_row(name, Text(printable(text)))
        self.console.print(table)

    def warn(self, text: str) -> None:
        """A warning."""
        self.alarms.print(Text.assemble(("warning: ", "yellow"), printable(text)))

    def doubt(self, text: str) -> None:
        """Why a result is not to be trusted."""
        self.alarms.print(Text.assemble(("not to be trusted: ", "bold red"), printable(text)))

    def print_failure(self, what: str, error: str) -> None:
        """That one of several things failed, and why."""
        self.alarms.print(Text.assemble(("failed: ", "bold red"), printable(f"{what}: {error}")))

    def print_files(self, folder: Path, names: Iterable[str]) -> None:
        """The paths of those that are there."""
        for name in names:
            if (folder / name).exists():
                self.console.print(f"  {folder / name}", soft_wrap=True, markup=False)
