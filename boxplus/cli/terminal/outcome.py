"""What became of each thing that a command was given: a line of JSON for scripts, and the exit code."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer
from pydantic import BaseModel, SerializeAsAny

from boxplus.cli import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_INTERRUPTED, EXIT_UNTRUSTED, print_error
from boxplus.cli.terminal.interrupt import left_at_once
from boxplus.errors import BoxplusError, InputError, printable

if TYPE_CHECKING:
    from boxplus.cli.ground_truth import Comparison
    from boxplus.cli.terminal.terminal import Terminal

Ending = Literal["not begun", "finished", "not to be trusted", "interrupted", "failed"]


class Outcome(BaseModel):
    """One line of `--json` (docs/command_line.md says what a script may rely on).

    Attributes:
        input: what was given.
        output: folder or file of the results.
        outcome: how it came out.
        exit_code: of a command that was given this alone; None where it was not begun.
        error: why there is no result or no report, why it did not take the place of an earlier one, or why it could not be
            compared with the ground truth.
        evaluation: the comparison with the ground truth, as in `evaluation.json`.
        run: what `run.json` holds.
    """

    input: str
    output: str | None
    outcome: Ending = "not begun"
    exit_code: int | None = None
    error: str | None = None
    evaluation: Mapping[str, Any] | None = None
    run: SerializeAsAny[BaseModel] | None = None

    def end(self, run: BaseModel | None, state: str = "finished", *, untrusted: bool = False) -> None:
        """It came to an end: with this state of `run.json`, and with results that are to be trusted or not."""
        self.run = run
        if state == "interrupted":
            self.outcome, self.exit_code = "interrupted", EXIT_INTERRUPTED
        elif untrusted:
            self.outcome, self.exit_code = "not to be trusted", EXIT_UNTRUSTED
        elif self.exit_code == EXIT_INTERRUPTED:  # while the report was drawn
            self.outcome = "interrupted"
        else:
            self.outcome, self.exit_code = "finished", self.exit_code or 0

    def hold_back(self, error: str) -> None:
        """What came out is not to be trusted, and did not take the place of what was there."""
        self.outcome, self.exit_code = "not to be trusted", EXIT_UNTRUSTED
        self._also(error)

    def fall_short(self, run: BaseModel, error: str) -> None:
        """It came to an end without what was asked for."""
        self.run, self.outcome, self.exit_code = run, "failed", EXIT_FAILED
        self._also(error)

    @contextmanager
    def drawing(self, terminal: Terminal) -> Iterator[None]:
        """The report is drawn in this block; where that fails the run is as good without it, and the exit code says so.

        Ctrl-C leaves the report out, not the results.
        """
        try:
            with left_at_once(), terminal.status("drawing the report"):
                yield
        except KeyboardInterrupt:
            self.exit_code = EXIT_INTERRUPTED
            self._also("interrupted: the report was not drawn, all other results are there")
        except Exception as error:  # noqa: BLE001 - results that took an hour are not to be lost for their pictures
            if not isinstance(error, BoxplusError):
                traceback.print_exc()
            self.exit_code = self.exit_code or EXIT_FAILED
            self._also(f"the report could not be drawn: {_named(error)}")

    def compare(self, comparison: Comparison | None) -> None:
        """With the ground truth; a run that cannot be compared is as good as without it, and its exit code goes before."""
        if comparison is not None:
            self.evaluation = comparison.evaluation
            if comparison.error is not None:
                self.exit_code = self.exit_code or EXIT_BAD_INPUT
                self._also(comparison.error)

    def stop(self, error: BaseException) -> None:
        """It was ended by an exception."""
        if isinstance(error, KeyboardInterrupt):
            self.outcome, self.exit_code, self.error = "interrupted", EXIT_INTERRUPTED, "stopped at once"
            return
        code = EXIT_BAD_INPUT if isinstance(error, InputError) else EXIT_FAILED
        self.outcome, self.exit_code, self.error = "failed", code, _named(error)

    def _also(self, error: str) -> None:
        self.error = error if self.error is None else f"{self.error}; {error}"

    def print_json(self) -> None:
        """In one line on the standard output."""
        typer.echo(self.model_dump_json())


def _named(error: BaseException) -> str:
    return str(error) if isinstance(error, BoxplusError) else printable(f"{type(error).__name__}: {error}")


@contextmanager
def reported(given: Path | str, output: Path | str | None, *, as_json: bool) -> Iterator[Outcome]:
    """A command at work on one thing: what becomes of it is told in JSON where that is asked for, and in the exit code.

    Raises:
        typer.Exit: with the code of the outcome that the block sets, where that is not 0.
    """
    outcome = Outcome(input=str(given), output=None if output is None else str(output))
    try:
        yield outcome
    except BaseException as error:
        outcome.stop(error)
        if as_json:
            outcome.print_json()
        raise
    if as_json:
        outcome.print_json()
    if outcome.error is not None:
        print_error(outcome.error)
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)
