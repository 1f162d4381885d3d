"""`boxplus refine`: a finished run of LiDAR-inertial odometry, optimised as a whole."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from boxplus.cli.options import (
    RESULTS,
    SETTINGS,
    ConfigOption,
    GroundTruthOption,
    JsonOption,
    NoMapOption,
    NoReportOption,
    OverwriteOption,
    QuietOption,
    SettingsOption,
    ThreadsOption,
    default_threads,
)

if TYPE_CHECKING:
    from boxplus.cli.ground_truth import Comparison
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.formats.trajectory import Trajectory
    from boxplus.runs.refinement.refine_run import RefineResult
    from boxplus.runs.refinement.summary import RefineSummary


def refine_command(
    run: Annotated[Path, typer.Argument(help="The output folder of 'boxplus lio', or of 'boxplus slam'.", metavar="RUN")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the results; default: RUN_refined beside it.", rich_help_panel=RESULTS),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option("--recording", help="The recording, if it is not where it was when RUN was made.", rich_help_panel=SETTINGS),
    ] = None,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    threads: ThreadsOption = None,
    ground_truth: GroundTruthOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    no_map: NoMapOption = False,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Refine a finished run: all its poses, the planes they see and the IMU samples between them, at once.

    The recording is read once more. Trajectory and map are written anew where points that took no part then lie nearer to their
    planes than before; where they do not, the trajectory stays that of the run, and run.json and the report say so. Exit codes: 0
    done, accepted or not, 1 the results could not be written, 2 bad input, 3 poses moved farther than the covariance of the run
    allows, 130 interrupted (nothing was refined).
    """
    from boxplus.runs.refinement.config import load_refine_config

    overrides: dict[str, dict[str, object]] = {
        "refinement": {} if threads is None else {"threads": threads},
        "map": {"save": False} if no_map else {},
    }
    run_config = load_refine_config(config, settings or (), overrides)
    if "threads" not in run_config.refinement.model_fields_set:
        both = {"threads": default_threads()}
        run_config = run_config.model_copy(update={"refinement": run_config.refinement.model_copy(update=both)})
    folder = output or Path(f"{run.resolve()}_refined")

    from boxplus.cli.ground_truth import read_ground_truth
    from boxplus.cli.terminal.interrupt import stop_on_interrupt
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.runs.refinement.folder import claim_refine_folder
    from boxplus.runs.refinement.refine_run import read_odometry_run, refine_run
    from boxplus.runs.run_loop import Progress

    terminal = RunTerminal(quiet=quiet, as_json=as_json)
    with reported(run, folder, as_json=as_json) as outcome:
        truth = read_ground_truth(ground_truth)
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
                    progress=lambda stage, share: progress(Progress(share, 0, "scans", "", stage=stage)),
                    should_stop=should_stop,
                )
            summary, comparison = result.summary, None
            if truth is not None and summary.state == "finished":
                summary, comparison = _compared(result, truth)
                summary.write(claimed.summary)
            if not no_report and summary.state == "finished":
                with outcome.drawing(terminal):
                    from boxplus.report.refinement_page import write_refinement_report

                    write_refinement_report(claimed.path, summary, result)
        if summary.state != "finished" and (earlier := claimed.takes_place_of) is not None:
            terminal.alarms.print(Text(f"{summary.verdict()}; the earlier refinement in {earlier} stays as it was", "yellow"))
        else:
            _print(terminal, summary, comparison, claimed.takes_place_of or folder)  # "." may be gone
        outcome.end(summary, summary.state, untrusted=summary.doubt is not None)
        outcome.compare(comparison)


def _compared(result: RefineResult, truth: Trajectory) -> tuple[RefineSummary, Comparison]:
    """Both trajectories with the ground truth; the run is as good where that is not possible."""
    from boxplus.cli.ground_truth import Comparison
    from boxplus.errors import InputError
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.formats.trajectory import Trajectory

    try:
        before, after = (
            evaluate(Trajectory(result.time_ns, T[:, 4:], T[:, :4]), truth, method="interpolate")
            for T in (result.T_before, result.T_after)
        )
    except InputError as error:
        return result.summary, Comparison("not compared, see the error", error=str(error))
    errors = {"ate_before_m": before.ate.rmse, "ate_after_m": after.ate.rmse}
    ratio = after.ate.rmse / before.ate.rmse if before.ate.rmse else float("nan")
    line = f"ATE {1e3 * before.ate.rmse:.2f} → {1e3 * after.ate.rmse:.2f} mm ({ratio:.2f}) as it was refined"
    return result.summary.model_copy(update=errors), Comparison(line, after.to_dict())


def _print(terminal: Terminal, summary: RefineSummary, comparison: Comparison | None, folder: Path) -> None:
    """The facts, the warnings and the files."""
    good = summary.accepted and summary.state == "finished"
    (terminal.console if good else terminal.alarms).print(Text(summary.verdict(), "green" if good else "yellow"))
    rows = []
    if summary.state == "finished":
        rows = [
            ("scans", f"{summary.scans}, in {summary.keyframes} keyframes, on {summary.planes} planes"),
            ("moved", f"{1e3 * summary.largest_shift_m:.1f} mm and {summary.largest_turn_deg:.3f} deg at most"),
            ("mounting", summary.extrinsic),
            ("time offset", summary.time_offset),
            *_outside(summary),
            *([] if comparison is None else [comparison.row]),
            ("time", ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in summary.seconds.items())),
        ]
    terminal.print_rows(rows)
    for warning in summary.warnings:
        terminal.warn(warning)
    if summary.doubt is not None:
        terminal.doubt(summary.doubt)
    terminal.print_files(folder, ("report.html", "trajectory.tum", "trajectory.csv", "map.ply", "run.json"))


def _outside(summary: RefineSummary) -> list[tuple[str, str]]:
    """Loops and positions by satellite."""
    rows = []
    if summary.loops:
        text = f"{summary.loops}, {summary.loops_told_by_planes} of them told better by planes that both visits see"
        rows.append(("loops", text))
    if (receiver := summary.receiver) is not None:
        text = f"{receiver.fixes} fixes; heading ± {receiver.heading_sigma_deg:.3f}°, place ± {receiver.position_sigma_m:.2f} m"
        rows.append(("satellites", text))
    return rows
