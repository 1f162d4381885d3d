"""`boxplus report`: draw the report of a run from its folder, finished or not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path,
        typer.Argument(help="The output folder of 'boxplus lio', 'slam', 'vio' or 'vo'.", metavar="FOLDER"),
    ],
) -> None:
    """Draw the report of a run again, also of an interrupted one, and say how far the run came."""
    from boxplus.errors import printable
    from boxplus.report import load_report, write_report

    data = load_report(folder)
    typer.echo(printable(data.summary.describe_state()))
    typer.echo(str(write_report(data)))
