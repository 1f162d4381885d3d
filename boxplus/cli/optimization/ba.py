"""`boxplus ba`: a reconstruction in, an adjusted one and a report out."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus._words import counted
from boxplus.cli import uncollected
from boxplus.cli.optimization.options import (
    LinearSolverChoice,
    LinearSolverOption,
    LossOption,
    MethodChoice,
    MethodOption,
    OutputOption,
    TimeLimitOption,
    parse_loss,
    solver_options,
)
from boxplus.cli.options import JsonOption, NoReportOption, OverwriteOption, QuietOption, ThreadsOption
from boxplus.cli.terminal.viewing import ViewOption, viewing

if TYPE_CHECKING:
    from boxplus.formats.reconstructions.reconstruction import Reconstruction, ReconstructionFormat
    from boxplus.optimization.losses import Loss
    from boxplus.runs.optimization_summary import OptimizationSummary
    from boxplus.systems.bundle_adjustment.bundle_adjustment import BundleAdjustmentResult
    from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig


class FormatChoice(StrEnum):
    """Formats of reconstructions."""

    auto = "auto"
    bal = "bal"
    colmap = "colmap"
    lines = "lines"
    gbp = "gbp"


_POINT_FORMATS: dict[FormatChoice, ReconstructionFormat] = {
    FormatChoice.auto: "auto",
    FormatChoice.bal: "bal",
    FormatChoice.colmap: "colmap",
    FormatChoice.gbp: "gbp",
}


def ba(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="BAL file (plain or .bz2), the folder of a COLMAP model or of a line set (*.P, *.lines)."
        ),
    ],
    output: OutputOption = None,
    loss: LossOption = "none",
    sigma: Annotated[
        float | None,
        typer.Option("--sigma", min=1e-9, help="Standard deviation of a pixel measurement [px]; 1, of segments 0.3."),
    ] = None,
    refine_intrinsics: Annotated[
        bool, typer.Option("--refine-intrinsics", help="Of COLMAP's cameras: focal lengths and distortion; BAL's always are.")
    ] = False,
    refine_principal_point: Annotated[
        bool, typer.Option("--refine-principal-point", help="Of COLMAP's cameras, with --refine-intrinsics.")
    ] = False,
    points: Annotated[bool, typer.Option("--points/--no-points", help="Of a line set: adjust its points with its lines.")] = True,
    triangulate: Annotated[
        bool, typer.Option("--triangulate", help="Of a line set: find the lines from the segments, whatever the files say.")
    ] = False,
    method: MethodOption = MethodChoice.levenberg_marquardt,
    linear_solver: LinearSolverOption = LinearSolverChoice.auto,
    max_iterations: Annotated[
        int | None,
        typer.Option("--max-iterations", min=0, help="Steps tried at most; 100, of line sets 1000.", rich_help_panel="Solver"),
    ] = None,
    time_limit: TimeLimitOption = None,
    threads: ThreadsOption = None,
    format: Annotated[FormatChoice, typer.Option("--format", help="Of the file; auto looks into it.")] = FormatChoice.auto,
    view: ViewOption = None,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Adjust cameras, and points or lines, so that they explain best where these were seen.

    The result is written in the format of the input, and as scene.ply (points and camera centres). Exit codes: 0 done, 1 the
    problem does not determine its variables or the results could not be written, 2 bad input, 3 finished but not to be trusted
    (points behind cameras, cameras that do not move apart, focal lengths that the images do not tell), 130 interrupted (results
    up to there are complete).
    """
    with uncollected():
        from boxplus.cli.optimization.ba_lines import adjust_line_set, is_line_set
        from boxplus.cli.optimization.terminal import OptimizationTerminal
        from boxplus.cli.terminal.interrupt import stop_on_interrupt
        from boxplus.cli.terminal.outcome import reported
        from boxplus.errors import InputError
        from boxplus.formats.reconstructions.reconstruction import (
            read_reconstruction,
            reconstruction_file_name,
            write_reconstruction,
        )
        from boxplus.report.optimization.bundle_scene import camera_centers
        from boxplus.runs.storage.output_folder import output_folder
        from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle
        from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig, LineAdjustmentConfig

    started, terminal = datetime.now(UTC), OptimizationTerminal(quiet=quiet, as_json=as_json)
    robust = parse_loss(loss)
    if format is FormatChoice.lines or (format is FormatChoice.auto and is_line_set(file)):
        if view is not None:
            raise InputError("--view with cameras and points", "a line set", "leave it out; scene.ply shows the result")
        if refine_intrinsics or refine_principal_point:
            raise InputError("--refine-intrinsics with points", "a line set", "the intrinsics of line sets are held")
        line_config = LineAdjustmentConfig(use_points=points, triangulate=triangulate)
        if sigma is not None:
            line_config = line_config.model_copy(update={"sigma_px": sigma, "sigma_point_px": sigma})
        solver = solver_options(line_config.solver, method, linear_solver, max_iterations, time_limit, threads)
        line_config = line_config.model_copy(update={"solver": solver})
        folder = output or Path(f"{file.resolve().name}_boxplus")
        with reported(file, folder, as_json=as_json) as outcome:
            adjust_line_set(
                outcome, terminal, file, folder, line_config, robust, method, no_report=no_report, overwrite=overwrite
            )
        return
    if triangulate or not points:
        raise InputError("--triangulate and --no-points with a line set", f"{file}", "leave them out")
    config = BundleAdjustmentConfig() if sigma is None else BundleAdjustmentConfig(sigma_px=sigma)
    config = config.model_copy(
        update={
            "intrinsics": "refined" if refine_intrinsics or refine_principal_point else "held",
            "principal_point": "refined" if refine_principal_point else "held",
            "solver": solver_options(
                config.solver, method, linear_solver, 100 if max_iterations is None else max_iterations, time_limit, threads
            ),
        }
    )
    folder = output or Path(f"{file.resolve().name.removesuffix('.bz2').removesuffix('.txt')}_boxplus")
    with reported(file, folder, as_json=as_json) as outcome, ExitStack() as stack:
        with terminal.status("reading"):
            start = read_reconstruction(file, _POINT_FORMATS[format])
        shown = stack.enter_context(viewing("ProblemView", file.name, view))
        files, folders = _own_files(folder)
        stack.enter_context(output_folder(folder, "boxplus ba", lambda: files, lambda: folders, overwrite=overwrite))
        name = reconstruction_file_name(start, file, "adjusted")
        terminal.facts(file.name, _describe(start), robust)
        if shown is not None:
            shown.show_scene(False, start.points, camera_centers(start))
        with stop_on_interrupt(terminal.announce_stop) as should_stop, terminal.steps(method, should_stop) as show:
            result = adjust_bundle(start, config, loss=robust, callback=show)
            stopped = should_stop()
        if shown is not None:
            shown.show_scene(True, result.reconstruction.points, camera_centers(result.reconstruction))
        summary = _summary(file, name, started, start, result, config, robust, stopped)
        write_reconstruction(folder / name, result.reconstruction)
        _write_scene(folder / "scene.ply", result.reconstruction)
        if not no_report:
            with outcome.drawing(terminal):
                from boxplus.report.optimization.bundle_report import write_bundle_report

                write_bundle_report(folder, summary, start, result)
        terminal.conclude(summary, "px", folder, ["report.html", name, "scene.ply"], outcome)


def _own_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files and folders that this command writes."""
    from boxplus.formats.reconstructions import colmap_binary, colmap_text
    from boxplus.runs.optimization_summary import PLOTS

    model, plots = folder / "adjusted", folder / "plots"
    files = [folder / name for name in ("report.html", "adjusted.txt", "adjusted.txt.bz2", "scene.ply", "run.json")]
    files += [plots / name for name in PLOTS]
    files += [model / name for name in (*colmap_text.FILES, *colmap_binary.FILES)]
    return files, [model, plots]


def _describe(start: Reconstruction) -> str:
    sizes = _sizes(start)
    return f"{_kind(start)}; " + ", ".join(f"{count:,} {name}" for name, count in sizes.items())


def _kind(start: Reconstruction) -> str:
    from boxplus.formats.reconstructions.bal import BalProblem
    from boxplus.formats.reconstructions.colmap_model import ColmapModel

    if isinstance(start, ColmapModel):
        return f"COLMAP model ({start.format}, cameras {', '.join(sorted(set(start.camera_models)))})"
    return "BAL file" if isinstance(start, BalProblem) else "BAL file with common intrinsics"


def _sizes(start: Reconstruction) -> dict[str, int]:
    from boxplus.report.optimization.bundle_scene import camera_centers

    return {"cameras": len(camera_centers(start)), "points": len(start.points), "observations": len(start.pixels)}


def _summary(
    file: Path,
    output: str,
    started: datetime,
    start: Reconstruction,
    result: BundleAdjustmentResult,
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    stopped: bool,
) -> OptimizationSummary:
    from boxplus.cli.optimization.terminal import summary_of
    from boxplus.runs.optimization_summary import ErrorFacts

    rho = "" if loss is None else f", ρ {loss!r}"
    return summary_of(
        result.solution,
        config,
        loss,
        stopped,
        program="boxplus ba",
        started=started,
        input=str(file),
        output=output,
        sizes={**_sizes(start), "used": len(result.errors)},
        convention=f"cost ½ Σ {'ρ' if loss else ''}(‖e‖²/σ²) over the observations, σ = {config.sigma_px:g} px{rho}",
        start=_start(result, loss),
        errors_initial=ErrorFacts.of(result.errors_start),
        errors=ErrorFacts.of(result.errors),
        notes=list(result.notes),
        doubt=result.doubt,
    )


def _start(result: BundleAdjustmentResult, loss: Loss | None) -> str:
    found = result.cheirality
    anew = [f"{counted(len(found.triangulated), 'point')} triangulated anew"] if len(found.triangulated) else []
    anew += [f"{counted(len(found.turned_back), 'camera')} set anew"] if len(found.turned_back) else []
    anew += [f"{counted(found.left_out, 'observation')} left out"] if found.left_out else []
    if loss is not None and loss.is_redescending:
        anew.append("then the minimum under Huber's loss")
    return ", ".join(["the file's cameras and points", *anew])


def _write_scene(path: Path, reconstruction: Reconstruction) -> None:
    """Points in their colours, then the camera centres in red."""
    import numpy as np

    from boxplus.formats.clouds.scene_ply import write_scene_ply
    from boxplus.report.optimization.bundle_scene import camera_centers

    centers = camera_centers(reconstruction)
    colors = getattr(reconstruction, "colors", None)
    of_points = np.full((len(reconstruction.points), 3), 160, np.uint8) if colors is None else colors
    of_cameras = np.tile(np.array([220, 40, 30], np.uint8), (len(centers), 1))
    write_scene_ply(path, np.vstack([reconstruction.points, centers]), np.vstack([of_points, of_cameras]))
