"""`boxplus calibrate`: how sensors are mounted, timed and scaled, from a recording of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import EXIT_FAILED
from boxplus.cli.cameras.calibrate_cameras import cameras
from boxplus.cli.help import Command
from boxplus.cli.model_options import takes_recording_options
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.runs.calibration import Quantity

app = typer.Typer(add_completion=False, rich_markup_mode=None, no_args_is_help=True)


@app.callback()
def _calibrate() -> None:
    """Find out how sensors are mounted, timed and scaled, from a recording of them."""


app.command("cameras", cls=Command)(cameras)


@app.command("lidar-imu", cls=Command)
@takes_recording_options
def lidar_imu(
    recording: Annotated[Path, typer.Argument(help="ROS 1 bag, ROS 2 folder or file, KITTI raw folder, or pcap.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="YAML file for 'boxplus lio --config'; printed when not given.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file.")] = False,
    *,
    options: RecordingOptions,
) -> None:
    """Mounting, clock offset, scales and gyroscope bias of a LiDAR and an IMU.

    Exit code 1 when the motion does not determine the mounting: the file then holds the rest and says what motion would.
    """
    from rich.progress import Progress

    from boxplus.cli.console import make_console
    from boxplus.errors import InputError
    from boxplus.recordings import open_recording
    from boxplus.runs.calibration import calibrate_lidar_imu, calibration_yaml

    if output is not None and output.exists() and not overwrite:
        raise InputError("a new file for the calibration", f"{output} exists", "choose another --output, or give --overwrite")
    with (
        open_recording(recording, options) as opened,
        Progress(console=make_console(stderr=True), transient=True) as progress,
    ):
        task = progress.add_task(f"comparing LiDAR and IMU of {recording.name}", total=1.0)
        found = calibrate_lidar_imu(opened, options, lambda done: progress.update(task, completed=done))
    _print_table(found.quantities)
    text = calibration_yaml(found, options, recording.name)
    if output is None:
        typer.echo(text, nl=False)
    else:
        _write(output, text)
        typer.echo(str(output))
    if not found.has_mounting:
        typer.echo("the motion does not determine T_imu_lidar: not written", err=True)
        raise typer.Exit(EXIT_FAILED)


def _write(path: Path, text: str) -> None:
    from boxplus.formats.output import atomic_file, make_folder

    make_folder(path.parent)
    with atomic_file(path) as file:
        file.write(text.encode())


def _print_table(quantities: Sequence[Quantity]) -> None:
    from rich.table import Table
    from rich.text import Text

    from boxplus.cli.console import make_console

    table = Table(show_lines=False, pad_edge=False)
    for heading in ("", "what", "value", "standard deviation", "advice"):
        table.add_column(heading, overflow="fold")
    for quantity in quantities:
        known = Text("known", style="green") if quantity.determined else Text("open", style="yellow")
        table.add_row(known, quantity.name, Text(quantity.value), Text(quantity.std), Text(quantity.advice))
    make_console().print(table)
