"""`boxplus ba` on line sets: cameras and lines, and points with them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.cli.optimization.options import MethodChoice
    from boxplus.cli.optimization.terminal import OptimizationTerminal
    from boxplus.cli.terminal.outcome import Outcome
    from boxplus.formats.reconstructions.vgg_lines import VggLines
    from boxplus.optimization.losses import Loss
    from boxplus.runs.optimization_summary import OptimizationSummary
    from boxplus.systems.bundle_adjustment.config import LineAdjustmentConfig
    from boxplus.systems.bundle_adjustment.line_adjustment import LineAdjustmentResult

_ADJUSTED = "adjusted"


def is_line_set(file: Path) -> bool:
    """Whether this folder holds cameras and lines of the Visual Geometry Group's form."""
    return file.is_dir() and any(file.glob("*.P")) and any(file.glob("*l3d"))


def adjust_line_set(
    outcome: Outcome,
    terminal: OptimizationTerminal,
    file: Path,
    folder: Path,
    config: LineAdjustmentConfig,
    robust: Loss | None,
    method: MethodChoice,
    *,
    no_report: bool,
    overwrite: bool,
) -> None:
    """Read, adjust, write into `folder` and report, with what became of it in `outcome`."""
    from boxplus.cli.terminal.interrupt import stop_on_interrupt
    from boxplus.formats.reconstructions.vgg_lines import read_vgg_lines
    from boxplus.formats.reconstructions.vgg_writer import write_vgg_lines
    from boxplus.runs.storage.output_folder import output_folder
    from boxplus.systems.bundle_adjustment.line_adjustment import adjust_lines

    started = datetime.now(UTC)
    start = read_vgg_lines(file)
    files, folders = _own_files(folder, start)
    with output_folder(folder, "boxplus ba", lambda: files, lambda: folders, overwrite=overwrite):
        sizes = _sizes(start)
        terminal.facts(file.name, "line set; " + ", ".join(f"{count:,} {name}" for name, count in sizes.items()), robust)
        with stop_on_interrupt(terminal.announce_stop) as should_stop, terminal.steps(method, should_stop) as show:
            result = adjust_lines(start, config, loss=robust, callback=show)
            stopped = should_stop()
        summary = _summary(file, started, sizes, result, config, robust, stopped)
        write_vgg_lines(folder / _ADJUSTED, result.data)
        _write_scene(folder / "scene.ply", result)
        if not no_report:
            with outcome.drawing(terminal):
                from boxplus.report.optimization.line_report import write_line_report

                write_line_report(folder, summary, start, result)
        terminal.conclude(summary, "px", folder, ["report.html", _ADJUSTED, "scene.ply"], outcome)


def _sizes(data: VggLines) -> dict[str, int]:
    sizes = {"cameras": len(data.names), "lines": len(data.end_points_world), "segments": len(data.segments)}
    return {**sizes, "points": len(data.points_world), "pixels": len(data.pixels)}


def _own_files(folder: Path, data: VggLines) -> tuple[list[Path], list[Path]]:
    """Files and folders that this command writes."""
    from boxplus.runs.optimization_summary import PLOTS

    model, plots = folder / _ADJUSTED, folder / "plots"
    files = [folder / name for name in ("report.html", "scene.ply", "run.json")] + [plots / name for name in PLOTS]
    files += [model / name for name in ("l3d", "p3d", "nview-lines", "nview-corners")]
    files += [model / f"{name}.{kind}" for name in data.names for kind in ("P", "lines", "corners")]
    return files, [model, plots]


def _summary(
    file: Path,
    started: datetime,
    sizes: dict[str, int],
    result: LineAdjustmentResult,
    config: LineAdjustmentConfig,
    loss: Loss | None,
    stopped: bool,
) -> OptimizationSummary:
    import numpy as np

    from boxplus.cli.optimization.terminal import summary_of
    from boxplus.runs.optimization_summary import ErrorFacts

    rho = "" if loss is None else f", ρ {loss!r}"
    what = f"½ Σ {'ρ' if loss else ''}(‖e‖²/σ²) over both ends of the segments, σ = {config.sigma_px:g} px"
    if result.points is not None:
        what += f", and the points, σ = {config.sigma_point_px:g} px"
    before, after = (
        np.concatenate(errors)
        for errors in ((result.errors_start, result.point_errors_start), (result.errors, result.point_errors))
    )
    return summary_of(
        result.solution,
        config,
        loss,
        stopped,
        program="boxplus ba",
        started=started,
        input=str(file),
        output=_ADJUSTED,
        sizes=sizes,
        convention=f"cost {what}{rho}",
        start="cameras of the files, lines triangulated from the segments"
        if config.triangulate
        else "cameras and lines of the files",
        errors_initial=ErrorFacts.of(before),
        errors=ErrorFacts.of(after),
        notes=list(result.notes),
        doubt=result.doubt,
    )


def _write_scene(path: Path, result: LineAdjustmentResult) -> None:
    """Lines as edges, those that are not determined in red; points in grey, camera centres in dark red."""
    import numpy as np

    from boxplus.formats.clouds.scene_ply import write_scene_ply
    from boxplus.manifolds import quaternion

    data, found = result.data, result.triangulation.found
    R = quaternion.to_matrix(np.ascontiguousarray(data.T_camera_world[:, :4]))
    centers = -np.einsum("nji,nj->ni", R, data.T_camera_world[:, 4:])
    ends = data.end_points_world.reshape(-1, 3)
    colors = np.where(np.repeat(found, 2)[:, None], (47, 95, 158), (193, 68, 60))
    parts = [colors, np.tile((160, 160, 160), (len(data.points_world), 1)), np.tile((120, 20, 20), (len(centers), 1))]
    edges = np.arange(len(ends)).reshape(-1, 2)
    write_scene_ply(path, np.concatenate([ends, data.points_world, centers]), np.concatenate(parts).astype(np.uint8), edges)
