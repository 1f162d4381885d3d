"""`report.html`: one self-contained page, facts and warnings first."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from string import Template

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from boxplus.formats.output import atomic_file
from boxplus.report import figures
from boxplus.report.run_data import RunData
from boxplus.systems.run_summary import Gap, Matrix

_STYLE = """
:root { --ink: #22303c; --faint: #6b7a8f; --line: #e4e8ec; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7f9; color: var(--ink); font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 24px; margin: 0; } h2 { font-size: 17px; margin: 0 0 2px; }
.lead { color: var(--faint); margin: 4px 0 18px; }
section { background: white; border: 1px solid var(--line); border-radius: 8px; padding: 16px 18px; margin: 16px 0; }
section > p { color: var(--faint); margin: 0 0 8px; font-size: 14px; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(160px, 1fr)); gap: 12px; margin: 18px 0 0; }
.figures div { background: white; border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px; }
.figures b { display: block; font-size: 21px; font-weight: 600; } .figures span { color: var(--faint); font-size: 13px; }
.state { display: inline-block; border-radius: 5px; padding: 1px 9px; color: white; background: #2f7d5b; font-size: 14px; }
.state.interrupted, .state.running { background: #b97a1a; } .state.failed { background: #c1443c; }
.warnings { border-left: 4px solid #e09f3e; } .warnings ul { margin: 6px 0 0; padding-left: 20px; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
td, th { text-align: left; vertical-align: top; padding: 4px 12px 4px 0; border-bottom: 1px solid var(--line); }
th { color: var(--faint); font-weight: 500; } td.key { color: var(--faint); white-space: nowrap; width: 1%; padding-right: 24px; }
td.warning { color: #a8690c; } td.error { color: #c1443c; }
code, pre { font: 13px ui-monospace, Menlo, Consolas, monospace; } pre { margin: 0; }
details { margin-top: 8px; } summary { cursor: pointer; color: var(--faint); }
@media print { body { background: white; } section { break-inside: avoid; } }
"""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
<script>$plotly</script>
</head>
<body>
<main>
$body
</main>
</body>
</html>
""")

_CONFIG = {"displaylogo": False, "responsive": True, "displayModeBar": False}
_CONFIG_3D = {"displaylogo": False, "responsive": True, "displayModeBar": True, "scrollZoom": True}


def write_page(data: RunData) -> Path:
    """Write `report.html` into the run's folder; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    text = _PAGE.substitute(
        title=f"{escape(Path(data.summary.recording.path).name)} – boxplus", style=_STYLE, plotly=get_plotlyjs(), body=_body(data)
    )
    with atomic_file(data.folder.report) as file:
        file.write(text.encode())
    return data.folder.report


def _body(data: RunData) -> str:
    parts = [_head(data), _warnings(data)]
    about_map = (
        f"{len(data.map_points):,} of {data.summary.map.stored_points:,} map points, by height; the trajectory by status."
        if len(data.map_points)
        else "The run kept no map; the trajectory is coloured by status."
    )
    parts.append(
        _figure(
            "Map and trajectory",
            f"{about_map} Drag to turn, scroll to zoom, click in the legend to hide.",
            figures.map_and_trajectory(data),
        )
    )
    parts.append(
        _figure(
            "Status and information",
            "ok: all six axes measured; weak: some directions only predicted from the IMU; lost: no update. Below, for every "
            "axis of the pose (rotation about the IMU's axes, position along the world's), the share of its information that "
            "came from the LiDAR.",
            figures.status_and_axes(data),
            _weak_table(data),
        )
    )
    parts.append(_figure("Timing", _timing_text(data), figures.timing(data), _stage_table(data)))
    parts.append(_figure("Velocity", "Of the IMU, along the world's axes.", figures.velocity(data)))
    parts.append(_figure("Uncertainty", "Standard deviations of the pose.", figures.sigmas(data)))
    parts.append(_figure("Biases", "With one standard deviation.", figures.biases(data)))
    parts.append(
        _figure("Gravity", "Magnitude, and the change of its direction since the first estimate.", figures.gravity(data))
    )
    parts.append(_extrinsic(data))
    text = "Points of a scan after the voxel filter, and the root mean square distance of the used ones from their planes."
    parts.append(_figure("Points", text, figures.points(data)))
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
    tiles = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for value, name in numbers)
    color = summary.state if summary.contradiction is None else "failed"
    told = summary.describe_state().removeprefix(summary.state).lstrip(": ")
    return (
        f"<h1>{escape(Path(summary.recording.path).name)}</h1>"
        f'<p class="lead"><span class="state {color}">{summary.state}</span> {escape(told)} · '
        f"{escape(summary.recording.format)} · boxplus {escape(summary.versions['boxplus'])} · "
        f"{summary.started:%Y-%m-%d %H:%M} UTC</p>"
        f'<div class="figures">{tiles}</div>'
    )


def _warnings(data: RunData) -> str:
    lines = []
    for warning in data.summary.warnings:
        when = "" if warning.first_s is None else f", first at {warning.first_s:.1f} s"
        times = f" <small>({warning.count} times{when})</small>" if warning.count > 1 else ""
        lines.append(f"<li>{escape(warning.text)}{times}</li>")
    lines += [f"<li>map: {escape(remark)}</li>" for remark in data.map_remarks]
    if not lines:
        return '<section><h2>Warnings</h2><p style="margin:0">None.</p></section>'
    return f'<section class="warnings"><h2>Warnings</h2><ul>{"".join(lines)}</ul></section>'


def _figure(title: str, text: str, figure: go.Figure, below: str = "") -> str:
    config = _CONFIG_3D if figure.layout.scene.camera.eye.x is not None else _CONFIG
    drawn = figure.to_html(full_html=False, include_plotlyjs=False, config=config, default_width="100%")
    return f"<section><h2>{escape(title)}</h2><p>{escape(text)}</p>{drawn}{below}</section>"


def _table(rows: Iterable[tuple[str, ...]], heading: tuple[str, ...] = ()) -> str:
    head = f"<tr>{''.join(f'<th>{escape(cell)}</th>' for cell in heading)}</tr>" if heading else ""
    body = "".join(
        f'<tr><td class="key">{escape(row[0])}</td>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>' for row in rows
    )
    return f"<table>{head}{body}</table>" if body else ""


def _weak_table(data: RunData) -> str:
    intervals = data.summary.weak_intervals
    if not intervals:
        return ""
    rows = [(f"{i.begin_s:.1f} – {i.end_s:.1f} s", i.status, f"{i.scans}", i.text) for i in intervals[:200]]
    table = _table(rows, ("time", "status", "scans", "at its beginning"))
    return f"<details><summary>Intervals that were not ok: {len(intervals)}</summary>{table}</details>"


def _timing_text(data: RunData) -> str:
    timing = data.summary.timing
    text = (
        f"The odometry's time per scan by stage. In all {timing.total_s:.1f} s: {timing.odometry_s:.1f} s odometry, "
        f"{timing.reading_s:.1f} s waiting for the reader, {timing.writing_s:.1f} s writing trajectory and tiles, "
        f"{timing.merging_s:.1f} s merging the map."
    )
    if timing.compiled_kernels:
        text += f" {timing.compiled_kernels} kernels were compiled during the run (first use only), which the times include."
    return text


def _stage_table(data: RunData) -> str:
    timing = data.summary.timing
    stages = dict(timing.stages_ms) | ({"all stages": timing.scan_ms} if timing.scan_ms is not None else {})
    rows = [(name, f"{d.median:.2f}", f"{d.p99:.2f}", f"{d.max:.2f}") for name, d in stages.items()]
    return _table(rows, ("stage", "median [ms]", "99th percentile", "largest"))


def _extrinsic(data: RunData) -> str:
    facts = data.summary.extrinsic
    estimation = {"off": "kept as it was", "on": "refined throughout", "gated": "refined while the motion made it observable"}
    matrices = f"<td><pre>{_matrix(facts.T_imu_lidar_start)}</pre></td>"
    if facts.T_imu_lidar_end is not None and facts.estimation != "off":
        matrices += f"<td><pre>{_matrix(facts.T_imu_lidar_end)}</pre></td>"
    table = f"<table><tr><th>T_imu_lidar at the start</th><th>at the end</th></tr><tr>{matrices}</tr></table>"
    what = f"{facts.source}, {estimation.get(facts.estimation, '')}"
    text = f"Pose of the LiDAR in the IMU frame (p_imu = T_imu_lidar p_lidar): {what}. {facts.text}"
    if facts.estimation == "off":
        return f"<section><h2>Extrinsic</h2><p>{escape(text)}</p>{table.replace('<th>at the end</th>', '')}</section>"
    return _figure("Extrinsic", text, figures.extrinsic(data), table)


def _matrix(T: Matrix) -> str:
    return "\n".join("  ".join(f"{value: .5f}" for value in row) for row in T)


def _input(data: RunData) -> str:
    summary = data.summary
    text = (
        f"{summary.scans_read} scans and {summary.imu_samples_read} IMU samples were read. Gaps are intervals more than "
        f"three times the usual one: {_gap_text(summary.imu_gaps)} of the IMU, {_gap_text(summary.scan_gaps)} of the scans."
    )
    rows = [(place, reason, f"{count:,}") for place, counts in summary.rejected.items() for reason, count in counts.items()]
    table = _table(rows, ("where", "rejected because", "count")) or "<p>Nothing was rejected.</p>"
    if summary.imu_gaps or summary.scan_gaps:
        return _figure("Gaps and rejections", text, figures.gaps(data), table)
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
    evidence = "".join(
        f'<tr><td class="key">{escape(e["key"])}</td><td>{escape(e["value"])}</td>'
        f'<td class="{escape(e["verdict"])}">{escape(e["verdict"])}</td><td>{escape(e["text"])}</td></tr>'
        for e in recording.evidence
    )
    head = "<tr><th>reading</th><th>found</th><th></th><th>evidence</th></tr>"
    settings = escape(data.folder.config.read_text(encoding="utf-8")) if data.folder.config.is_file() else ""
    return (
        f"<section><h2>Run</h2>{_table(rows)}</section>"
        f"<section><h2>How the recording was read</h2><table>{head}{evidence}</table>"
        f"<details><summary>config.yaml</summary><pre>{settings}</pre></details></section>"
    )
