"""The report of `boxplus slam`: the corrected trajectory over the odometry's, and every loop with both maps over each other."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.report.page import warning_lines
from boxplus.report.palette import INK, STATUS
from boxplus.report.plots import plain
from boxplus.report.skeleton import html_table, picture, tiles, warnings_section, write_html
from boxplus.runs.slam.loop_file import why_refused
from boxplus.runs.slam.result import SlamResult
from boxplus.runs.slam.summary import GnssFacts
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.systems.slam.loop import Loop

_PLACE, _QUERY = "#8a8f98", STATUS["lost"]
_PICTURES = 30  # loops drawn: all accepted ones first
_POINTS = 8000  # of a local map in a picture
_MAP_POINTS = 200_000  # of all local maps in the overview


def write_slam_report(result: SlamResult) -> Path:
    """Draw `report.html` of a run with loop closure, without that of its odometry. Returns the path.

    Raises:
        InputError: a local map is missing or damaged.
        OutputError: the files cannot be written.
    """
    return write_html(result.folder.report, Path(result.summary.recording).name, _body(result))


def _body(result: SlamResult) -> str:
    summary = result.summary
    numbers = [
        (f"{summary.loops_accepted}", f"loops closed, of {summary.loops_looked_at} looked at"),
        (f"{summary.local_maps}", "local maps"),
        (f"{summary.largest_shift_m:.2f} m", "largest correction of a local map"),
        (f"{summary.path_length_m:.1f} m", "path of the odometry"),
        (f"{summary.map_points:,}", "points of the corrected map"),
    ]
    color, told = (summary.state, "") if summary.contradiction is None else ("failed", "not to be trusted · ")
    head = (
        f"<h1>{escape(Path(summary.recording).name)}</h1>"
        f'<p class="lead"><span class="state {color}">{summary.state}</span> {told}loops closed on LiDAR-inertial odometry · '
        f"boxplus {escape(summary.versions['boxplus'])} · {summary.started:%Y-%m-%d %H:%M} UTC · "
        '<a href="odometry/report.html">report of the odometry</a></p>' + tiles(numbers)
    )
    warnings = [escape(text) for text in summary.warnings]
    if summary.contradiction is not None:
        warnings.insert(0, escape(summary.contradiction))
    warnings += [f"odometry: {line}" for line in warning_lines(result.odometry.warnings)]
    parts = [head, warnings_section(warnings), _overview(result), _earth(result), _table(result), *_pictures(result)]
    return "\n".join(parts)


def _overview(result: SlamResult) -> str:
    """The map before and after from above, one over the other; a slider moves the border between them."""
    own = result.outcome.correction
    share = max(_MAP_POINTS // len(own.time_ns), 1)
    points = [result.maps[k].points for k in range(len(own.time_ns))]
    points = [cloud[:: max(len(cloud) // share, 1)] for cloud in points]
    clouds = [_placed(points, T) for T in (own.T_odo, own.T_map)]
    both = np.concatenate(clouds)
    corners = np.quantile(both, [0.002, 0.998], axis=0) + np.array([[-2.0], [2.0]])
    loops = [(loop.place, loop.query) for loop in result.outcome.accepted]
    before, after = (
        _from_above(cloud, T[:, 4:6], corners, loops, name)
        for cloud, T, name in zip(clouds, (own.T_odo, own.T_map), ("before", "after"), strict=True)
    )
    text = (
        "The map from above: left of the border as the odometry has it, right of it with loops closed. Violet: loops, each "
        "between two local maps; the correction is spread over the way between."
    )
    below, above = picture(after, "map after closing loops"), picture(before, "map before closing loops")
    half = '<div style="position:absolute;inset:0;clip-path:inset(0 50% 0 0)">'
    slider = (
        f'<div style="position:relative">{below}{half}{above}</div></div>'
        '<input type="range" min="0" max="100" value="50" style="width:100%" aria-label="border between before and after" '
        "oninput=\"this.previousElementSibling.lastElementChild.style.clipPath='inset(0 '+(100-this.value)+'% 0 0)'\">"
    )
    return f"<section><h2>Before and after</h2><p>{text}</p>{slider}</section>"


def _placed(points: Sequence[NDArray[np.float32]], T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) of local maps at poses (n, 7), from above."""
    return np.concatenate([se3.act(pose, cloud.astype(np.float64))[:, :2] for pose, cloud in zip(T, points, strict=True)])


def _from_above(
    cloud: NDArray[np.float64], path: NDArray[np.float64], corners: NDArray[np.float64], loops: list[tuple[int, int]], name: str
) -> Figure:
    """Points, path and loops within corners (2, 2); pictures of the same corners lie on each other."""
    width, height = corners[1] - corners[0]
    figure = Figure(figsize=(8.0, float(np.clip(8.0 * height / width, 2.2, 10.2))))
    axes = figure.add_axes((0.06, 0.05, 0.93, 0.9))
    axes.scatter(cloud[:, 0], cloud[:, 1], s=0.3, linewidths=0, color=_PLACE, rasterized=True)
    axes.plot(*path.T, color=INK, linewidth=1.2, marker=".", markersize=3)
    for ends in loops:
        axes.plot(*path[list(ends)].T, color=_QUERY, linewidth=1.4)
    axes.set(xlim=corners[:, 0], ylim=corners[:, 1], aspect="equal")
    axes.set_title(f"{name} [m]", loc="left" if name == "before" else "right", fontsize=10)
    plain(axes)
    return figure


def _earth(result: SlamResult) -> str:
    """The fixes over the ground track, from the run's files; nothing where the recording has none."""
    facts = result.summary.gnss
    if facts is None:
        return ""
    if facts.origin is None or facts.heading_sigma_deg is None:
        return f"<section><h2>On the Earth</h2><p>Not laid onto it: {escape(facts.refusal or '')}</p></section>"
    with result.folder.gnss.open(encoding="utf-8") as file:
        fixes = list(csv.DictReader(file))
    lla = [[float(row[name]) for name in ("latitude_deg", "longitude_deg", "height_m")] for row in fixes]
    p, used = EnuFrame(*facts.origin).to_enu(lla), np.array([row["used"] == "1" for row in fixes])
    figure = Figure(figsize=(5.8, 5.1), layout="constrained")
    axes = figure.subplots()
    axes.plot(*result.outcome.placed.T_map[:, 4:6].T, color=INK, linewidth=1.2, marker=".", label="local maps")
    axes.scatter(p[used, 0], p[used, 1], s=12.0, color=_PLACE, linewidths=0, label="fixes used")
    axes.scatter(p[~used, 0], p[~used, 1], s=16.0, color=_QUERY, linewidths=0, label="fixes that fit nothing")
    axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    axes.legend(framealpha=0.9, fontsize=9)
    plain(axes)
    rows = [(str(count), reason) for reason, count in facts.left_out.items()]
    left_out = html_table(rows, ("fixes", "not used because")) if rows else ""
    where = f"{facts.origin[0]:.7f}°, {facts.origin[1]:.7f}°, {facts.origin[2]:.2f} m above the ellipsoid of WGS84"
    text = (
        f"Origin {where}: look at the place on a map, an offset of the datum is seen nowhere else. {facts.used} fixes; "
        f"heading known to {facts.heading_sigma_deg:.2f}°, places to {facts.position_sigma_m:.2f} m. {_unshown(facts)}"
    )
    return f"<section><h2>On the Earth</h2><p>{text}</p>{picture(figure, 'fixes over the ground track')}{left_out}</section>"


def _unshown(facts: GnssFacts) -> str:
    """What these figures do not hold for; nothing where the run, of an older version, did not ask."""
    if "unshown_slide_m" not in facts.model_fields_set:
        return ""
    slide, turn = facts.unshown_slide_m, facts.unshown_turn_deg
    slides = "slide by any distance" if slide is None else f"slide by up to {slide:.1f} m from begin to end"
    turns = "be turned by any angle" if turn is None else f"be turned by up to {turn:.1f}° half way"
    return (
        f"That holds if errors of fixes last for no more than tens of seconds: they might {slides}, or {turns}, and the "
        "odometry, which may drift as much, would not show it."
    )


def _table(result: SlamResult) -> str:
    heading = ("loop", "at", "verdict", "found by", "overlap", "surfaces apart", "innovation", "measured", "weight", "why not")
    rows = [_row(loop, result.map_time_s) for loop in _ordered(result.outcome.loops)]
    how = (
        "To remove a loop or to force one, write its pair into a file and run again with --loops: "
        "<code>forbid: [[query, place]]</code>, <code>force: [[query, place]]</code>."
    )
    table = html_table(rows, heading) if rows else "<p>No place was proposed.</p>"
    return f"<section><h2>Every loop that was looked at</h2><p>{how}</p>{table}</section>"


def _row(loop: Loop, seconds: NDArray[np.float64]) -> tuple[str, ...]:
    was_laid = loop.measured > 0
    return (
        f"[{loop.query}, {loop.place}]",
        f"{seconds[loop.query]:.0f} s → {seconds[loop.place]:.0f} s",
        "closed" if loop.is_accepted else "refused",
        f"{loop.source}, {loop.inliers} features" if loop.inliers else loop.source,
        " / ".join(f"{100.0 * share:.0f} %" for share in loop.overlap) if was_laid else "–",
        f"{100.0 * loop.rms:.1f} cm" if was_laid else "–",
        f"{loop.innovation:.1f} of {loop.innovation_limit:.1f} σ" if was_laid else "–",
        f"{loop.measured} of 6" if was_laid else "–",
        f"{loop.weight:g}",
        why_refused(loop),
    )


def _ordered(loops: Sequence[Loop]) -> list[Loop]:
    return sorted(loops, key=lambda loop: (not loop.is_accepted, loop.query, loop.place))


def _pictures(result: SlamResult) -> list[str]:
    drawn = [loop for loop in _ordered(result.outcome.loops) if loop.measured > 0]
    sections = []
    for loop in drawn[:_PICTURES]:
        verdict = "closed" if loop.is_accepted else f"refused: {why_refused(loop)}"
        title = f"Loop [{loop.query}, {loop.place}]"
        drawing = picture(_both_maps(result, loop), title)
        sections.append(f"<section><h2>{title}</h2><p>{escape(verdict)}</p>{drawing}</section>")
    if len(drawn) > _PICTURES:
        sections.append(f"<p>{len(drawn) - _PICTURES} more loops are not drawn.</p>")
    return sections


def _both_maps(result: SlamResult, loop: Loop) -> Figure:
    """From above and from the side, the query over the place as it was registered."""
    place = _some(result.maps[loop.place].points)
    query = se3.act(loop.T_place_query, _some(result.maps[loop.query].points))
    figure = Figure(figsize=(7.3, 4.4), layout="constrained")
    above, side = figure.subplots(1, 2, width_ratios=(1.0, 1.0))
    for axes, (i, j), names in ((above, (0, 1), ("x [m]", "y [m]")), (side, (0, 2), ("x [m]", "z [m]"))):
        axes.scatter(place[:, i], place[:, j], s=1.0, linewidths=0, color=_PLACE)
        axes.scatter(query[:, i], query[:, j], s=1.0, linewidths=0, color=_QUERY, alpha=0.6)
        axes.set(xlabel=names[0], ylabel=names[1], aspect="equal")
        plain(axes)
    above.set_title(f"grey: local map {loop.place}, violet: {loop.query}", loc="left", fontsize=10)
    return figure


def _some(points: NDArray[np.float32]) -> NDArray[np.float64]:
    return points[:: max(len(points) // _POINTS, 1)].astype(np.float64)
