"""The option `--view`: where a run is shown in 3D, opened before the run and closed after it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from boxplus.cli.options import PRINTING


def checked_view(where: str | None) -> str | None:
    """Where to show it: what cannot be is said before anything is read."""
    if where is not None:
        from boxplus._extras import require
        from boxplus.report.viewer import check_target

        check_target(where)
        require("rerun", "which shows a run in 3D")
    return where


ViewOption = Annotated[
    str | None,
    typer.Option(
        "--view",
        metavar="WHERE",
        callback=checked_view,
        help="Show it in 3D: window, FILE.rrd to open later with 'rerun FILE.rrd', or the address of a viewer on this machine, "
        "rerun+http://127.0.0.1:9876/proxy (needs: pip install rerun-sdk).",
        rich_help_panel=PRINTING,
    ),
]


@contextmanager
def viewing(kind: str, title: str, where: str | None) -> Iterator[Any]:
    """A view of `boxplus.report.live_view`, and at the end what happened to it; None where none is asked for.

    Raises:
        InputError: see `Viewer`.
    """
    if where is None:
        yield None
        return
    from boxplus.report import live_view

    view = getattr(live_view, kind)(title, where)
    try:
        yield view
    finally:
        view.close()
        if view.note is not None:
            typer.echo(f"view: {view.note}", err=True)
