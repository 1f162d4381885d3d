"""Pictures and the HTML report of a run, drawn from its output folder; and the live view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.report.run_data import RunData


def write_report(run: str | Path | RunData) -> Path:
    """Draw `report.html` and the pictures in `plots/` from the output folder of a run, finished or not.

    Args:
        run: the folder, or what `run_data.load_run` read from it.

    Returns:
        The path of the report.

    Raises:
        InputError: no run's folder, or a run without a single scan.
        OutputError: the files cannot be written.
    """
    from boxplus.report.page import write_page
    from boxplus.report.plots import write_plots
    from boxplus.report.run_data import RunData, load_run

    data = run if isinstance(run, RunData) else load_run(run)
    write_plots(data)
    return write_page(data)
