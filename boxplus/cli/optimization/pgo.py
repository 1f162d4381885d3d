"""`boxplus pgo`: a pose graph in, an optimised one and a report out."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import uncollected
from boxplus.cli.optimization.options import (
    LinearSolverChoice,
    LinearSolverOption,
    LossOption,
    MaxIterationsOption,
    MethodChoice,
    MethodOption,
    OutputOption,
    TimeLimitOption,
    parse_loss,
    solver_options,
)
from boxplus.cli.options import JsonOption, NoReportOption, OverwriteOption, QuietOption, ThreadsOption
from boxplus.cli.terminal.own_words import POSE_GRAPH, saying
from boxplus.cli.terminal.viewing import ViewOption, viewing
from boxplus.errors import InputError

if TYPE_CHECKING:
    from boxplus.formats.graphs.pose_graph import PoseGraph
    from boxplus.optimization.losses import Loss
    from boxplus.runs.optimization_summary import OptimizationSummary
    from boxplus.systems.pose_graph.pose_graph import PoseGraphConfig, PoseGraphResult


class StartChoice(StrEnum):
    """Where to start."""

    auto = "auto"
    file = "file"
    spanning_tree = "spanning_tree"
    chordal = "chordal"


class ObjectiveChoice(StrEnum):
    """What is minimised."""

    logarithm = "logarithm"
    chordal = "chordal"


class RobustChoice(StrEnum):
    """How false loop closures are dealt with."""

    none = "none"
    gnc = "gnc"


class RotationErrorChoice(StrEnum):
    """What the rotation part of a 3D information matrix refers to."""

    rotation_vector = "rotation_vector"
    quaternion = "quaternion"


class CrossBlockChoice(StrEnum):
    """How the block between translation and rotation is read."""

    auto = "auto"
    as_g2o = "upper"
    transposed = "transposed"
    dropped = "dropped"


_CROSS_BLOCKS = {
    "auto": "ordered as g2o has it, or transposed where only that is semi-definite (a warning says so)",
    "upper": "ordered as g2o has it",
    "transposed": "transposed",
    "dropped": "left out",
}


def pgo(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Pose graph in g2o's or TORO's format, 2D or 3D.")],
    output: OutputOption = None,
    start: Annotated[
        StartChoice, typer.Option("--start", help="Where to start; auto: the cheaper of the file's poses and the chordal start.")
    ] = StartChoice.auto,
    loss: LossOption = "none",
    objective: Annotated[
        ObjectiveChoice,
        typer.Option("--objective", help="logarithm: the error Log(Z⁻¹ Ti⁻¹ Tj) with its information; chordal: that of SE-Sync."),
    ] = ObjectiveChoice.logarithm,
    robust_choice: Annotated[
        RobustChoice,
        typer.Option("--robust", help="gnc: tell false loop closures from true ones (graduated non-convexity), and refuse them."),
    ] = RobustChoice.none,
    certify: Annotated[
        bool, typer.Option("--certify", help="Whether the minimum is the global one; with --objective chordal, which it is of.")
    ] = False,
    rotation_error: Annotated[
        RotationErrorChoice,
        typer.Option(
            "--rotation-error", help="What 3D rotation information in the file refers to; quaternion: g2o's half angles."
        ),
    ] = RotationErrorChoice.rotation_vector,
    cross_block: Annotated[
        CrossBlockChoice,
        typer.Option("--cross-block", help="How the block between translation and rotation of 3D information is read."),
    ] = CrossBlockChoice.auto,
    ignore_unknown: Annotated[
        bool, typer.Option("--ignore-unknown", help="Leave out lines that are no poses or edges, and count them.")
    ] = False,
    method: MethodOption = MethodChoice.levenberg_marquardt,
    linear_solver: LinearSolverOption = LinearSolverChoice.auto,
    max_iterations: MaxIterationsOption = 100,
    time_limit: TimeLimitOption = None,
    threads: ThreadsOption = None,
    view: ViewOption = None,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Find the poses that agree best with the relative poses measured between them.

    The result is written in the format of the input, and as graph.ply (poses and edges). Exit codes: 0 done, 1 the problem does
    not determine its variables or the results could not be written, 2 bad input, 3 done but not to be trusted (likely not
    the global minimum, edges that contradict each other, a file that means something else), 130 interrupted (results up to there
    are complete).
    """
    with uncollected():
        from boxplus.cli.optimization.terminal import OptimizationTerminal
        from boxplus.cli.terminal.interrupt import stop_on_interrupt
        from boxplus.cli.terminal.outcome import reported
        from boxplus.formats.graphs.pose_graph_file import graph_format, read_pose_graph, write_pose_graph
        from boxplus.runs.storage.output_folder import output_folder
        from boxplus.systems.pose_graph.pose_graph import PoseGraphConfig, optimize_pose_graph
        from boxplus.systems.pose_graph.problem import positions

    started, terminal = datetime.now(UTC), OptimizationTerminal(quiet=quiet, as_json=as_json)
    robust = parse_loss(loss)
    _check_choices(objective, robust_choice, None if robust is None else loss, certify=certify)
    config = PoseGraphConfig()
    config = config.model_copy(
        update={
            "start": start.value,
            "objective": objective.value,
            "robust": robust_choice.value,
            "certify": certify,
            "solver": solver_options(config.solver, method, linear_solver, max_iterations, time_limit, threads),
        }
    )
    folder = output or Path(f"{file.resolve().stem}_boxplus")
    with reported(file, folder, as_json=as_json) as outcome, ExitStack() as stack:
        with terminal.status("reading"):
            if file.is_dir():
                raise InputError("a pose graph file, g2o or TORO", f"the folder {file}", "give a file in it")
            kind = graph_format(file)
            with saying(POSE_GRAPH):
                graph = read_pose_graph(
                    file, rotation_error=rotation_error.value, cross_block=cross_block.value, ignore_unknown=ignore_unknown
                )
        shown = stack.enter_context(viewing("ProblemView", file.name, view))
        files, folders = _own_files(folder)
        stack.enter_context(output_folder(folder, "boxplus pgo", lambda: files, lambda: folders, overwrite=overwrite))
        name = "optimized.g2o" if kind == "g2o" else "optimized.graph"
        described = (
            f"{'g2o' if kind == 'g2o' else 'TORO'}, {graph.dimension}D; {len(graph.ids):,} poses, {len(graph.edges):,} edges"
        )
        terminal.facts(file.name, described, robust)
        for warning in graph.warnings:
            terminal.warn(warning)
        if shown is not None and graph.poses is not None:
            shown.show_graph(False, positions(graph, graph.poses), graph.edges)
        with stop_on_interrupt(terminal.announce_stop) as should_stop, terminal.steps(method, should_stop) as show:
            result = optimize_pose_graph(graph, config, loss=robust, callback=show)
            stopped = should_stop()
        if shown is not None and result.graph.poses is not None:
            shown.show_graph(True, positions(graph, result.graph.poses), graph.edges)
        reading = {"rotation_error": rotation_error.value, "cross_block": cross_block.value} if graph.dimension == 3 else {}
        summary = _summary(file, name, started, graph, result, config, robust, reading, stopped)
        write_pose_graph(folder / name, result.graph, kind, rotation_error=rotation_error.value)
        _write_graph_ply(folder / "graph.ply", result.graph)
        if not no_report:
            with outcome.drawing(terminal):
                from boxplus.report.optimization.graph_report import write_graph_report

                write_graph_report(folder, summary, graph, result)
        if result.loops is not None or robust is not None:
            _write_edges(folder / "edges.csv", graph, result)
        terminal.conclude(summary, "σ", folder, ["report.html", name, "graph.ply", "edges.csv"], outcome)


def _check_choices(objective: ObjectiveChoice, robust: RobustChoice, loss: str | None, *, certify: bool) -> None:
    """What `optimize_pose_graph` refuses, said in the words of the command line, and before the file is read."""
    others = [f"--loss {loss}"] if loss is not None else []
    if robust is not RobustChoice.none:
        if objective is ObjectiveChoice.chordal:
            others.append("--objective chordal")
        if others:
            raise InputError("--robust gnc alone, which has a loss of its own", " and ".join(others), "leave one of them out")
    if certify:
        others += [] if robust is RobustChoice.none else ["--robust gnc"]
        others += ["--objective logarithm"] if objective is not ObjectiveChoice.chordal else []
        if others:
            raise InputError(
                "--certify with --objective chordal, of which alone optimality can be certified, and without a robust loss",
                " and ".join(others),
                "say --objective chordal --certify, without --loss and --robust; or leave --certify out",
            )


def _own_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files and folders that this command writes."""
    from boxplus.runs.optimization_summary import PLOTS

    files = [folder / name for name in ("report.html", "optimized.g2o", "optimized.graph", "graph.ply", "edges.csv", "run.json")]
    return files + [folder / "plots" / name for name in PLOTS], [folder / "plots"]


def _convention(graph: PoseGraph, config: PoseGraphConfig, loss: Loss | None, reading: dict[str, str]) -> str:
    inner = (
        "eᵀ Ω e with e = Log(Z⁻¹ Ti⁻¹ Tj), Ω in the order rotation, translation"
        if config.objective == "logarithm"
        else "κ ‖Rj − Ri Rij‖² + τ ‖tj − ti − Ri tij‖², the objective of SE-Sync"
    )
    text = f"χ² = Σ {inner}; cost ½ Σ {f'ρ of it, ρ {loss!r}' if loss else 'of it, ½ χ²'}"
    if not reading:
        return text
    taken = "the full rotation vector" if reading["rotation_error"] == "rotation_vector" else "g2o's half angles"
    return f"{text}; rotation information of the file taken for {taken}, its cross block {_CROSS_BLOCKS[reading['cross_block']]}"


def _fit(result: PoseGraphResult) -> str:
    return result.fit.sentence if result.checks is None or result.fit.dof == 0 else f"{result.fit.sentence}; {result.checks}"


def _summary(
    file: Path,
    output: str,
    started: datetime,
    graph: PoseGraph,
    result: PoseGraphResult,
    config: PoseGraphConfig,
    loss: Loss | None,
    reading: dict[str, str],
    stopped: bool,
) -> OptimizationSummary:
    from boxplus.cli.optimization.terminal import summary_of
    from boxplus.runs.optimization_summary import ErrorFacts

    return summary_of(
        result.solution,
        config,
        loss,
        stopped,
        reading,
        program="boxplus pgo",
        started=started,
        input=str(file),
        output=output,
        sizes={"poses": len(graph.ids), "edges": len(graph.edges), "held": len(result.held)},
        convention=_convention(graph, config, loss, reading),
        start=result.start_reason,
        chi2_initial=float((result.errors_before**2).sum()),
        chi2=result.chi2,
        fit=_fit(result) if config.objective == "logarithm" else None,
        errors_initial=ErrorFacts.of(result.errors_before),
        errors=ErrorFacts.of(result.errors),
        loops=None if result.loops is None else result.loops.report.sentence("loop closures"),
        certificate=None if result.certificate is None else result.certificate.sentence,
        doubt=result.doubt,
        notes=[*graph.warnings, *result.notes],
        timing_s={
            "start": result.timing_s["start"],
            "optimisation": result.timing_s["optimisation"],
            **result.solution.timing_s,
        },
        is_last_of_several=result.loops is not None or len(result.minima) > 1,
    )


def _write_edges(path: Path, graph: PoseGraph, result: PoseGraphResult) -> None:
    """Weight and error of every edge, in the order of the file."""
    from boxplus.formats.output import atomic_file
    from boxplus.systems.pose_graph.problem import consecutive_edges

    kinds = ("loop", "odometry")
    rows = zip(graph.ids[graph.edges], consecutive_edges(graph), result.weights, result.errors, strict=True)
    with atomic_file(path) as file:
        file.write(b"from,to,kind,weight,error_sigma\n")
        for (i, j), is_odometry, weight, error in rows:
            file.write(f"{i},{j},{kinds[int(is_odometry)]},{weight:.6g},{error:.6g}\n".encode())


def _write_graph_ply(path: Path, graph: PoseGraph) -> None:
    """Positions of the poses, and the edges between them; held poses in red."""
    import numpy as np

    from boxplus.formats.clouds.scene_ply import write_scene_ply
    from boxplus.systems.pose_graph.problem import positions
    from boxplus.systems.pose_graph.start import held_poses

    if graph.poses is None:
        return
    colors = np.tile(np.array([53, 104, 168], np.uint8), (len(graph.ids), 1))
    colors[held_poses(graph)] = (220, 40, 30)
    write_scene_ply(path, positions(graph, graph.poses), colors, graph.edges)
