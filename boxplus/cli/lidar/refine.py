"""`boxplus refine`: a finished run of LiDAR-inertial odometry, optimised as a whole."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import EXIT_INTERRUPTED
from boxplus.cli.options import NoReportOption

if TYPE_CHECKING:
    from boxplus.runs.refinement.refine_run import RefineResult
    from boxplus.runs.refinement.summary import RefineSummary


def refine_command(
    run: Annotated[Path, typer.Argument(help="The output folder of 'boxplus lio', or of 'boxplus slam'.", metavar="RUN")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the results; default: RUN_refined beside it.")
    ] = None,
    recording: Annotated[
        Path | None, typer.Option("--recording", help="The recording, if it is not where it was when RUN was made.")
    ] = None,
    gt: Annotated[Path | None, typer.Option("--gt", help="Ground truth: the errors before and after are reported.")] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file with settings, e.g. the config.yaml of a refined run.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="One setting, e.g. refinement.rounds=5; may be repeated.", metavar="KEY=VALUE"),
    ] = None,
    threads: Annotated[
        int | None, typer.Option("--threads", min=1, help="Threads; default 2. The result does not depend on it.")
    ] = None,
    no_map: Annotated[bool, typer.Option("--no-map", help="Write no map.")] = False,
    no_report: NoReportOption = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run.")] = False,
) -> None:
    """Refine a finished run: all its poses, the planes they see and the IMU samples between them, at once.

    The recording is read once more. Trajectory and map are written anew where points that took no part then lie nearer to their
    planes than before; where they do not, the trajectory stays that of the run, and run.json and the report say so. Exit codes: 0
    done, accepted or not, 1 the results could not be written, 2 bad input, 130 interrupted (nothing was refined).
    """
    from boxplus.runs.refinement.config import load_refine_config

    overrides: dict[str, dict[str, object]] = {
        "refinement": {"threads": threads if threads is not None else min(2, os.cpu_count() or 1)},
        "map": {"save": False} if no_map else {},
    }
    run_config = load_refine_config(config, settings or (), overrides)
    folder = output or Path(f"{run.resolve()}_refined")

    from boxplus.cli.interrupt import stop_on_interrupt
    from boxplus.cli.run_terminal import RunTerminal
    from boxplus.formats.trajectory import read_trajectory
    from boxplus.runs.refinement.folder import claim_refine_folder
    from boxplus.runs.refinement.refine_run import read_odometry_run, refine_run
    from boxplus.runs.run_loop import Progress

    terminal = RunTerminal()
    truth = read_trajectory(gt) if gt is not None else None
    odometry = read_odometry_run(run)  # before a folder is made
    with (
        stop_on_interrupt(terminal.announce_stop) as should_stop,
        claim_refine_folder(folder, run, overwrite=overwrite) as claimed,
    ):
        with terminal.progress() as progress:
            result = refine_run(
                odometry,
                claimed,
                run_config,
                recording=recording,
                progress=lambda stage, share: progress(Progress(share, odometry.summary.scans, "scans", stage, stage=stage)),
                should_stop=should_stop,
            )
        summary = result.summary
        if truth is not None and summary.state == "finished":
            from boxplus.evaluation.evaluation import evaluate
            from boxplus.formats.trajectory import Trajectory

            errors = []
            for T in (result.T_before, result.T_after):
                found = evaluate(Trajectory(result.time_ns, T[:, 4:], T[:, :4]), truth)
                errors.append(float((found.translation_error_m**2).mean() ** 0.5))
            summary = summary.model_copy(update={"ate_before_m": errors[0], "ate_after_m": errors[1]})
            summary.write(claimed.summary)
        if not no_report and summary.state == "finished":
            from boxplus.report.refinement_page import write_refinement_report

            with terminal.status("drawing the report"):
                write_refinement_report(folder, summary, result)
    _print(summary, result, folder)
    if summary.state == "interrupted":
        raise typer.Exit(EXIT_INTERRUPTED)


def _print(summary: RefineSummary, result: RefineResult, folder: Path) -> None:
    """The facts, the warnings and the files."""
    typer.secho(summary.verdict(), fg="green" if summary.accepted else "yellow")
    if summary.state == "finished":
        rows = [
            ("scans", f"{summary.scans}, in {summary.keyframes} keyframes, on {summary.planes} planes"),
            ("moved", f"{1e3 * summary.largest_shift_m:.1f} mm and {summary.largest_turn_deg:.3f} deg at most"),
            ("mounting", summary.extrinsic),
        ]
        if summary.ate_before_m is not None and summary.ate_after_m is not None:
            ratio = summary.ate_after_m / summary.ate_before_m if summary.ate_before_m else float("nan")
            rows.append(
                ("ATE", f"{1e3 * summary.ate_before_m:.2f} → {1e3 * summary.ate_after_m:.2f} mm ({ratio:.2f}) as it was refined")
            )
        rows.append(("time", ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in summary.seconds.items())))
        for name, text in rows:
            typer.echo(f"{name:10s}{text}")
    for warning in summary.warnings:
        typer.secho(f"warning: {warning}", fg="yellow")
    for name in ("report.html", "trajectory.tum", "trajectory.csv", "map.ply", "run.json"):
        if (folder / name).exists():
            typer.echo(f"  {folder / name}")
