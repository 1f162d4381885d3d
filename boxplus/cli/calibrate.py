"""`boxplus calibrate`: how sensors are mounted, timed and scaled, from a recording of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.cameras.calibrate_cameras import cameras
from boxplus.cli.model_options import takes_recording_options
from boxplus.cli.options import RESULTS, JsonOption, QuietOption, RecordingArgument
from boxplus.cli.terminal.help import Command
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.runs.calibration import Quantity

app = typer.Typer(add_completion=False, rich_markup_mode=None, no_args_is_help=True)


@app.callback()
def _calibrate() -> None:
    """Find out how sensors are mounted, timed and scaled, from a recording of them."""


app.command("cameras", cls=Command)(cameras)


@app.command("lidar-imu", cls=Command)
@takes_recording_options
def lidar_imu(
    recording: RecordingArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="YAML file for 'boxplus lio --config'; printed when not given.", rich_help_panel=RESULTS
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file.", rich_help_panel=RESULTS)] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    *,
    options: RecordingOptions,
) -> None:
    """Mounting, clock offset, scales and gyroscope bias of a LiDAR and an IMU.

    Exit code 1 when the motion does not determine the mounting: the file then holds the rest and says what motion would.
    """
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.errors import InputError
    from boxplus.recordings import open_recording
    from boxplus.runs.calibration import calibrate_lidar_imu, calibration_facts, calibration_yaml

    terminal = Terminal(quiet=quiet, as_json=as_json)
    with reported(recording, output, as_json=as_json) as outcome:
        if output is not None and output.exists() and not overwrite:
            raise InputError("a new file for the calibration", f"{output} exists", "choose another --output, or give --overwrite")
        with (
            open_recording(recording, options) as opened,
            terminal.working(f"comparing LiDAR and IMU of {recording.name}") as show,
        ):
            found = calibrate_lidar_imu(opened, options, show)
        _print_table(terminal, found.quantities)
        for text in found.warnings:
            terminal.warn(text)
        text = calibration_yaml(found, options, recording.name)
        if output is not None:
            _write(output, text)
            terminal.say(str(output))
        elif not as_json:  # with JSON, the numbers are there
            typer.echo(text, nl=False)
        facts = calibration_facts(found)
        if found.has_mounting:
            outcome.end(facts)
        else:
            rest = "" if output is None else f", which {output} leaves out"
            outcome.fall_short(
                facts,
                f"expected a motion that determines T_imu_lidar – got one that leaves it open{rest} – record what "
                "stands under advice",
            )


def _write(path: Path, text: str) -> None:
    from boxplus.formats.output import atomic_file, make_folder

    make_folder(path.parent)
    with atomic_file(path) as file:
        file.write(text.encode())


def _print_table(terminal: Terminal, quantities: Sequence[Quantity]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(show_lines=False, pad_edge=False)
    for heading in ("", "what", "value", "standard deviation", "advice"):
        table.add_column(heading, overflow="fold")
    for quantity in quantities:
        known = Text("known", style="green") if quantity.determined else Text("open", style="yellow")
        table.add_row(known, quantity.name, Text(quantity.value), Text(quantity.std), Text(quantity.advice))
        if not quantity.determined and terminal.alarms is not terminal.console:
            terminal.warn(f"{quantity.name} is open: {quantity.advice}")
    terminal.console.print(table)
