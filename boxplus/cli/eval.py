"""`boxplus eval`: how good is an estimated trajectory."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from boxplus.evaluation.against_fixes import FixComparison
    from boxplus.formats.trajectory import Trajectory


class _Alignment(StrEnum):
    se3 = "se3"
    sim3 = "sim3"
    yaw = "yaw"
    none = "none"


class _Format(StrEnum):
    auto = "auto"
    tum = "tum"
    kitti = "kitti"
    euroc = "euroc"
    csv = "csv"


class _Pairs(StrEnum):
    consecutive = "consecutive"
    all = "all"


def evaluate_command(
    estimate: Annotated[Path, typer.Argument(help="Estimated trajectory: TUM, KITTI, EuRoC or boxplus CSV.", metavar="ESTIMATE")],
    ground_truth: Annotated[
        Path,
        typer.Argument(help="In any of these formats, or a recording with positions by satellite.", metavar="GROUND_TRUTH"),
    ],
    align: Annotated[
        _Alignment | None,
        typer.Option(help="Transform of the estimate onto the ground truth; default: se3, onto positions by satellite yaw."),
    ] = None,
    max_diff: Annotated[float, typer.Option(help="Largest stamp difference of a match [s].")] = 0.02,
    offset: Annotated[float, typer.Option(help="Added to the stamps of the estimate [s].")] = 0.0,
    interpolate: Annotated[
        bool, typer.Option("--interpolate", help="Interpolate the ground truth at the estimate's stamps.")
    ] = False,
    max_gap: Annotated[float, typer.Option(help="Longest gap of the ground truth to interpolate [s].")] = 0.25,
    min_matches: Annotated[int, typer.Option(help="Refuse to compare fewer matches.")] = 10,
    rpe_distance: Annotated[float, typer.Option(help="Distance of the relative error [m]; 0 leaves it out.")] = 10.0,
    rpe_time: Annotated[float, typer.Option(help="Time of the relative error [s]; 0 leaves it out.")] = 1.0,
    rpe_pairs: Annotated[_Pairs, typer.Option(help="Pairs one after the other, or one from every pose.")] = _Pairs.consecutive,
    format: Annotated[_Format, typer.Option(help="Format of the estimate.")] = _Format.auto,
    ground_truth_format: Annotated[_Format, typer.Option(help="Format of the ground truth.")] = _Format.auto,
    gnss_topic: Annotated[str, typer.Option(help="Topic of positions by satellite in a bag; auto: the only one.")] = "auto",
    gnss_lever_arm: Annotated[
        str | None, typer.Option("--gnss-lever-arm", help="Antenna in the frame of the estimate's body, x,y,z [m].")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Folder to draw pictures into.", metavar="DIR")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Compare an estimated trajectory with the ground truth: association, ATE and RPE.

    The association report comes first. Comparisons that mean nothing (too few matches, no overlap in time, another unit,
    positions that do not determine the alignment) are refused with the reason. Against a bag with positions by satellite, a
    KITTI raw folder or its oxts, places alone are compared; --align none takes the origin from the estimate's georeference.yaml.
    """
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.evaluation.rpe import Delta
    from boxplus.formats.trajectory import read_trajectory
    from boxplus.recordings.gnss_source import holds_fixes

    if holds_fixes(ground_truth):
        estimated = read_trajectory(estimate, format.value)
        comparison = _against_fixes(estimate, estimated, ground_truth, gnss_topic, gnss_lever_arm, align, offset, min_matches)
        typer.echo(json.dumps(comparison.to_dict(), indent=2) if as_json else comparison.summary())
        return
    estimated, truth = read_trajectory(estimate, format.value), read_trajectory(ground_truth, ground_truth_format.value)
    evaluation = evaluate(
        estimated,
        truth,
        alignment="se3" if align is None else align.value,
        method="interpolate" if interpolate else "nearest",
        max_difference_s=max_diff,
        offset_s=offset,
        max_gap_s=max_gap,
        min_matches=min_matches,
        deltas=([Delta(rpe_distance, "m")] if rpe_distance else []) + ([Delta(rpe_time, "s")] if rpe_time else []),
        rpe_pairs=rpe_pairs.value,
    )
    typer.echo(json.dumps(evaluation.to_dict(), indent=2) if as_json else evaluation.summary())
    if plot is not None:
        from boxplus.evaluation.plots import write_plots

        for path in write_plots(evaluation, plot, estimated, truth):
            typer.echo(f"drew {path}", err=True)


def _against_fixes(
    path: Path,
    estimated: Trajectory,
    recording: Path,
    topic: str,
    lever_arm: str | None,
    align: _Alignment | None,
    offset: float,
    min_matches: int,
) -> FixComparison:
    from boxplus.evaluation.against_fixes import compare_with_fixes
    from boxplus.recordings.gnss_source import read_fixes
    from boxplus.runs.slam.gnss_output import read_origin
    from boxplus.sensors.gnss import antenna_offset

    return compare_with_fixes(
        estimated,
        read_fixes(recording, topic),
        alignment="yaw" if align is None else align.value,
        lever_arm=None if lever_arm is None else antenna_offset(lever_arm),
        frame=read_origin(path.parent) if align is _Alignment.none else None,
        offset_s=offset,
        min_matches=min_matches,
    )
