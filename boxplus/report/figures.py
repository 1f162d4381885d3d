"""The interactive figures of the report."""

from __future__ import annotations

from itertools import cycle

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from boxplus.report.palette import (
    DASHES,
    FAINT,
    GRID,
    HEIGHT,
    INK,
    MARKS,
    REJECTED,
    SERIES,
    STATUS,
    XYZ,
    gravity_tilt_deg,
    highest_ms,
    shown_rows,
)
from boxplus.report.run_data import RunData
from boxplus.report.timeline import Timeline
from boxplus.runs.lidar_inertial.scan_log import SHARES
from boxplus.systems.lidar_inertial_odometry.estimate import AXES

_MOST_OF_A_BAND = 600
_PARTS = 64  # of a metre: what points of a map are rounded to, which makes the page smaller
_FONT = {"family": "system-ui, -apple-system, 'Segoe UI', sans-serif", "size": 12, "color": INK}


def map_and_trajectory(data: Timeline, unit: str = "m", names: tuple[str, str, str] = ("x", "y", "z")) -> go.Figure:
    """The map, coloured by height, and the trajectory, coloured by status; of three axes with these names, the last one up."""
    figure = go.Figure()
    points = np.round(_PARTS * data.map_points) / _PARTS
    if len(points):
        low, high = np.percentile(points[:, 2], [1, 99])
        figure.add_scatter3d(
            x=points[:, 0],
            y=points[:, 1],
            z=points[:, 2],
            mode="markers",
            name="map",
            hoverinfo="skip",
            marker={
                "size": 1.5,
                "color": points[:, 2],
                "colorscale": list(HEIGHT),
                "cmin": float(low),
                "cmax": float(high),
                "opacity": 0.75,
                "colorbar": {"title": {"text": f"height [{unit}]", "side": "right"}, "thickness": 12, "len": 0.6, "x": 1.0},
            },
        )
    rows = shown_rows(data)
    path, seconds, status = data.position[rows], data.seconds[rows], data.status[rows]
    line = {"color": STATUS["ok"], "width": 6}
    figure.add_scatter3d(x=path[:, 0], y=path[:, 1], z=path[:, 2], mode="lines", name="trajectory", hoverinfo="skip", line=line)
    for name, color in STATUS.items():
        here = status == name
        if here.any():
            figure.add_scatter3d(
                x=path[here, 0],
                y=path[here, 1],
                z=path[here, 2],
                mode="markers",
                name=f"{name} ({int((data.status == name).sum())})",
                marker={"size": 3.5 if name == "ok" else 5.5, "color": color, "symbol": MARKS[name][0]},
                customdata=seconds[here],
                hovertemplate=f"{name}, %{{customdata:.1f}} s<br>(%{{x:.2f}}, %{{y:.2f}}, %{{z:.2f}}) {unit}<extra></extra>",
            )
    for label, row in (("start", 0), ("end", -1)):
        x, y, z = ([float(value)] for value in path[row])
        symbol = "circle-open" if label == "start" else "x"
        marker = {"size": 7, "color": INK, "symbol": symbol}
        figure.add_scatter3d(x=x, y=y, z=z, mode="markers", name=label, marker=marker, hovertemplate=f"{label}<extra></extra>")
    axis = {"backgroundcolor": "white", "gridcolor": GRID, "zerolinecolor": GRID, "showspikes": False}
    figure.update_layout(
        height=640,
        font=_FONT,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        paper_bgcolor="white",
        legend={"x": 0.01, "y": 0.99, "bgcolor": "rgba(255,255,255,0.8)", "itemsizing": "constant"},
        scene={
            "aspectmode": "data",
            "dragmode": "orbit",
            "camera": {"eye": {"x": -0.85, "y": -0.85, "z": 1.5}},
            **{f"{at}axis": {**axis, "title": {"text": f"{name} [{unit}]"}} for at, name in zip("xyz", names, strict=True)},
        },
    )
    return figure


def status_and_axes(data: RunData) -> go.Figure:
    """The status, and how much of each axis came from the LiDAR."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, row_heights=[0.1, 0.9], vertical_spacing=0.03)
    rows = shown_rows(data)
    add_status(figure, data, rows)
    figure.add_heatmap(
        x=data.seconds[rows],
        y=AXES,
        z=data.log.matrix(SHARES)[rows].T,
        zmin=0.0,
        zmax=1.0,
        colorscale="Cividis",
        colorbar={"title": {"text": "share from LiDAR", "side": "right"}, "thickness": 12, "tickformat": ".0%"},
        hovertemplate="%{y}, %{x:.1f} s: %{z:.0%} measured<extra></extra>",
        row=2,
        col=1,
    )
    figure.update_yaxes(autorange="reversed", row=2, col=1)
    return over_time(figure, data, 300, bottom_row=2)


def add_status(figure: go.Figure, data: Timeline, rows: NDArray[np.intp]) -> None:
    """A strip in the colours of the status, in the first row of the figure."""
    names = list(STATUS)
    codes = [[names.index(status) for status in data.status[rows]]]
    scale = [[(index + step) / 3, STATUS[name]] for index, name in enumerate(names) for step in (0, 1)]
    figure.add_heatmap(
        x=data.seconds[rows],
        y=["status"],
        z=codes,
        zmin=-0.5,
        zmax=2.5,
        colorscale=scale,
        showscale=False,
        customdata=[list(data.status[rows])],
        hovertemplate="%{x:.1f} s: %{customdata}<extra></extra>",
        row=1,
        col=1,
    )


def timing(data: Timeline, unit: str = "scan") -> go.Figure:
    """Milliseconds per estimate, stacked by stage; what was waited for may be higher than the axis."""
    figure, rows = go.Figure(), shown_rows(data)
    stages = data.log.pairs("timing_ms")
    for color, (stage, milliseconds) in zip(cycle(SERIES), stages.items(), strict=False):
        add_area(figure, data, rows, milliseconds, stage, color, "%{y:.2f} ms")
    figure.update_yaxes(title_text=f"ms per {unit}", range=[0.0, highest_ms(data)])
    return over_time(figure, data, 280)


def velocity(data: Timeline) -> go.Figure:
    """Velocity of the IMU in the world."""
    figure, rows = go.Figure(), shown_rows(data)
    values = data.log.column("velocity")[rows]
    _add_xyz(figure, data.seconds[rows], values)
    add_line(figure, data.seconds[rows], np.linalg.norm(values, axis=1), "speed", INK)
    figure.update_yaxes(title_text="m/s")
    return over_time(figure, data, 260)


def biases(data: Timeline) -> go.Figure:
    """Biases of gyroscope and accelerometer with their standard deviations."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    rows = shown_rows(data)
    for row, (name, factor) in enumerate((("bias_gyro", 180.0 / np.pi), ("bias_accel", 1.0)), 1):
        values, sigma = factor * data.log.column(name)[rows], factor * data.log.column(f"sigma_{name}")[rows]
        _add_xyz(figure, data.seconds[rows], values, sigma, row=row, legend=row == 1)
        figure.update_yaxes(range=_range_of(values), row=row, col=1)
    figure.update_yaxes(title_text="gyroscope [deg/s]", row=1, col=1)
    figure.update_yaxes(title_text="accelerometer [m/s²]", row=2, col=1)
    return over_time(figure, data, 400, bottom_row=2)


def gravity(data: RunData) -> go.Figure:
    """Magnitude of gravity, and how far its direction moved from the first estimate."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    rows = shown_rows(data)
    values = data.log.column("gravity")[rows]
    add_line(figure, data.seconds[rows], np.linalg.norm(values, axis=1), "magnitude", SERIES[0], row=1)
    add_line(figure, data.seconds[rows], gravity_tilt_deg(values), "direction, from the first", SERIES[3], row=2)
    figure.update_yaxes(title_text="m/s²", row=1, col=1, tickformat=".3f")
    figure.update_yaxes(title_text="deg", row=2, col=1, rangemode="tozero")
    return over_time(figure, data, 300, bottom_row=2)


def sigmas(data: Timeline, unit: str = "cm") -> go.Figure:
    """Standard deviations of the pose."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    rows = shown_rows(data)
    _add_xyz(figure, data.seconds[rows], np.degrees(data.sigma[rows, :3]), row=1)
    _add_xyz(figure, data.seconds[rows], 100.0 * data.sigma[rows, 3:], row=2, legend=False)
    figure.update_yaxes(title_text="rotation [deg]", row=1, col=1, rangemode="tozero")
    figure.update_yaxes(title_text=f"position [{unit}]", row=2, col=1, rangemode="tozero")
    return over_time(figure, data, 380, bottom_row=2)


def points(data: RunData) -> go.Figure:
    """Points after the voxel filter: used, and rejected by reason; and the residuals of the used ones."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.65, 0.35])
    rows = shown_rows(data)
    add_area(figure, data, rows, data.log.column("points_used"), "used", SERIES[0], "%{y:.0f} points", row=1)
    for color, (reason, count) in zip(cycle(REJECTED), data.log.pairs("rejected").items(), strict=False):
        add_area(figure, data, rows, count, f"rejected: {reason}", color, "%{y:.0f} points", row=1)
    residual_cm = 100.0 * data.log.column("residual_rms")[rows]
    add_line(figure, data.seconds[rows], residual_cm, "residual (rms)", FAINT, row=2)
    figure.update_yaxes(title_text="points", row=1, col=1)
    figure.update_yaxes(title_text="cm", row=2, col=1, rangemode="tozero")
    return over_time(figure, data, 380, bottom_row=2)


def extrinsic(data: RunData) -> go.Figure:
    """How the refined extrinsic moved from where it began."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    rows = shown_rows(data)
    q = np.stack([data.log.column(f"imu_lidar_q{part}") for part in "wxyz"], axis=1)[rows]
    angle = 2.0 * np.degrees(np.arccos(np.clip(np.abs(q @ q[0]), 0.0, 1.0)))
    add_line(figure, data.seconds[rows], angle, "rotation, from the first", SERIES[3], row=1)
    _add_xyz(figure, data.seconds[rows], 100.0 * data.log.column("imu_lidar_p")[rows], row=2)
    figure.update_yaxes(title_text="deg", row=1, col=1, rangemode="tozero")
    figure.update_yaxes(title_text="position [cm]", row=2, col=1)
    return over_time(figure, data, 340, bottom_row=2)


def gaps(data: RunData) -> go.Figure:
    """Intervals without IMU samples or scans, at the time they began."""
    figure = go.Figure()
    for name, found, color in (
        ("IMU", data.summary.imu_gaps, SERIES[0]),
        ("scans", data.summary.scan_gaps, SERIES[4]),
    ):
        figure.add_bar(
            x=[gap.begin_s + gap.duration_s / 2 for gap in found],
            y=[gap.duration_s for gap in found],
            width=[max(gap.duration_s, data.seconds[-1] / 300) for gap in found],
            name=f"{name} ({len(found)})",
            marker={"color": color, "line": {"width": 0}},
            hovertemplate="%{x:.2f} s: %{y:.3f} s without data<extra></extra>",
        )
    figure.update_layout(barmode="overlay")
    figure.update_yaxes(title_text="gap [s]", rangemode="tozero")
    return over_time(figure, data, 220)


def add_line(
    figure: go.Figure,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    name: str,
    color: str,
    row: int | None = None,
    legend: bool = True,
) -> None:
    """One line."""
    place = {} if row is None else {"row": row, "col": 1}
    line = {"color": color, "width": 1.4, "dash": DASHES.get(color, "solid")}
    hover = f"{name}: %{{y:.4g}}<extra></extra>"
    figure.add_scatter(
        x=x, y=y, name=name, legendgroup=name, showlegend=legend, mode="lines", line=line, hovertemplate=hover, **place
    )


def _add_xyz(
    figure: go.Figure,
    x: NDArray[np.float64],
    values: NDArray[np.float64],
    sigma: NDArray[np.float64] | None = None,
    row: int | None = None,
    legend: bool = True,
) -> None:
    """Three lines, over bands of one standard deviation."""
    place = {} if row is None else {"row": row, "col": 1}
    for axis, (name, color) in enumerate(zip("xyz", XYZ, strict=True)):
        if sigma is not None:
            some = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MOST_OF_A_BAND)).astype(np.intp))
            middle, half = values[some, axis], sigma[some, axis]
            around = np.concatenate([middle + half, (middle - half)[::-1]])
            band = {"fill": "toself", "fillcolor": color, "opacity": 0.12, "line": {"width": 0}, "mode": "lines"}
            figure.add_scatter(
                x=np.concatenate([x[some], x[some][::-1]]),
                y=around,
                legendgroup=name,
                showlegend=False,
                hoverinfo="skip",
                **band,
                **place,
            )
        add_line(figure, x, values[:, axis], name, color, row, legend)


def add_area(
    figure: go.Figure,
    data: Timeline,
    rows: NDArray[np.intp],
    values: NDArray[np.float64],
    name: str,
    color: str,
    unit: str,
    row: int | None = None,
) -> None:
    """A layer on those before."""
    place = {} if row is None else {"row": row, "col": 1}
    figure.add_scatter(
        x=data.seconds[rows],
        y=values[rows],
        name=name,
        mode="lines",
        stackgroup="all",
        line={"width": 0.5, "color": color},
        hovertemplate=f"{name}: {unit}<extra></extra>",
        **place,
    )


def _range_of(values: NDArray[np.float64]) -> list[float]:
    """An axis that shows the lines; the bands of the first moments may go beyond it."""
    low, high = float(values.min()), float(values.max())
    margin = 0.25 * (high - low) + 1e-6
    return [low - margin, high + margin]


def plain_figure(figure: go.Figure, height: int) -> None:
    """White paper, a quiet grid, and the legend in lines above."""
    figure.update_layout(
        height=height,
        font=_FONT,
        paper_bgcolor="white",
        plot_bgcolor="white",
        margin={"l": 80, "r": 20, "t": 10, "b": 44},
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0.0, "itemsizing": "constant", "traceorder": "normal"},
    )
    figure.update_xaxes(showgrid=True, gridcolor=GRID, zerolinecolor=GRID)
    figure.update_yaxes(showgrid=True, gridcolor=GRID, zerolinecolor=GRID)


def over_time(figure: go.Figure, data: Timeline, height: int, bottom_row: int | None = None) -> go.Figure:
    """The look of all figures over time."""
    plain_figure(figure, height)
    figure.update_layout(hovermode="x unified")
    figure.update_xaxes(zeroline=False, range=[0.0, float(max(data.seconds[-1], 1e-3))])
    place = {} if bottom_row is None else {"row": bottom_row, "col": 1}
    figure.update_xaxes(title_text="time since the first estimate [s]", **place)
    return figure
