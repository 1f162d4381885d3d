"""Pictures and the HTML report of a run, drawn from its output folder; and the live view."""

from __future__ import annotations

from pathlib import Path


def write_report(folder: str | Path) -> Path:
    """Draw `report.html` and the pictures in `plots/` from the output folder of a run, finished or not.

    Returns:
        The path of the report.

    Raises:
        InputError: no run's folder, or a run without a single scan.
        OutputError: the files cannot be written.
    """
    from boxplus.report.page import write_page
    from boxplus.report.plots import write_plots
    from boxplus.report.run_data import load_run

    data = load_run(folder)
    write_plots(data)
    return write_page(data)
