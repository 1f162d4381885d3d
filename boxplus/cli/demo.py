"""`boxplus demo`: simulate a walk, run the odometry on it, compare with the exact ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import EXIT_INTERRUPTED

if TYPE_CHECKING:
    from boxplus.simulation.simulation import Simulation

_SCENARIO = "walk"


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the recording and the results.")] = Path("demo"),
    duration: Annotated[float | None, typer.Option(help="Only the first seconds of the walk [s].", min=5.0)] = None,
) -> None:
    """Simulate a walk, run the odometry on it and compare with the truth; ends with accuracy, speed and the report.

    The recording is kept and used again by the next call.
    """
    import os

    from boxplus.cli.lidar.lio import run
    from boxplus.cli.options import without_report
    from boxplus.cli.terminal.outcome import reported
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.formats.trajectory import read_trajectory
    from boxplus.runs.lidar_inertial.config import load_run_config
    from boxplus.runs.run_folder import RunFolder
    from boxplus.simulation.simulation import simulate

    name = _SCENARIO if duration is None else f"{_SCENARIO}_{duration:g}s"
    recording = output / name
    _provide(simulate(_SCENARIO, duration_s=duration), recording)
    results = RunFolder(output / f"{name}_results")
    report = not without_report(False)
    threads = {"threads": min(2, os.cpu_count() or 1)}
    settings = load_run_config(overrides={"odometry": threads})
    with reported(recording, results.path, as_json=False) as outcome:
        summary, _ = run(recording, results.path, settings, outcome, overwrite=True, report=report)
    if summary.state != "finished":
        raise typer.Exit(EXIT_INTERRUPTED)
    truth = output / f"{name}.gt.tum"
    evaluation = evaluate(read_trajectory(results.trajectory), read_trajectory(truth, "tum"), method="interpolate")
    scan, factor = summary.timing.scan_ms, summary.timing.real_time_factor
    error_cm = 100.0 * evaluation.ate.rmse
    typer.echo("")
    error_deg = evaluation.ate_rotation.rmse
    typer.echo(f"accuracy  {error_cm:.2f} cm position, {error_deg:.3f} deg rotation (rms) over {summary.path_length_m:.0f} m")
    if scan is not None:
        typer.echo(f"speed     {scan.median:.1f} ms per scan (median), {factor:.1f} × real time with reading and writing")
    if report:
        typer.echo(f"report    {results.report}")


def _provide(simulation: Simulation, recording: Path) -> None:
    """Write the recording, unless the same one is already there."""
    from boxplus.cli.terminal.console import make_console
    from boxplus.simulation.recording_writer import write_recording

    parameters = Path(f"{recording}.json")  # written last
    wanted = simulation.config.model_dump_json(indent=2)
    if parameters.is_file() and parameters.read_text(encoding="utf-8") == wanted:
        typer.echo(f"{recording}: simulated before, used again")
        return
    with make_console().status(f"simulating {recording.name}") as status:
        write_recording(simulation, recording, progress=lambda share: status.update(f"simulating {recording.name}: {share:.0%}"))
    typer.echo(f"{recording}: {simulation.scan_count} scans simulated")
