"""Accuracy of visual-inertial odometry on recordings: two cameras, the first one alone, mountings and clock refined.

    OPENBLAS_NUM_THREADS=1 python benchmarks/bench_vio_runs.py [--shared ../shared] [--only mh01] [--modes stereo mono refined]

The error is the root mean square of the position's after alignment by yaw and translation, from the start on; with one camera the
scale too is what was estimated, nothing is scaled for the alignment. Mountings and clock are refined on `mh05_stereo` alone. A
figure is deterministic on one machine; on others rounding may differ. No times are measured.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench_vio import HERE, RECORDINGS, folder_of, frames, position_error
from metrics import Metric, run_as_script

from boxplus.systems.visual_inertial_odometry import VioConfig

MODES = {
    "stereo": VioConfig(),  # type: ignore[call-arg]
    "mono": VioConfig(cameras="first"),  # type: ignore[call-arg]
    "refined": VioConfig(extrinsic_estimation=True, time_offset_estimation=True),  # type: ignore[call-arg]
}
REFINED = ("mh05_stereo",)


def measure(options: argparse.Namespace) -> list[Metric]:
    """Position error, and frames that are not `ok`, of every recording and mode."""
    metrics = []
    for name in options.only or RECORDINGS:
        folder = folder_of(name, options.shared)
        for mode in options.modes:
            if folder is None or (mode == "refined" and name not in REFINED):
                continue
            estimates, _ = frames(folder, name, MODES[mode])
            known = [e for e in estimates if e.status != "starting"]
            flagged = sum(e.status != "ok" for e in known)
            title = f"vio_runs/{name}, {mode}"
            error = position_error(known, folder, name)
            metrics.append(Metric(f"{title}: position error", error, "cm", tolerance=0.25))
            metrics.append(Metric(f"{title}: flagged", 100.0 * flagged / len(known), "%", gated=False))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shared", type=Path, default=HERE.parent.parent / "shared")
    parser.add_argument("--only", nargs="*", choices=list(RECORDINGS), help="recordings; all of them if left out")
    parser.add_argument("--modes", nargs="*", choices=list(MODES), default=list(MODES))


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
