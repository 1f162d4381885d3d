"""`boxplus calibrate cameras`: lenses, mountings and the place on an IMU from corners of a target."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.options import RESULTS, JsonOption, NoReportOption, OverwriteOption, QuietOption

if TYPE_CHECKING:
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.runs.camera_calibration.summary import CalibrationSummary


class LensChoice(StrEnum):
    """Kalibr's names of lenses."""

    auto = "auto"
    radtan = "pinhole-radtan"
    equi = "pinhole-equi"
    ds = "ds-none"


def cameras(
    corners: Annotated[
        Path,
        typer.Argument(
            metavar="CORNERS",
            help="Corners of the target: Basalt's detected_corners.json, or a CSV of time_ns,camera,corner,u,v.",
        ),
    ],
    target: Annotated[
        Path, typer.Option("--target", help="Kalibr's YAML of the AprilGrid; its tagSize [m] decides all lengths.")
    ],
    resolution: Annotated[str, typer.Option("--resolution", help="Of the images, such as 752x480; no corner file states it.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder for the results; named after the corners when not given.", rich_help_panel=RESULTS
        ),
    ] = None,
    lens: Annotated[
        LensChoice, typer.Option("--lens", help="Lens of the cameras; auto: the simplest that leaves the smallest residuals.")
    ] = LensChoice.auto,
    imu: Annotated[
        Path | None, typer.Option("--imu", help="IMU samples as EuRoC's data.csv; the corners then need times.")
    ] = None,
    imu_noise: Annotated[
        Path | None, typer.Option("--imu-noise", help="Kalibr's imu.yaml with the noise densities; needed with --imu.")
    ] = None,
    compare: Annotated[
        Path | None, typer.Option("--compare", help="Camchain of another calibration, to say how they differ.")
    ] = None,
    max_views: Annotated[
        int, typer.Option("--max-views", min=8, help="Frames used for lenses and mountings, evenly chosen.")
    ] = 80,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Lenses of cameras, how they are mounted to each other and on an IMU, from an AprilGrid that they saw.

    Writes camchain.yaml (Kalibr's form, which vio and inspect read), run.json (with covariances) and report.html. Exit codes: 0
    done, 1 the views do not determine a lens (no camchain is written), 2 bad input, 3 done but not to be trusted.
    """
    from boxplus.cli.optimization.terminal import versions
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.errors import InputError
    from boxplus.formats.output import atomic_file
    from boxplus.recordings.cameras.calibration import read_camchain
    from boxplus.runs.camera_calibration.camchain import camchain_text
    from boxplus.runs.camera_calibration.camchain import compare as compare_with
    from boxplus.runs.camera_calibration.corner_file import read_corner_file
    from boxplus.runs.camera_calibration.inputs import read_imu, read_target
    from boxplus.runs.camera_calibration.summary import (
        FILES,
        CalibrationSummary,
        FindingFacts,
        camera_facts,
        imu_facts,
        outliers,
        state_of,
    )
    from boxplus.runs.storage.output_folder import output_folder
    from boxplus.systems.camera_calibration.calibration import calibrate_cameras
    from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
    from boxplus.systems.camera_calibration.findings import Finding, judge

    started, terminal = datetime.now(UTC), Terminal(quiet=quiet, as_json=as_json)
    folder = output or Path(f"{corners.resolve().name.split('.')[0]}_calibration")
    with reported(corners, folder, as_json=as_json) as outcome, ExitStack() as stack:
        if (imu is None) != (imu_noise is None):
            raise InputError("both --imu and --imu-noise, or none", "one of them", "give samples and noise densities together")
        seen, board = read_corner_file(corners, _size(resolution)), read_target(target)
        inertial = None if imu is None or imu_noise is None else read_imu(imu, imu_noise)
        other = None if compare is None else (read_camchain(compare), compare.name)
        own = [folder / name for name in FILES]
        stack.enter_context(output_folder(folder, "boxplus calibrate cameras", lambda: own, list, overwrite=overwrite))
        samples, noise = (None, None) if inertial is None else (inertial.samples, inertial.noise)
        config = CameraCalibrationConfig(lens=lens.value, max_views=max_views)
        with terminal.working(f"calibrating {seen.cameras} cameras from {len(seen.pixels):,} corners") as show:
            found = calibrate_cameras(seen, board, config, imu=samples, noise=noise, on_progress=show)
        left_out = () if inertial is None else inertial.left_out
        findings = [*judge(found), *(Finding("imu_samples", "remark", text) for text in left_out)]
        summary = CalibrationSummary(
            program="boxplus calibrate cameras",
            versions=versions(),
            started=started,
            state=state_of(findings),
            input=str(corners),
            target=board.describe(),
            lens=found.lens,
            sigma_by_lens=found.sigma_by_lens,
            sigma_px=found.of_camera(0)[0].sigma_px,
            cameras=camera_facts(found),
            imu_input=[] if inertial is None else [*inertial.notes, *inertial.left_out],
            imu=imu_facts(found),
            outliers=outliers(found),
            compared=[] if other is None else compare_with(found, *other),
            findings=[FindingFacts.model_validate(asdict(finding)) for finding in findings],
        )
        _print(terminal, summary)
        if summary.state != "refused":
            with atomic_file(folder / "camchain.yaml") as file:
                file.write(camchain_text(found, summary, noise).encode())
        if not no_report:
            with outcome.drawing(terminal):
                from boxplus.report.cameras.calibration_report import write_calibration_report

                write_calibration_report(folder / "report.html", summary, found)
        summary.write(folder / "run.json")
        terminal.say(f"{folder}: {', '.join(name for name in FILES if (folder / name).exists())}")
        if summary.state == "refused":
            outcome.fall_short(summary, "the views do not determine a lens: no camchain.yaml")
        else:
            outcome.end(summary, untrusted=summary.state == "doubtful")


def _size(text: str) -> tuple[int, int]:
    from boxplus.errors import InputError

    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise InputError("a resolution such as 752x480", repr(text), "give width x height in pixels") from None
    return width, height


def _print(terminal: Terminal, summary: CalibrationSummary) -> None:
    from rich.table import Table
    from rich.text import Text

    from boxplus.errors import printable
    from boxplus.runs.camera_calibration.camchain import IMU_MOUNTING_DOUBTS

    table = Table(show_lines=False, pad_edge=False)
    for heading in ("camera", "parameter", "value", "standard deviation"):
        table.add_column(heading)
    for facts in summary.cameras:
        for name, value in facts.parameters.items():
            table.add_row(facts.name, name, f"{value:.6g}", f"{facts.sigmas[name]:.2g}")
        if facts.T_cn_cnm1 is not None and facts.mounting_sigma_m is not None and facts.mounting_sigma_deg is not None:
            position = ", ".join(f"{row[3] * 1e3:.3f}" for row in facts.T_cn_cnm1[:3])
            sigma = f"{1e3 * max(facts.mounting_sigma_m):.2g} mm, {max(facts.mounting_sigma_deg):.2g} deg"
            table.add_row(facts.name, "from the camera before", f"({position}) mm", sigma)
    if summary.imu is not None:
        shift = f"{summary.imu.timeshift_cam_imu_s * 1e3:+.3f} ms"
        table.add_row("imu", "timeshift_cam_imu", shift, f"{summary.imu.sigma_s * 1e3:.2g} ms")
        sigma = f"{1e3 * max(summary.imu.sigma_m):.2g} mm, {max(summary.imu.sigma_deg):.2g} deg"
        is_open = any(finding.code in IMU_MOUNTING_DOUBTS for finding in summary.findings)
        table.add_row("imu", "T_imu_cam0", "not written: see below" if is_open else "in camchain.yaml", sigma)
    terminal.console.print(table)
    rms = ", ".join(f"{facts.name} {facts.rms_px:.3f} px in {facts.views} views" for facts in summary.cameras)
    terminal.say(f"{summary.lens}, rms {rms}; {len(summary.outliers)} corners left out")
    for text in summary.compared:
        terminal.say(text)
    for finding in summary.findings:
        remark = finding.severity == "remark"
        style = "yellow" if remark else "red"
        line = Text.assemble((f"{finding.severity}: ", style), printable(finding.text))
        (terminal.console if remark else terminal.alarms).print(line)
