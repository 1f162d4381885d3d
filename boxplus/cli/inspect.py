"""`boxplus inspect`: what is in a recording, and whether it is fit for odometry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import EXIT_FAILED
from boxplus.cli.model_options import takes_recording_options
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.runs.inspection.diagnosis import Diagnosis

_STYLE = {"ok": "green", "warning": "yellow", "error": "bold red"}


@takes_recording_options
def inspect(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING", help="ROS 1 bag, ROS 2 folder or file, KITTI raw folder, pcap, or a recording of cameras."
        ),
    ],
    T_imu_lidar: Annotated[
        str | None,
        typer.Option(
            "--T-imu-lidar",
            help="A mounting to check: pose of the LiDAR in the IMU frame, in the forms that 'boxplus lio' takes.",
        ),
    ] = None,
    camchain: Annotated[
        Path | None,
        typer.Option(
            "--calibration", "--camchain", help="Kalibr camchain of a recording of cameras; it overrules the recording's."
        ),
    ] = None,
    frame_rate: Annotated[
        float | None, typer.Option("--frame-rate", help="Images a second, where a recording of cameras has no times [Hz].")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Write the findings as JSON to this file too.")] = None,
    *,
    options: RecordingOptions,
) -> None:
    """Examine a recording: topics, rates, gaps, times, units, noise, extrinsic, points. Exit code 1 when there are errors.

    Where there is nothing to examine, no such file or folder, it is 2, as with every command.
    """
    from rich.progress import Progress

    from boxplus.cli.terminal.console import make_console
    from boxplus.errors import RecordingError
    from boxplus.runs.inspection.diagnosis import diagnose
    from boxplus.runs.transform import parse_transform

    if not recording.exists():
        raise RecordingError("a recording", f"no file or folder {recording}", "check the path")
    T_given = None if T_imu_lidar is None else parse_transform(T_imu_lidar)
    console = make_console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"examining {recording.resolve().name}", total=1.0)
        diagnosis = diagnose(
            recording,
            options,
            on_progress=lambda done: progress.update(task, completed=done),
            T_imu_lidar=T_given,
            camchain=camchain,
            frame_rate_hz=frame_rate,
        )
    if output is not None:
        _write(output, diagnosis)
    if json:
        typer.echo(diagnosis.to_json())
    else:
        _print_table(diagnosis)
    if diagnosis.verdict == "error":
        raise typer.Exit(EXIT_FAILED)


def _write(output: Path, diagnosis: Diagnosis) -> None:
    from boxplus.formats.output import atomic_file, make_folder

    make_folder(output.parent)
    with atomic_file(output) as file:
        file.write(f"{diagnosis.to_json()}\n".encode())


def _print_table(diagnosis: Diagnosis) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from boxplus.cli.terminal.console import make_console
    from boxplus.errors import printable

    console = make_console()
    title = Text(printable(": ".join(filter(None, (diagnosis.path.resolve().name, diagnosis.format)))))
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    table.add_column("what", no_wrap=True)
    table.add_column("value", overflow="fold")
    table.add_column("evidence", overflow="fold", ratio=1)
    for finding in diagnosis.evidence:
        style = _STYLE[finding.verdict]
        table.add_row(Text(finding.verdict, style=style), finding.key, Text(finding.value), Text(finding.text))
    console.print(table)
    counts = {verdict: sum(finding.verdict == verdict for finding in diagnosis.evidence) for verdict in _STYLE}
    numbers = (f"{counts[word]} {word}{'' if counts[word] == 1 else 's'}" for word in ("warning", "error"))
    summary = f"{counts['ok']} ok, {', '.join(numbers)}"
    console.print(Text(summary, style=_STYLE[diagnosis.verdict]))
