"""The main pictures as PNG files, for papers and tickets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from boxplus.formats.output import atomic_file, make_folder
from boxplus.report.palette import FAINT, GRID, INK, MARKS, SERIES, STATUS, XYZ, highest_ms, shown_rows, worked_ms
from boxplus.report.run_data import RunData
from boxplus.report.timeline import Timeline
from boxplus.runs.lidar_inertial.scan_log import SHARES
from boxplus.runs.run_folder import PLOTS
from boxplus.systems.lidar_inertial_odometry.estimate import AXES, WAITED

_DPI = 130
_HEADROOM_M = 1.0
"""Map points higher than this above the path are left out of the view from above: a ceiling would hide everything."""


def write_plots(data: RunData) -> None:
    """Write the pictures to `plots/` in the run's folder: trajectory, status, timing, biases where there is an IMU.

    Raises:
        OutputError: they cannot be written.
    """
    way = f"{data.summary.path_length_m:.1f} m in {data.summary.duration_s:.1f} s, from above"
    pictures = [trajectory_picture(data, way), _status(data), _timing(data)]
    if data.summary.has_imu:
        pictures.append(biases_picture(data))
    write_pictures(data.folder.plots, dict(zip(PLOTS, pictures, strict=False)))


def write_pictures(folder: Path, pictures: Mapping[str, Figure]) -> None:
    """Write figures under their names.

    Raises:
        OutputError: they cannot be written.
    """
    make_folder(folder)
    for name, figure in pictures.items():
        with atomic_file(folder / name) as file:
            figure.savefig(file, format="png", dpi=_DPI)


def trajectory_picture(data: Timeline, title: str) -> Figure:
    """From above, over the map."""
    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    axes = figure.subplots()
    points = data.map_points
    points = points[points[:, 2] < data.position[:, 2].max() + _HEADROOM_M]
    if len(points):
        low, high = np.percentile(points[:, 2], [1, 99])
        points = points[np.argsort(points[:, 2])]
        size = float(np.clip(6e4 / len(points), 0.4, 4.0))
        color = {"c": points[:, 2], "cmap": "viridis", "vmin": low, "vmax": high}
        shown = axes.scatter(points[:, 0], points[:, 1], s=size, linewidths=0, alpha=0.7, **color)
        figure.colorbar(shown, ax=axes, label="height [m]", shrink=0.5, aspect=30)
    rows = shown_rows(data)
    path, status = data.position[rows], data.status[rows]
    axes.plot(path[:, 0], path[:, 1], color="white", linewidth=3.0)
    axes.plot(path[:, 0], path[:, 1], color=INK, linewidth=1.4, label="trajectory")
    for name in ("weak", "lost"):
        here = status == name
        if here.any():
            axes.scatter(path[here, 0], path[here, 1], s=18, color=STATUS[name], marker=MARKS[name][1], label=name, zorder=3)
    axes.scatter(path[0, 0], path[0, 1], s=45, facecolors="white", edgecolors=INK, label="start", zorder=4)
    axes.scatter(path[-1, 0], path[-1, 1], s=45, color=INK, marker="X", label="end", zorder=4)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set_title(title, loc="left", fontsize=11)
    axes.legend(loc="upper right", framealpha=0.9, fontsize=9)
    plain(axes)
    return figure


def _status(data: RunData) -> Figure:
    """Status, and the LiDAR's share of each axis' information."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    strip, shares = figure.subplots(2, 1, sharex=True, height_ratios=[0.12, 1.0])
    rows = shown_rows(data)
    edges = status_strip(strip, data, rows)
    mesh = shares.pcolormesh(edges, np.arange(7), data.log.matrix(SHARES)[rows].T, cmap="cividis", vmin=0.0, vmax=1.0)
    shares.set_yticks(np.arange(6) + 0.5, AXES)
    shares.invert_yaxis()
    shares.set_xlabel("time since the first estimate [s]")
    figure.colorbar(mesh, ax=shares, label="share from LiDAR", aspect=18)
    return figure


def status_strip(strip: Axes, data: Timeline, rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """The status over time in its colours; returns the borders of the cells."""
    edges = _edges(data.seconds[rows])
    codes = np.array([[list(STATUS).index(status) for status in data.status[rows]]])
    strip.pcolormesh(edges, [0, 1], codes, cmap=ListedColormap(list(STATUS.values())), vmin=-0.5, vmax=2.5)
    strip.set_yticks([0.5], ["status"])
    for name, color in STATUS.items():
        strip.plot([], [], "s", color=color, label=f"{name} ({int((data.status == name).sum())})")
    strip.legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, fontsize=9, borderaxespad=0.2)
    return edges


def _timing(data: RunData) -> Figure:
    """Milliseconds per scan, stacked by stage."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    axes = figure.subplots()
    rows = shown_rows(data)
    stages = data.log.pairs("timing_ms")
    if stages:
        colors = [SERIES[index % len(SERIES)] for index in range(len(stages))]
        axes.stackplot(
            data.seconds[rows], [values[rows] for values in stages.values()], labels=list(stages), colors=colors, linewidth=0
        )
        axes.set_ylim(0.0, highest_ms(data))
        axes.legend(ncols=3, loc="upper left", fontsize=9, frameon=False)
    if data.summary.timing.scan_ms is not None:
        median, p99, largest = np.percentile(worked_ms(data), [50, 99, 100])
        axes.axhline(median, color=INK, linewidth=0.9, linestyle="--")
        aside = f", {WAITED} aside" if WAITED in stages else ""
        text = f"median {median:.1f} ms, 99th percentile {p99:.1f} ms, largest {largest:.1f} ms{aside}"
        axes.set_title(text, loc="left", fontsize=11)
    axes.set(xlabel="time since the first estimate [s]", ylabel="ms per scan")
    axes.margins(x=0.0)
    plain(axes)
    return figure


def biases_picture(data: Timeline) -> Figure:
    """Biases of gyroscope and accelerometer, with one standard deviation."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    rows = shown_rows(data)
    kinds = (("bias_gyro", 180.0 / np.pi, "gyroscope [deg/s]"), ("bias_accel", 1.0, "accelerometer [m/s²]"))
    for axes, (name, factor, label) in zip(figure.subplots(2, 1, sharex=True), kinds, strict=True):
        values, sigma = factor * data.log.column(name)[rows], factor * data.log.column(f"sigma_{name}")[rows]
        for axis, color in enumerate(XYZ):
            low, high = values[:, axis] - sigma[:, axis], values[:, axis] + sigma[:, axis]
            axes.fill_between(data.seconds[rows], low, high, color=color, alpha=0.13, linewidth=0)
            axes.plot(
                data.seconds[rows],
                values[:, axis],
                color=color,
                linewidth=1.2,
                linestyle=("-", "--", ":")[axis],
                label="xyz"[axis],
            )
        margin = 0.25 * float(np.ptp(values)) + 1e-6
        axes.set_ylim(values.min() - margin, values.max() + margin)
        axes.set_ylabel(label)
        axes.margins(x=0.0)
        plain(axes)
    figure.axes[0].legend(ncols=3, loc="upper right", fontsize=9, frameon=False)
    figure.axes[1].set_xlabel("time since the first estimate [s]")
    return figure


def _edges(seconds: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """The borders of the cells around (N,) times."""
    if len(seconds) == 1:
        return np.array([seconds[0] - 0.05, seconds[0] + 0.05])
    middle = 0.5 * (seconds[1:] + seconds[:-1])
    return np.concatenate([[2 * seconds[0] - middle[0]], middle, [2 * seconds[-1] - middle[-1]]])


def plain(axes: Axes) -> None:
    """The look of all axes."""
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=FAINT, labelsize=9)
