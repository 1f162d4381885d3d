"""`boxplus vo`: a recording of an RGB-D or a stereo camera in, a trajectory out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def vo(
    recording: Annotated[
        Path, typer.Argument(help="TUM RGB-D, 7-Scenes, KITTI or EuRoC folder, or a ROS bag, with depth or two cameras.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the results; default: RECORDING_boxplus here.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting, e.g. patches=400; may be repeated.", metavar="KEY=VALUE")
    ] = None,
    calibration: Annotated[Path | None, typer.Option("--calibration", help="Kalibr camchain; overrules the recording.")] = None,
    frame_rate: Annotated[
        float | None, typer.Option("--frame-rate-hz", help="Images a second, for folders without times [Hz].")
    ] = None,
    depth_unit: Annotated[float | None, typer.Option("--depth-unit-m", help="Metres of one count of a depth image [m].")] = None,
    start: Annotated[float, typer.Option("--start", help="Skip this much at the beginning [s].")] = 0.0,
    duration: Annotated[float | None, typer.Option("--duration", help="Read at most this much [s].")] = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option("--gt", help="Trajectory of the camera to compare with: TUM, KITTI, EuRoC or CSV.", metavar="FILE"),
    ] = None,
    no_report: Annotated[bool, typer.Option("--no-report", help="Draw no report.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run.")] = False,
) -> None:
    """Turn a recording of an RGB-D or a stereo camera into a trajectory of the camera.

    The world is the camera of the first frame. Exit codes: 0 done, 1 the results could not be written, 2 bad input, 3 finished,
    but not to be trusted (the view was lost), 130 interrupted (results up to there are complete).
    """
    import yaml
    from pydantic import ValidationError
    from rich.console import Console
    from rich.text import Text

    from boxplus.cli.run_terminal import stop_on_interrupt
    from boxplus.errors import InputError, printable
    from boxplus.recordings.cameras.open import open_camera_recording
    from boxplus.recordings.cameras.options import CameraRecordingOptions
    from boxplus.runs.direct_run import DirectRunConfig, claim_direct_folder, run_direct_odometry
    from boxplus.systems.direct_odometry.config import DirectOdometryConfig

    given: dict[str, object] = {}
    for setting in settings or ():
        key, equals, value = setting.partition("=")
        if not equals:
            raise InputError("a setting KEY=VALUE", f"{setting!r}", "write it as patches=400")
        given[key.strip()] = yaml.safe_load(value)
    try:
        config = DirectRunConfig(
            recording=CameraRecordingOptions(
                calibration=calibration, frame_rate_hz=frame_rate, depth_unit_m=depth_unit, start_s=start, duration_s=duration
            ),
            odometry=DirectOdometryConfig.model_validate(given),
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError("settings of 'boxplus vo'", f"{where}: {first['msg']}", "see docs/direct_odometry.md") from error
    folder, console = output or Path(f"{recording.resolve().stem}_boxplus"), Console(highlight=False)
    with (
        stop_on_interrupt(lambda: console.print("interrupted: finishing the files; Ctrl-C again stops at once")) as should_stop,
        open_camera_recording(recording, config.recording) as opened,
        claim_direct_folder(folder, overwrite=overwrite) as claimed,
    ):
        for finding in opened.info.evidence:
            if finding.verdict != "ok":
                console.print(Text(f"{finding.verdict}: {finding.key}: {printable(finding.text)}", "yellow"))
        with console.status("odometry") as shown:
            summary = run_direct_odometry(
                opened,
                claimed,
                config,
                progress=lambda share, frames, status: shown.update(f"{share:.0%}, {frames} frames, {status}"),
                should_stop=should_stop,
            )
        if not no_report and summary.frames:
            from boxplus.report.direct_report import write_direct_report

            write_direct_report(claimed, summary)
    trusted = summary.state == "finished" and summary.contradiction is None
    console.print(Text(printable(summary.describe_state()), "green" if trusted else "yellow"))
    counts = ", ".join(f"{count} {name}" for name, count in sorted(summary.status.items()))
    console.print(f"frames       {summary.frames} ({counts}), {summary.keyframes} keyframes")
    console.print(f"path length  {summary.path_length_m:.2f} m in {summary.duration_s:.1f} s")
    if summary.frame_ms is not None:
        ms = summary.frame_ms
        console.print(f"per frame    median {ms['median']:.1f} ms, mean {ms['mean']:.1f} ms, 99th percentile {ms['p99']:.1f} ms")
    for warning in summary.warnings[:8]:
        console.print(Text.assemble(("warning: ", "yellow"), printable(warning)))
    if ground_truth is not None and summary.frames:
        from boxplus.evaluation.evaluation import evaluate
        from boxplus.formats.trajectory import read_trajectory

        console.print(evaluate(read_trajectory(folder / "trajectory.csv"), read_trajectory(ground_truth)).summary(), markup=False)
    for name in ("report.html", "trajectory.tum", "trajectory.csv", "frames.csv", "run.json"):
        if (folder / name).exists():
            console.print(f"  {folder / name}", soft_wrap=True, markup=False)
    if summary.state == "interrupted":
        raise typer.Exit(130)
    if summary.contradiction is not None:
        raise typer.Exit(3)
