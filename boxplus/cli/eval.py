"""`boxplus eval`: how good are estimated trajectories."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from boxplus.cli.terminal.own_words import EVALUATION, evaluation_in_options, saying
from boxplus.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from boxplus.evaluation.against_fixes import FixComparison
    from boxplus.evaluation.alignment import PositionAlignment
    from boxplus.evaluation.evaluation import Evaluation
    from boxplus.evaluation.frames import Plane
    from boxplus.evaluation.rpe import Delta, Unit
    from boxplus.formats.trajectory import Trajectory

_SAME_COSINES = 2.9988  # trace of a rotation by less than 2 degrees, which is told of no body frame


class _Alignment(StrEnum):
    se3 = "se3"
    sim3 = "sim3"
    yaw = "yaw"
    origin = "origin"
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


class _Path(StrEnum):
    estimate = "estimate"
    truth = "truth"


class _Plane(StrEnum):
    xy = "xy"
    xz = "xz"
    yz = "yz"


@saying(EVALUATION)
def evaluate_command(
    estimates: Annotated[
        list[Path],
        typer.Argument(help="Estimated trajectories: TUM, KITTI, EuRoC or boxplus CSV, or folders of runs.", metavar="ESTIMATE…"),
    ],
    ground_truth: Annotated[
        Path,
        typer.Argument(help="In any of these formats, or a recording with positions by satellite; last.", metavar="GROUND_TRUTH"),
    ],
    align: Annotated[
        _Alignment | None,
        typer.Option(help="Transform of the estimate onto the ground truth; default: se3, onto positions by satellite yaw."),
    ] = None,
    n_to_align: Annotated[
        int | None, typer.Option(help="Align by so many matched poses at the beginning.", metavar="N", min=3)
    ] = None,
    project_to_plane: Annotated[
        _Plane | None, typer.Option(help="Compare in this plane of the ground truth's frame, after the alignment.")
    ] = None,
    transform_right: Annotated[
        str | None,
        typer.Option(
            help="Ground truth of another body frame: pose of the estimate's body in it, in the forms of --T-imu-lidar of "
            "'boxplus lio', such as 'xyz: 0 0.3 1.2', or a JSON file of evo.",
            metavar="POSE",
        ),
    ] = None,
    transform_left: Annotated[
        str | None, typer.Option(help="Ground truth of another world frame: pose of that in the one wanted.", metavar="POSE")
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
    rpe_turn: Annotated[float, typer.Option(help="Turn of a relative error [deg]; 0 leaves it out.")] = 0.0,
    rpe_frames: Annotated[int, typer.Option(help="Matched poses of a relative error; 0 leaves it out.")] = 0,
    rpe_path: Annotated[_Path, typer.Option(help="Whose path and turns say where a pair ends.")] = _Path.estimate,
    rpe_pairs: Annotated[_Pairs, typer.Option(help="Pairs one after the other, or one from every pose.")] = _Pairs.consecutive,
    format: Annotated[_Format, typer.Option(help="Format of the estimates.")] = _Format.auto,
    ground_truth_format: Annotated[_Format, typer.Option(help="Format of the ground truth.")] = _Format.auto,
    gnss_topic: Annotated[str, typer.Option(help="Topic of positions by satellite in a bag; auto: the only one.")] = "auto",
    gnss_lever_arm: Annotated[
        str | None, typer.Option("--gnss-lever-arm", help="Antenna in the frame of the estimate's body, x,y,z [m].")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Folder to draw pictures into.", metavar="DIR")] = None,
    save_aligned: Annotated[
        Path | None,
        typer.Option(help="Folder for the whole estimates and the ground truth in one frame and on one clock.", metavar="DIR"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Compare estimated trajectories with the ground truth: association, ATE and RPE.

    Of one estimate the association report comes first; several come in one table and one plot. Comparisons that mean nothing
    (too few matches, no overlap in time, another unit, positions that do not determine the alignment) are refused with the
    reason. Against a bag with positions by satellite, a KITTI raw folder or its oxts, places alone are compared; --align none
    takes the origin from the estimate's georeference.yaml.
    """
    from boxplus.evaluation.comparison import compare, short_names
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.evaluation.frames import projected, transformed
    from boxplus.formats.trajectory import read_trajectory
    from boxplus.recordings.gnss_source import holds_fixes
    from boxplus.runs.transform import parse_transform

    paths = [_trajectory_file(path) for path in estimates]
    if holds_fixes(ground_truth):
        beside: dict[str, object] = {
            "--n-to-align": n_to_align,
            "--project-to-plane": project_to_plane,
            "--transform-right": transform_right,
        }
        beside |= {"--transform-left": transform_left, "--plot": plot, "--save-aligned": save_aligned, "another one": paths[1:]}
        for name in (name for name, value in beside.items() if value):
            raise InputError("one estimate, its places alone, against positions by satellite", name, "leave it out")
        estimated = read_trajectory(paths[0], format.value)
        comparison = _against_fixes(paths[0], estimated, ground_truth, gnss_topic, gnss_lever_arm, align, offset, min_matches)
        typer.echo(json.dumps(comparison.to_dict(), indent=2) if as_json else comparison.summary())
        return
    left = None if transform_left is None else parse_transform(transform_left, "--transform-left", key=None)
    right = None if transform_right is None else parse_transform(transform_right, "--transform-right", key=None)
    truth = transformed(read_trajectory(ground_truth, ground_truth_format.value), left=left, right=right)
    plane: Plane | None = None if project_to_plane is None else project_to_plane.value
    deltas = _deltas(rpe_distance, rpe_time, rpe_turn, rpe_frames)

    @saying(EVALUATION)
    def one(estimate: Trajectory) -> Evaluation:
        found = evaluation_in_options(
            evaluate(
                estimate,
                truth,
                alignment="se3" if align is None else align.value,
                method="interpolate" if interpolate else "nearest",
                max_difference_s=max_diff,
                offset_s=offset,
                max_gap_s=max_gap,
                min_matches=min_matches,
                align_by_first=n_to_align,
                plane=plane,
                deltas=deltas,
                rpe_pairs=rpe_pairs.value,
                rpe_path_of="ground_truth" if rpe_path is _Path.truth else "estimate",
            )
        )
        return found if right is None else replace(found, warnings=tuple(_with_given(text, right) for text in found.warnings))

    shown_truth, written = projected(truth, plane), []
    names = short_names(estimates)
    read, unread = {}, {}
    for name, path in zip(names, paths, strict=True):
        try:
            read[name] = read_trajectory(path, format.value)
        except InputError as error:
            if len(paths) == 1:
                raise
            unread[name] = str(error)
    if len(paths) == 1:
        evaluation = one(read[names[0]])
        evaluations = {names[0]: evaluation}
        typer.echo(json.dumps(evaluation.to_dict(), indent=2) if as_json else evaluation.summary())
        if plot is not None:
            from boxplus.evaluation.plots import write_plots

            written += write_plots(evaluation, plot, read[names[0]], shown_truth)
    else:
        several = compare(read, one, unread)
        evaluations, unread = several.evaluations, several.refused
        typer.echo(json.dumps(several.to_dict(), indent=2) if as_json else several.summary())
        if plot is not None and evaluations:
            from boxplus.evaluation.comparison_plots import write_comparison_plots

            written += write_comparison_plots(several, plot, shown_truth)
    if save_aligned is not None:
        written += _save(save_aligned, {name: (evaluations[name], read[name]) for name in evaluations}, shown_truth)
    for path in written:
        typer.echo(f"wrote {path}", err=True)
    if unread:
        raise InputError(f"{len(paths)} estimates that can be compared", f"{len(unread)} that cannot", "see the reasons above")


def _trajectory_file(path: Path) -> Path:
    """The file itself, or the trajectory in the folder of a run."""
    from boxplus.recordings.gnss_source import holds_fixes

    if path.is_dir() and (path / "trajectory.tum").is_file():
        return path / "trajectory.tum"
    if holds_fixes(path):
        raise InputError(
            "estimated trajectories first, the ground truth last",
            f"{path}, a {'folder without trajectory.tum' if path.is_dir() else 'recording'}, as an estimate",
            "give the trajectory itself; a recording with positions comes last: boxplus eval TRAJECTORY RECORDING",
        )
    return path


def _with_given(warning: str, right: NDArray[np.float64]) -> str:
    """The warning with another pose of the body that it gives put together with the one (4, 4) that was given."""
    from boxplus.runs.transform import parse_transform, transform_text

    def together(found: re.Match[str]) -> str:
        T = right @ parse_transform(found[1], "--transform-right", key=None)
        is_none = T[:3, :3].trace() > _SAME_COSINES and (T[:3, 3] ** 2).sum() < 0.01 * max((right[:3, 3] ** 2).sum(), 1e-4)
        return "--transform-right left out" if is_none else f"--transform-right '{transform_text(T)}' in place of the one given"

    return re.sub(r"--transform-right '([^']+)'", together, warning)


def _deltas(distance_m: float, time_s: float, turn_deg: float, frames: int) -> list[Delta]:
    from boxplus.evaluation.rpe import Delta

    asked: tuple[tuple[float, Unit], ...] = ((distance_m, "m"), (time_s, "s"), (turn_deg, "deg"), (frames, "frames"))
    return [Delta(value, unit) for value, unit in asked if value]


def _save(folder: Path, evaluated: dict[str, tuple[Evaluation, Trajectory]], truth: Trajectory) -> list[Path]:
    """All poses of the estimates as they were compared, and the ground truth; KITTI where there are no stamps."""
    from boxplus.formats.output import make_folder
    from boxplus.formats.trajectory import write_kitti, write_tum

    make_folder(folder)
    moved = {f"{name.replace('/', '_')}.aligned": found.brought(estimate) for name, (found, estimate) in evaluated.items()}
    written = []
    for name, trajectory in {**moved, "ground_truth": truth}.items():
        stamped = trajectory.time_ns is not None
        written.append(folder / f"{name}.{'tum' if stamped else 'kitti.txt'}")
        (write_tum if stamped else write_kitti)(written[-1], trajectory)
    return written


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
    from boxplus.sensors.satellites.gnss import antenna_offset

    if align is _Alignment.origin:
        raise InputError("--align yaw, se3, sim3 or none, for positions by satellite", "origin", "a fix has no orientation")
    kind = cast("PositionAlignment", "yaw" if align is None else align.value)
    return compare_with_fixes(
        estimated,
        read_fixes(recording, topic),
        alignment=kind,
        lever_arm=None if lever_arm is None else antenna_offset(lever_arm),
        frame=read_origin(path.parent) if align is _Alignment.none else None,
        offset_s=offset,
        min_matches=min_matches,
    )
