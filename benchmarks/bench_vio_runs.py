"""Accuracy of visual-inertial odometry on recordings: two cameras, the first one alone, mountings and clock refined, lines.

    OPENBLAS_NUM_THREADS=1 python benchmarks/bench_vio_runs.py [--shared ../shared] [--only mh01] [--modes stereo mono refined]
    OPENBLAS_NUM_THREADS=1 python benchmarks/bench_vio_runs.py --modes lines [--rendered FOLDER]

The error is the root mean square of the position's after alignment by yaw and translation, from the start on; with one camera the
scale too is what was estimated, nothing is scaled for the alignment. How far it is off is told apart, by the factor of a
similarity that fits the path best. Mountings and clock are refined on `mh05_stereo` alone.

`lines` compares corners and lines with corners alone where there is little texture: on `mh05_stereo_low_texture`, and on two
recordings that `make_visual_recording.py` in the shared tools renders, in a minute and a half each, into the folder given, where
they are found again. A figure is deterministic on one machine; on others rounding may differ. No times are measured.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from bench_vio import HERE, RECORDINGS, TIMED, Files, files_of, frames, position_error, trajectory_of, with_pose
from metrics import Metric, run_as_script

from boxplus import read_trajectory
from boxplus.evaluation.evaluation import evaluate
from boxplus.systems.visual_inertial_odometry import VioConfig, VioEstimate

MODES = {
    "stereo": VioConfig(),  # type: ignore[call-arg]
    "mono": VioConfig(cameras="first"),  # type: ignore[call-arg]
    "refined": VioConfig(extrinsic_estimation=True, time_offset_estimation=True),  # type: ignore[call-arg]
    "lines": VioConfig(lines=True),  # type: ignore[call-arg]
}
REFINED, LITTLE_TEXTURE = ("mh05_stereo",), "mh05_low_texture"
RENDERED = {"mh05_low_32": ("MH_05_difficult", 35, 32), "v103_low_31": ("V1_03_difficult", 20, 31)}  # flight, first second, seed
BARS_CM = {("mh01", "stereo"): 0.6, ("mh01", "mono"): 1.5, ("v103_stereo", "stereo"): 1.0} | dict.fromkeys(
    [("mh05_stereo", "stereo"), ("mh05_stereo", "refined")], 0.8
)
SCALE_BAR, LINES_BAR = 2.0, 0.8


def measure(options: argparse.Namespace) -> list[Metric]:
    """Position error, and frames that are not `ok`, of every recording and mode."""
    metrics = []
    for name in options.only or [*RECORDINGS, *RENDERED]:
        if name in TIMED:
            metrics += _by_mode(name, [mode for mode in options.modes if mode != "lines"], options.shared)
        elif "lines" in options.modes:
            metrics += _with_lines(name, options)
    return metrics


def _by_mode(name: str, modes: list[str], shared: Path) -> list[Metric]:
    files, metrics = files_of(name, shared), []
    for mode in modes:
        if files is None or (mode == "refined" and name not in REFINED):
            continue
        known = with_pose(frames(files, MODES[mode])[0])
        title = f"vio_runs/{name}, {mode}"
        error = position_error(known, files)
        metrics.append(Metric(f"{title}: position error", error, "cm", bar=BARS_CM.get((name, mode)), tolerance=0.25))
        if mode == "mono":
            bar = SCALE_BAR if name == "mh01" else None
            metrics.append(Metric(f"{title}: scale error", _scale_error(known, files), "%", bar=bar, tolerance=1.0))
        flagged = sum(estimate.status != "ok" for estimate in known)
        metrics.append(Metric(f"{title}: flagged", 100.0 * flagged / len(known), "%", gated=False))
    return metrics


def _with_lines(name: str, options: argparse.Namespace) -> list[Metric]:
    """Corners and lines against corners alone; where they start, lines have no part in."""
    with tempfile.TemporaryDirectory() as temporary:
        kept = options.rendered or Path(temporary)
        files = _rendered(name, options.shared, kept) if name in RENDERED else files_of(name, options.shared)
        if files is None:
            return []
        both, corners = (with_pose(frames(files, MODES[mode])[0]) for mode in ("lines", "stereo"))
        if not corners or not both:
            print(f"vio_runs: no start in {name}", file=sys.stderr)
            return []
        errors = [position_error(known, files) for known in (both, corners)]
    title = f"vio_runs/{name}, lines"
    lost = sum(estimate.status == "lost" for estimate in both)
    weak = [100.0 * sum(estimate.status != "ok" for estimate in known) / len(known) for known in (both, corners)]
    return [
        Metric(f"{title}: position error", errors[0], "cm", "lower", LINES_BAR, "corners alone", errors[1], 0.25),
        Metric(f"{title}: lost", float(lost), "frames", bar=0.0, tolerance=0.0),
        Metric(f"{title}: flagged", weak[0], "%", opponent="corners alone", opponent_value=weak[1], gated=False),
    ]


def _scale_error(known: list[VioEstimate], files: Files) -> float:
    """By what share the path is too long or too short, as a similarity has it that fits it best [%]."""
    found = evaluate(trajectory_of(known), read_trajectory(files.truth), alignment="sim3", method="interpolate")
    return 100.0 * abs(1.0 / found.alignment.scale - 1.0)


def _rendered(name: str, shared: Path, folder: Path) -> Files | None:
    """A recording of low texture, rendered where it is not there yet; None, with a message, without the tool."""
    tool, out = shared / "tools" / "make_visual_recording.py", folder / name
    if not tool.exists():
        print(f"vio_runs: {tool} is not there, {name} is left out", file=sys.stderr)
        return None
    if not (out / "gt.tum").exists():
        flight, start, seed = RENDERED[name]
        data = shared / "data" / "imu" / flight
        command = [sys.executable, str(tool), "--imu", f"{data}.imu.csv", "--gt", f"{data}.gt.csv", "--out", str(out)]
        command += ["--start", str(start), "--seconds", "11", "--seed", str(seed), "--quality", "80", "--low-texture"]
        subprocess.run(command, check=True, stdout=sys.stderr)
    return Files(out, out / "gt.tum")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shared", type=Path, default=HERE.parent.parent / "shared")
    parser.add_argument("--only", nargs="*", choices=[*RECORDINGS, *RENDERED], help="recordings; all of them if left out")
    parser.add_argument("--modes", nargs="*", choices=list(MODES), default=list(MODES))
    parser.add_argument("--rendered", type=Path, help="where rendered recordings are kept; nowhere if left out")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
