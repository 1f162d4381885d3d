"""The report of `boxplus localize`: the poses over the map, status and matched share over time, what the search looked at."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import se3
from boxplus.report.page import warning_lines
from boxplus.report.palette import INK, STATUS
from boxplus.report.plots import plain
from boxplus.report.skeleton import html_table, picture, tiles, warnings_section, write_html
from boxplus.runs.localization.folder import LocalizationFolder
from boxplus.runs.localization.localization_run import LocalizationResult
from boxplus.runs.localization.logs import LOG_COLUMNS
from boxplus.runs.storage.row_log import read_row_log

_MAP, _COLORS = "#8a8f98", dict(zip(("localised", "odometry only", "searching"), STATUS.values(), strict=True))
_POINTS = 60_000  # of the map in the picture


def write_localization_report(folder: str | Path, result: LocalizationResult) -> Path:
    """Draw `report.html` of a run in a saved map; that of the odometry too, in its own folder. Returns the path.

    Raises:
        OutputError: the files cannot be written.
    """
    from boxplus.report import write_report

    own = LocalizationFolder(Path(folder))
    if result.odometry.scans:
        write_report(own.odometry.path)
    return write_html(own.report, Path(result.summary.recording).name, _body(own, result))


def _body(own: LocalizationFolder, result: LocalizationResult) -> str:
    summary = result.summary
    total = max(sum(summary.status.values()), 1)
    numbers = [
        ("never" if summary.found_after_s is None else f"{summary.found_after_s:.1f} s", "until the place was found"),
        (f"{100 * summary.status.get('localised', 0) / total:.0f} %", "of scans localised"),
        (f"{summary.searches}", "searches"),
        (f"{len(summary.losses)}", "times lost"),
        (f"{summary.places}", "places of the map"),
    ]
    color, told = ("failed", "not to be trusted · ") if summary.reasons else (summary.state, "")
    head = (
        f"<h1>{escape(Path(summary.recording).name)}</h1>"
        f'<p class="lead"><span class="state {color}">{summary.state}</span> {told}in the map {escape(summary.map)} · '
        f"boxplus {escape(summary.versions['boxplus'])} · {summary.started:%Y-%m-%d %H:%M} UTC · "
        '<a href="odometry/report.html">report of the odometry</a></p>' + tiles(numbers)
    )
    candidates = set(summary.best_candidates)  # which have a table of their own
    against = [text for text in summary.reasons if text not in candidates]
    said = [*against, *summary.warnings, *(f"lost at {text}" for text in summary.losses)]
    notes = "".join(f"<li>{escape(text)}</li>" for text in summary.map_report)
    map_section = f"<section><h2>The map</h2><ul>{notes}</ul></section>"
    lines = [*(escape(text) for text in said), *(f"odometry: {line}" for line in warning_lines(result.odometry.warnings))]
    parts = [head, warnings_section(lines), _overview(own, result), _timeline(own)]
    if summary.best_candidates:
        rows = [(text,) for text in summary.best_candidates]
        parts.append(f"<section><h2>The best candidates, and why not</h2>{html_table(rows, ('of the last search',))}</section>")
    return "\n".join([*parts, map_section])


def _overview(own: LocalizationFolder, result: LocalizationResult) -> str:
    figure = Figure(figsize=(5.8, 5.1), layout="constrained")
    axes = figure.subplots()
    places = result.saved.local_maps
    each = max(_POINTS // len(places), 50)
    for place in places:
        some = place.points[:: max(len(place.points) // each, 1)].astype(np.float64)
        p = se3.act(place.T_odo_map, some)
        axes.scatter(p[:, 0], p[:, 1], s=0.5, linewidths=0, color=_MAP)
    if result.summary.found_after_s is not None:
        trajectory = read_trajectory(own.trajectory)
        status = np.array(trajectory.status or [""] * len(trajectory))
        for name, color in _COLORS.items():
            at = trajectory.p[status == name]
            axes.plot(at[:, 0], at[:, 1], ".", markersize=3, color=color, label=name)
        axes.legend(framealpha=0.9, fontsize=9)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plain(axes)
    text = "The map from above, in its own frame, and the poses in it. Where the place was searched for there are none."
    return f"<section><h2>In the map</h2><p>{text}</p>{picture(figure, 'trajectory in the map')}</section>"


def _timeline(own: LocalizationFolder) -> str:
    log = read_row_log(own.log, LOG_COLUMNS)
    seconds = (log.time_ns - log.time_ns[0]) * 1e-9 if len(log) else np.zeros(0)
    figure = Figure(figsize=(7.3, 4.2), layout="constrained")
    share, sigma = figure.subplots(2, 1, sharex=True)
    compared = np.isfinite(log.column("matched_share"))
    share.plot(seconds[compared], 100.0 * log.column("matched_share")[compared], color=INK, linewidth=1.0)
    for name, color in _COLORS.items():
        at = log.status == name
        share.plot(seconds[at], np.full(np.count_nonzero(at), -5.0), "s", markersize=4, color=color, label=name)
    share.set(ylabel="found in the map [%]", ylim=(-10.0, 105.0))
    share.legend(framealpha=0.9, fontsize=9)
    sigma.plot(seconds, 100.0 * log.column("sigma_position"), color=INK, linewidth=1.0)
    sigma.set(xlabel="time [s]", ylabel="σ of the position [cm]")
    plain(share)
    plain(sigma)
    text = "How much of what stands about the robot is found in the map, and how well the position in it is known."
    return f"<section><h2>Status</h2><p>{text}</p>{picture(figure, 'status over time')}</section>"
