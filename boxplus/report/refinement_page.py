"""The report of `boxplus refine`: before and after, and by how much every pose moved."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from boxplus.report.figures import plain_figure
from boxplus.report.palette import DASHES, FAINT, INK, XYZ
from boxplus.report.skeleton import figure_section, html_table, tiles, warnings_section, write_html
from boxplus.runs.refinement.folder import RefineFolder
from boxplus.runs.refinement.refine_run import RefineResult
from boxplus.runs.refinement.summary import RefineSummary


def write_refinement_report(folder: str | Path, summary: RefineSummary, result: RefineResult) -> Path:
    """Draw `report.html` of a refined run. Returns the path.

    Args:
        summary: with the errors against a ground truth, if there was one.

    Raises:
        OutputError: it cannot be written.
    """
    return write_html(RefineFolder(Path(folder)).report, Path(summary.run).name, _body(summary, result))


def _body(summary: RefineSummary, result: RefineResult) -> str:
    verdict = "accepted" if summary.accepted else "not accepted"
    numbers = [
        (verdict, "trajectory and map are the refined ones" if summary.accepted else "the trajectory is that of the run"),
        (f"{1e3 * summary.largest_shift_m:.1f} mm", "largest shift of a pose"),
        (f"{summary.largest_turn_deg:.3f}°", "largest turn of a pose"),
        (f"{summary.planes:,}", f"planes, seen by {summary.keyframes} keyframes"),
    ]
    head = (
        f"<h1>{escape(Path(summary.run).name)}, refined</h1>"
        f'<p class="lead"><span class="state {"" if summary.accepted else "interrupted"}">{verdict}</span> '
        f"boxplus {escape(summary.versions['boxplus'])} · {summary.started:%Y-%m-%d %H:%M} UTC</p>" + tiles(numbers)
    )
    parts = [
        head,
        warnings_section(escape(text) for text in [*summary.warnings, *filter(None, [summary.doubt])]),
        _table(summary),
    ]
    parts += [_from_above(result), _shifts(result)]
    return "\n".join(parts)


def _table(summary: RefineSummary) -> str:
    rows = []
    if summary.before is not None and summary.after is not None:
        thick, entropy = (summary.before.thickness_m, summary.after.thickness_m), (summary.before.entropy, summary.after.entropy)
        rows.append(("thickness of planes", *(f"{1e3 * value:.3f} mm" for value in thick), f"{thick[1] / thick[0]:.4f}"))
        rows.append(("entropy of the map", *(f"{value:.4f}" for value in entropy), f"{entropy[1] - entropy[0]:+.4f}"))
    if summary.ate_before_m is not None and summary.ate_after_m is not None:
        ate = summary.ate_before_m, summary.ate_after_m
        rows.append(("ATE", *(f"{1e3 * value:.2f} mm" for value in ate), f"{ate[1] / max(ate[0], 1e-12):.2f}"))
    for name, i in (("x", 0), ("y", 1), ("z", 2)):
        pair = [T[i][3] for T in (summary.T_imu_lidar_before, summary.T_imu_lidar_after)]
        rows.append(
            (
                f"LiDAR in the IMU frame, {name}",
                *(f"{1e3 * value:.2f} mm" for value in pair),
                f"{1e3 * (pair[1] - pair[0]):+.2f} mm",
            )
        )
    offset = summary.time_offset_s
    rows.append(
        ("time offset, IMU − LiDAR", "0.00 ms", f"{1e3 * offset:.2f} ms", f"± {1e3 * summary.time_offset_sigma_s:.2f} ms")
    )
    rows.append(("vertical", "", "", f"tilted by {summary.gravity_tilt_deg:.3f}°"))
    for number, (first, last) in enumerate(summary.cost):
        rows.append((f"cost of round {number + 1}", f"{first:,.0f}", f"{last:,.0f}", f"{last / max(first, 1e-12):.4f}"))
    text = (
        "Thickness and entropy are those of points that took no part in refining, on planes found before it. "
        f"The mounting of the LiDAR was {escape(summary.extrinsic)}. The time offset was {escape(summary.time_offset)}."
    )
    if summary.loops:
        text += f" Of {summary.loops} loops, planes that both visits see took the place of {summary.loops_told_by_planes}."
    return f"<section><h2>Before and after</h2><p>{text}</p>{html_table(rows, ('', 'before', 'after', 'change'))}</section>"


def _from_above(result: RefineResult) -> str:
    figure = go.Figure()
    for T, name, color, dash in ((result.T_before, "the run", FAINT, "dash"), (result.T_after, "refined", INK, "solid")):
        figure.add_trace(go.Scatter(x=T[:, 4], y=T[:, 5], name=name, mode="lines", line={"color": color, "dash": dash}))
    figure.update_layout(xaxis_title="x [m]", yaxis_title="y [m]", yaxis_scaleanchor="x")
    plain_figure(figure, 520)
    return figure_section("Trajectory from above", "The run, and what refining makes of it.", figure)


def _shifts(result: RefineResult) -> str:
    seconds = (result.time_ns - result.time_ns[0]) * 1e-9 if len(result.time_ns) else np.zeros(0)
    figure = go.Figure()
    for axis, name in enumerate("xyz"):
        shift = 1e3 * (result.T_after[:, 4 + axis] - result.T_before[:, 4 + axis])
        line = {"color": XYZ[axis], "width": 1.4, "dash": DASHES.get(XYZ[axis], "solid")}
        figure.add_trace(go.Scatter(x=seconds, y=shift, name=name, mode="lines", line=line))
    figure.update_layout(xaxis_title="time [s]", yaxis_title="shift [mm]")
    plain_figure(figure, 360)
    return figure_section(
        "By how much every pose moved", "Along the axes of the world; the first pose stays where it is.", figure
    )
