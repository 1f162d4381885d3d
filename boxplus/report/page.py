"""`report.html`: one self-contained page, facts and warnings first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

from boxplus.report import figures
from boxplus.report.run_data import RunData
from boxplus.report.skeleton import figure_section, html_table, tiles, warnings_section, write_html
from boxplus.runs.lidar_inertial.summary import Matrix
from boxplus.runs.run_facts import Gap, RunFacts, WarningFacts, WeakInterval
from boxplus.systems.lidar_inertial_odometry.estimate import WAITED


def write_page(data: RunData) -> Path:
    """Write `report.html` into the run's folder; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    return write_html(data.folder.report, Path(data.summary.recording.path).name, _body(data))


def _body(data: RunData) -> str:
    parts = [_head(data), _warnings(data)]
    about_map = (
        f"{len(data.map_points):,} of {data.summary.map.stored_points:,} map points, by height; the trajectory by status."
        if len(data.map_points)
        else "The run kept no map; the trajectory is coloured by status."
    )
    parts.append(
        figure_section(
            "Map and trajectory",
            f"{about_map} Drag to turn, scroll to zoom, click in the legend to hide.",
            figures.map_and_trajectory(data),
        )
    )
    body = "IMU" if data.summary.has_imu else "LiDAR"
    parts.append(
        figure_section(
            "Status and information",
            "ok: all six axes measured; weak: some directions only predicted; lost: no update. Below, for every axis of "
            f"the pose (rotation about the {body}'s axes, position along the world's), the share of its information that came "
            "from the scan.",
            figures.status_and_axes(data),
            weak_table(data.summary.weak_intervals, "scans"),
        )
    )
    parts.append(figure_section("Timing", _timing_text(data), figures.timing(data), _stage_table(data)))
    parts.append(figure_section("Velocity", f"Of the {body}, along the world's axes.", figures.velocity(data)))
    parts.append(figure_section("Uncertainty", "Standard deviations of the pose.", figures.sigmas(data)))
    if data.summary.has_imu:
        text = "Magnitude, and the change of its direction since the first estimate."
        parts.append(figure_section("Biases", "With one standard deviation.", figures.biases(data)))
        parts.append(figure_section("Gravity", text, figures.gravity(data)))
    parts.append(_sensors(data))
    parts.append(_extrinsic(data))
    parts.append(_lidars(data))
    text = "Points of a scan after the voxel filter, and the root mean square distance of the used ones from their planes."
    parts.append(figure_section("Points", text, figures.points(data)))
    parts.append(_input(data))
    parts.append(_facts(data))
    return "\n".join(parts)


def _head(data: RunData) -> str:
    summary = data.summary
    scan = summary.timing.scan_ms
    numbers = [
        (f"{summary.scans}", "scans"),
        (f"{summary.path_length_m:.1f} m", f"path in {summary.duration_s:.1f} s"),
        (f"{summary.status.get('ok', 0) / max(summary.scans, 1):.1%}", "of the scans ok"),
        (f"{scan.median:.1f} ms" if scan else "–", f"median per scan, 99th percentile {scan.p99:.1f} ms" if scan else "per scan"),
        (f"{summary.timing.real_time_factor:.1f} ×", "real time, reading included"),
        (f"{summary.map.stored_points:,}", "map points"),
    ]
    return headline(summary, summary.recording.path, summary.recording.format, numbers)


def headline(summary: RunFacts, recording: str, form: str, numbers: Sequence[tuple[str, str]]) -> str:
    """What a report begins with: the recording, how far the run came, the main numbers."""
    color = summary.state if summary.contradiction is None else "failed"
    told = summary.describe_state().removeprefix(summary.state).lstrip(": ")
    return (
        f"<h1>{escape(Path(recording).name)}</h1>"
        f'<p class="lead"><span class="state {color}">{summary.state}</span> {escape(told)} · '
        f"{escape(form)} · boxplus {escape(summary.versions['boxplus'])} · "
        f"{summary.started:%Y-%m-%d %H:%M} UTC</p>"
        f"{tiles(numbers)}"
    )


def _warnings(data: RunData) -> str:
    return warnings_section([*warning_lines(data.summary.warnings), *(f"map: {escape(remark)}" for remark in data.map_remarks)])


def warning_lines(warnings: Iterable[WarningFacts]) -> list[str]:
    """Each with how often it came."""
    lines = []
    for warning in warnings:
        when = "" if warning.first_s is None else f", first at {warning.first_s:.1f} s"
        times = f" <small>({warning.count} times{when})</small>" if warning.count > 1 else ""
        lines.append(f"{escape(warning.text)}{times}")
    return lines


def weak_table(intervals: Sequence[WeakInterval], unit: str) -> str:
    """The intervals that were not ok, folded away; `unit` is what they count."""
    if not intervals:
        return ""
    rows = [(f"{i.begin_s:.1f} – {i.end_s:.1f} s", i.status, f"{i.count}", i.text) for i in intervals[:200]]
    table = html_table(rows, ("time", "status", unit, "at its beginning"))
    return f"<details><summary>Intervals that were not ok: {len(intervals)}</summary>{table}</details>"


def _timing_text(data: RunData) -> str:
    timing = data.summary.timing
    text = (
        f"The odometry's time per scan by stage. In all {timing.total_s:.1f} s: {timing.odometry_s:.1f} s odometry, "
        f"{timing.reading_s:.1f} s waiting for the reader, {timing.writing_s:.1f} s writing trajectory and tiles, "
        f"{timing.merging_s:.1f} s merging the map."
    )
    if WAITED in timing.stages_ms:
        text += (
            " LiDAR and IMU are compared every few seconds, beside the odometry: in a recording, read faster than it was made, "
            f"a scan waits for the verdict ({WAITED}), so that the result does not depend on the machine; live none does."
        )
    if timing.compiled_kernels:
        text += f" {timing.compiled_kernels} kernels were compiled during the run (first use only), which the times include."
    return text


def _stage_table(data: RunData) -> str:
    timing = data.summary.timing
    stages = dict(timing.stages_ms) | ({"all stages": timing.scan_ms} if timing.scan_ms is not None else {})
    rows = [(name, f"{d.median:.2f}", f"{d.p99:.2f}", f"{d.max:.2f}") for name, d in stages.items()]
    return html_table(rows, ("stage", "median [ms]", "99th percentile", "largest"))


def _sensors(data: RunData) -> str:
    if not data.summary.sensors:
        return ""
    text = (
        "LiDAR and IMU are compared every few seconds, and what contradicts is named. What the motion has not shown could be "
        "wrong without a word: on a straight way at a steady speed a factor on all points, say."
    )
    rows = [("shown" if part.shown else "would not have been shown", part.text) for part in data.summary.sensors]
    table = html_table(rows, ("by the motion", "what"))
    return f"<section><h2>What the motion has shown</h2><p>{escape(text)}</p>{table}</section>"


def _extrinsic(data: RunData) -> str:
    facts = data.summary.extrinsic
    if not data.summary.has_imu:
        return f"<section><h2>Extrinsic</h2><p>{escape(facts.text)}.</p></section>"
    estimation = {"off": "kept as it was", "on": "refined throughout", "gated": "refined while the motion made it observable"}
    matrices = f"<td><pre>{matrix_text(facts.T_imu_lidar_start)}</pre></td>"
    if facts.T_imu_lidar_end is not None and facts.estimation != "off":
        matrices += f"<td><pre>{matrix_text(facts.T_imu_lidar_end)}</pre></td>"
    table = f"<table><tr><th>T_imu_lidar at the start</th><th>at the end</th></tr><tr>{matrices}</tr></table>"
    what = f"{facts.source}, {estimation.get(facts.estimation, '')}"
    text = f"Pose of the LiDAR in the IMU frame (p_imu = T_imu_lidar p_lidar): {what}. {facts.text}"
    if facts.estimation == "off":
        return f"<section><h2>Extrinsic</h2><p>{escape(text)}</p>{table.replace('<th>at the end</th>', '')}</section>"
    return figure_section("Extrinsic", text, figures.extrinsic(data), table)


def matrix_text(T: Matrix) -> str:
    """A matrix in rows."""
    return "\n".join("  ".join(f"{value: .5f}" for value in row) for row in T)


def _lidars(data: RunData) -> str:
    """Of several LiDARs what each gave, and whether it fits the first one; nothing for one alone."""
    lidars = data.summary.lidars
    if not lidars:
        return ""
    rows = [
        (
            lidar.topic,
            f"{lidar.scans:,}",
            f"{lidar.merged_points:,} of {lidar.points:,}",
            _gap_text(lidar.silences),
            "–" if lidar.checked is None else f"{lidar.checked} ({lidar.windows} windows)",
            lidar.checked_text or "",
        )
        for lidar in lidars
    ]
    text = "Merged by the time of each point, in the frame of the first; how the others lie in it is held while running."
    table = html_table(rows, ("LiDAR", "scans", "points merged", "silent", "against the first", "evidence"))
    return f"<section><h2>LiDARs</h2><p>{escape(text)}</p>{table}</section>"


def _input(data: RunData) -> str:
    summary = data.summary
    text = (
        f"{summary.scans_read} scans and {summary.imu_samples_read} IMU samples were read. Gaps are intervals more than "
        f"three times the usual one: {_gap_text(summary.imu_gaps)} of the IMU, {_gap_text(summary.scan_gaps)} of the scans."
    )
    rows = [(place, reason, f"{count:,}") for place, counts in summary.rejected.items() for reason, count in counts.items()]
    table = html_table(rows, ("where", "rejected because", "count")) or "<p>Nothing was rejected.</p>"
    if summary.imu_gaps or summary.scan_gaps:
        return figure_section("Gaps and rejections", text, figures.gaps(data), table)
    return f"<section><h2>Gaps and rejections</h2><p>{escape(text)}</p>{table}</section>"


def _gap_text(found: list[Gap]) -> str:
    return f"{len(found)} (longest {max(gap.duration_s for gap in found):.2f} s)" if found else "none"


def _facts(data: RunData) -> str:
    summary = data.summary
    recording, kept = summary.recording, summary.map
    thinning = "every point" if kept.voxel_m is None else f"one point per {kept.voxel_m:g} m voxel"
    rows: list[tuple[str, ...]] = [
        ("recording", recording.path),
        ("topics", f"LiDAR {recording.lidar_topic or '–'}, IMU {recording.imu_topic or '–'}; {recording.messages} messages"),
        ("start", f"{summary.start.kind}: {summary.start.text}" if summary.start is not None else "–"),
        ("map", f"{kept.registered_points:,} points registered, {kept.stored_points:,} kept ({thinning})"),
        ("memory", f"{summary.peak_memory_mb:.0f} MB at most" if summary.peak_memory_mb is not None else "–"),
        ("versions", ", ".join(f"{name} {version}" for name, version in summary.versions.items())),
    ]
    return f"<section><h2>Run</h2>{html_table(rows)}</section>{evidence_table(recording.evidence, data.folder.config)}"


def evidence_table(found: Iterable[Mapping[str, str]], config: Path) -> str:
    """How the recording was read, and the settings."""
    evidence = "".join(
        f'<tr><td class="key">{escape(e["key"])}</td><td>{escape(e["value"])}</td>'
        f'<td class="{escape(e["verdict"])}">{escape(e["verdict"])}</td><td>{escape(e["text"])}</td></tr>'
        for e in found
    )
    head = "<tr><th>reading</th><th>found</th><th></th><th>evidence</th></tr>"
    settings = escape(config.read_text(encoding="utf-8", errors="replace")) if config.is_file() else ""
    return (
        f'<section><h2>How the recording was read</h2><table class="evidence">{head}{evidence}</table>'
        f"<details><summary>config.yaml</summary><pre>{settings}</pre></details></section>"
    )
