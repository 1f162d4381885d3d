"""The report of a camera calibration: residuals over the image, coverage, errors by view, outliers, what is not to be trusted."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from boxplus.report.optimization.figures import FONT
from boxplus.report.palette import FAINT, GRID, INK, SERIES, STATUS
from boxplus.report.skeleton import figure_section, html_table, tiles, warnings_section, write_html
from boxplus.runs.camera_calibration.summary import CalibrationSummary, CameraFacts
from boxplus.systems.camera_calibration.calibration import CameraCalibration
from boxplus.systems.camera_calibration.one_camera import tilts_deg
from boxplus.systems.camera_calibration.structure import CELLS

_MOST_POINTS = 6000
_LISTED = 10


def write_calibration_report(path: Path, summary: CalibrationSummary, found: CameraCalibration) -> Path:
    """Write the page; returns its path.

    Raises:
        OutputError: it cannot be written.
    """
    parts = [_head(summary), warnings_section(_lines(summary)), _numbers(summary)]
    parts.append(
        figure_section(
            "Coverage and errors by view",
            "Corners: where they were seen; the lens is extrapolated over the rest. Views: root mean square error of every view, "
            "against the angle between camera and target; views near 0 deg say little of the focal length.",
            _coverage(found),
        )
    )
    parts.append(
        figure_section(
            "Residuals over the image",
            "Mean residual of the corners in each cell, enlarged; noise makes short arrows of all directions, a lens of another "
            "kind a pattern. Shares of the squared residuals that are a pattern: "
            + ", ".join(f"{facts.name} {facts.pattern:.0%}" for facts in summary.cameras)
            + ".",
            _pattern(found),
        )
    )
    parts.append(
        figure_section(
            "Residuals, and the target as they see it",
            "First the residuals of all corners that count, then where the residuals would have the target's corners, enlarged; "
            f"{found.on_target.rms_m * 1e3:.3f} mm (rms), which explains {found.on_target.share:.0%} of the squared residuals.",
            _scatter_and_target(found),
            _lens_table(summary),
        )
    )
    if summary.imu is not None:
        parts.append(_imu(summary))
    parts.append(_outliers(summary))
    parts.append(_facts(summary))
    return write_html(path, Path(summary.input).name, "\n".join(parts))


def _head(summary: CalibrationSummary) -> str:
    color = {"trusted": "", "doubtful": " interrupted", "refused": " interrupted"}[summary.state]
    numbers = [
        (f"{summary.sigma_px:.3f} px", "standard deviation of a corner's coordinate"),
        (f"{len(summary.cameras)}", "cameras" if len(summary.cameras) > 1 else "camera"),
        (f"{sum(facts.views for facts in summary.cameras)}", "views that count"),
        (f"{sum(facts.corners for facts in summary.cameras):,}", f"corners, {len(summary.outliers):,} left out"),
        (summary.lens, "lens"),
    ]
    return (
        f"<h1>{escape(Path(summary.input).name)}</h1>"
        f'<p class="lead"><span class="state{color}">{summary.state}</span> boxplus calibrate cameras '
        f"{escape(summary.versions['boxplus'])} · {summary.started:%Y-%m-%d %H:%M} UTC</p>{tiles(numbers)}"
    )


def _lines(summary: CalibrationSummary) -> list[str]:
    return [f"{finding.severity}: {escape(finding.text)}" for finding in summary.findings]


def _numbers(summary: CalibrationSummary) -> str:
    rows = [
        (facts.name, name, f"{value:.6g}", f"{facts.sigmas[name]:.2g}")
        for facts in summary.cameras
        for name, value in facts.parameters.items()
    ]
    table = html_table(rows, ("camera", "parameter", "value", "standard deviation"))
    mounted = [
        (
            facts.name,
            "\n".join("  ".join(f"{value: .6f}" for value in row) for row in facts.T_cn_cnm1),
            f"({_numbers_of(facts.mounting_sigma_deg or [], 4)}) deg, "
            f"({_numbers_of([1e3 * v for v in facts.mounting_sigma_m or []], 3)}) mm",
        )
        for facts in summary.cameras
        if facts.T_cn_cnm1 is not None
    ]
    below = "".join(
        f"<tr><td class='key'>{name}</td><td><pre>{escape(T)}</pre></td><td>{sigma}</td></tr>" for name, T, sigma in mounted
    )
    if below:
        head = "<tr><th>camera</th><th>T_cn_cnm1: of the camera before, to this one</th><th>standard deviations</th></tr>"
        below = f"<table>{head}{below}</table>"
    text = (
        "Standard deviations come from the scatter of the corners; errors that views share (blur, a target that bends, a lens "
        "that is of another kind) are not in them. Even and odd views disagree by "
        + ", ".join(f"{'–' if facts.halves is None else f'{facts.halves:.1f}'} ({facts.name})" for facts in summary.cameras)
        + f" times their standard deviations. All lengths scale with the size of the target, {summary.target}, which cameras "
        "alone cannot test."
    )
    compared = "".join(f"<li>{escape(line)}</li>" for line in summary.compared)
    compared = f"<p>Compared:</p><ul>{compared}</ul>" if compared else ""
    return f"<section><h2>Calibration</h2><p>{escape(text)}</p>{table}{below}{compared}</section>"


def _numbers_of(values: list[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _titles(found: CameraCalibration) -> list[str]:
    return [f"cam{camera}" for camera in range(len(found.singles))]


def _image_axes(figure: go.Figure, size: tuple[int, int], row: int, col: int) -> None:
    figure.update_xaxes(range=[-0.5, size[0] - 0.5], row=row, col=col, showgrid=False, constrain="domain")
    figure.update_yaxes(
        range=[size[1] - 0.5, -0.5],
        row=row,
        col=col,
        showgrid=False,
        scaleanchor=f"x{_axis(row, col)}",
        constrain="domain",
        constraintoward="top",
    )


def _axis(row: int, col: int) -> str:
    number = 2 * (row - 1) + col
    return "" if number == 1 else str(number)


def _coverage(found: CameraCalibration) -> go.Figure:
    count = len(found.singles)
    figure = make_subplots(
        rows=count, cols=2, subplot_titles=[t for name in _titles(found) for t in (f"{name}: corners", f"{name}: views")]
    )
    for camera, single in enumerate(found.singles):
        corners, kept = single.corners, single.kept
        some = np.flatnonzero(kept)[:: -(-int(kept.sum()) // _MOST_POINTS)]
        for rows, color, size in ((some, SERIES[0], 3), (np.flatnonzero(~kept), STATUS["lost"], 5)):
            u, v = corners.pixels[rows].T
            marker = {"size": size, "color": color}
            named = [f"frame {corners.names[corners.frame_of[n]]}, corner {corners.corner_of[n]}" for n in rows]
            figure.add_scattergl(
                x=u, y=v, mode="markers", marker=marker, text=named, hoverinfo="text", showlegend=False, row=camera + 1, col=1
            )
        _image_axes(figure, corners.sizes[0], camera + 1, 1)
        frames = np.unique(corners.frame_of[kept])
        tilt = tilts_deg(single.rig)[frames]
        rms = [single.rms_px(corners.frame_of == frame) for frame in frames]
        text = [f"frame {corners.names[frame]}" for frame in frames]
        marker = {"size": 7, "color": SERIES[2]}
        hover = "%{text}: %{y:.3f} px at %{x:.0f} deg<extra></extra>"
        figure.add_scatter(
            x=tilt, y=rms, mode="markers", marker=marker, text=text, hovertemplate=hover, showlegend=False, row=camera + 1, col=2
        )
        figure.update_xaxes(title_text="target from the side [deg]", rangemode="tozero", row=camera + 1, col=2)
        figure.update_yaxes(title_text="rms [px]", rangemode="tozero", row=camera + 1, col=2)
    return _styled(figure, 360 * count)


def _pattern(found: CameraCalibration) -> go.Figure:
    count = len(found.singles)
    figure = make_subplots(rows=1, cols=max(count, 2), subplot_titles=_titles(found))
    for camera, (image, single) in enumerate(zip(found.images, found.singles, strict=True)):
        width, height = single.corners.sizes[0]
        x = (np.arange(CELLS[0]) + 0.5) * width / CELLS[0] - 0.5
        y = (np.arange(CELLS[1]) + 0.5) * height / CELLS[1] - 0.5
        seen = np.where(image.count > 0, image.count, np.nan)
        hover = "%{z} corners<extra></extra>"
        figure.add_heatmap(
            x=x, y=y, z=seen, colorscale="Blues", opacity=0.35, showscale=False, hovertemplate=hover, row=1, col=camera + 1
        )
        lengths = np.linalg.norm(image.mean, axis=2)
        longest = float(np.nanpercentile(lengths, 95)) if np.isfinite(lengths).any() else 1.0
        factor = width / CELLS[0] / max(longest, 1e-9)
        grid = np.stack(np.meshgrid(x, y), axis=2)
        ends = grid + factor * image.mean
        path = np.stack([grid, ends, np.full_like(grid, np.nan)], axis=2).reshape(-1, 2)
        figure.add_scatter(
            x=path[:, 0],
            y=path[:, 1],
            mode="lines",
            line={"color": INK, "width": 1.4},
            hoverinfo="skip",
            showlegend=False,
            row=1,
            col=camera + 1,
        )
        text = [f"{length:.3f} px" for length in lengths.ravel()]
        figure.add_scatter(
            x=ends[..., 0].ravel(),
            y=ends[..., 1].ravel(),
            mode="markers",
            marker={"size": 4, "color": INK},
            text=text,
            hoverinfo="text",
            showlegend=False,
            row=1,
            col=camera + 1,
        )
        figure.update_xaxes(title_text=f"arrows: {factor:.0f} x", row=1, col=camera + 1)
        figure.update_xaxes(range=[-0.5, width - 0.5], showgrid=False, constrain="domain", row=1, col=camera + 1)
        anchor = "x" if camera == 0 else f"x{camera + 1}"
        figure.update_yaxes(
            range=[height - 0.5, -0.5], showgrid=False, scaleanchor=anchor, constrain="domain", row=1, col=camera + 1
        )
    return _styled(figure, 380)


def _scatter_and_target(found: CameraCalibration) -> go.Figure:
    figure = make_subplots(rows=1, cols=2, subplot_titles=("residuals [px]", "target [m], shifts enlarged"))
    for camera, single in enumerate(found.singles):
        rows = np.flatnonzero(single.kept)
        rows = rows[:: -(-len(rows) // _MOST_POINTS)]
        u, v = single.residuals[rows].T
        marker = {"size": 3, "color": SERIES[camera % len(SERIES)], "opacity": 0.5}
        figure.add_scattergl(x=u, y=v, mode="markers", marker=marker, name=f"cam{camera}", hoverinfo="skip", row=1, col=1)
    figure.update_yaxes(scaleanchor="x", row=1, col=1)
    places, shift = found.target.corners[:, :2], found.on_target.shift
    longest = float(np.nanpercentile(np.linalg.norm(shift, axis=1), 95))
    factor = 0.4 * found.target.tag_size / max(longest, 1e-12)
    path = np.stack([places, places + factor * shift, np.full_like(places, np.nan)], axis=1).reshape(-1, 2)
    marker = {"size": 4, "color": FAINT}
    figure.add_scatter(
        x=places[:, 0], y=places[:, 1], mode="markers", marker=marker, name="corners", hoverinfo="skip", row=1, col=2
    )
    figure.add_scatter(
        x=path[:, 0],
        y=path[:, 1],
        mode="lines",
        line={"color": INK, "width": 1.4},
        name=f"shift, {factor:.0f} x",
        hoverinfo="skip",
        row=1,
        col=2,
    )
    figure.update_yaxes(scaleanchor="x2", row=1, col=2)
    return _styled(figure, 420)


def _styled(figure: go.Figure, height: int) -> go.Figure:
    figure.update_layout(
        height=height, font=FONT, paper_bgcolor="white", plot_bgcolor="white", margin={"l": 60, "r": 20, "t": 40, "b": 44},
        legend={"orientation": "h", "y": -0.12},
    )  # fmt: skip
    figure.update_xaxes(gridcolor=GRID, zerolinecolor=GRID)
    figure.update_yaxes(gridcolor=GRID, zerolinecolor=GRID)
    return figure


def _lens_table(summary: CalibrationSummary) -> str:
    rows = [(name, f"{sigma:.4f}", "this one" if name == summary.lens else "") for name, sigma in summary.sigma_by_lens.items()]
    return html_table(rows, ("lens", "leaves [px]", ""))


def _imu(summary: CalibrationSummary) -> str:
    imu = summary.imu
    if imu is None:
        return ""
    first: CameraFacts = summary.cameras[0]
    T = "" if first.T_cam_imu is None else "\n".join("  ".join(f"{value: .6f}" for value in row) for row in first.T_cam_imu)
    rows = [
        ("rotation", f"± ({_numbers_of(imu.sigma_deg, 4)}) deg about the camera's axes"),
        ("position", f"± ({_numbers_of([1e3 * value for value in imu.sigma_m], 2)}) mm along the IMU's axes"),
        ("clock, t_imu − t_camera", f"{imu.timeshift_cam_imu_s * 1e3:+.3f} ± {imu.sigma_s * 1e3:.3f} ms"),
        ("bias of the gyroscope", f"({_numbers_of(imu.bias_gyro, 5)}) rad/s"),
        ("bias of the accelerometer", f"({_numbers_of(imu.bias_accel, 4)}) m/s²"),
        ("free fall in the target's frame", f"({_numbers_of(imu.gravity_target, 4)})"),
        (
            "size of the target by the IMU",
            "not measured"
            if imu.target_scale is None
            else f"{imu.target_scale:.4f} ± {imu.target_scale_sigma:.4f} of the stated one",
        ),
        (
            "mean squares of whitened residuals",
            f"{imu.corner_chi2:.2f} of the corners, {imu.imu_chi2:.2f} of the IMU (about 1, or less)",
        ),
        ("frames", f"{imu.frames}, from {imu.used_s[0]:.1f} to {imu.used_s[1]:.1f} s of {imu.session_s:.1f} s of images"),
    ]
    what = "<p>T_cam_imu of cam0, which maps IMU coordinates to the camera's:</p>"
    return f"<section><h2>IMU</h2>{what}<pre>{T}</pre>{html_table(rows)}</section>"


def _outliers(summary: CalibrationSummary) -> str:
    if not summary.outliers:
        return "<section><h2>Corners left out</h2><p>None.</p></section>"
    listed = "".join(f"<li>{escape(text)}</li>" for text in summary.outliers[:_LISTED])
    more = f"<p>The worst {_LISTED}; all are in run.json.</p>" if len(summary.outliers) > _LISTED else ""
    return f"<section><h2>Corners left out: {len(summary.outliers):,}</h2>{more}<ul>{listed}</ul></section>"


def _facts(summary: CalibrationSummary) -> str:
    rows = [("input", summary.input), ("target", summary.target)]
    rows += [
        (
            facts.name,
            f"{facts.resolution[0]} x {facts.resolution[1]} px, {facts.views} views, {facts.corners:,} corners, "
            f"rms {facts.rms_px:.3f} px, {facts.coverage:.0%} of the image covered",
        )
        for facts in summary.cameras
    ]
    rows.append(("versions", ", ".join(f"{name} {version}" for name, version in summary.versions.items())))
    return f"<section><h2>Facts</h2>{html_table(rows)}</section>"
