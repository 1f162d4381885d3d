"""The field's own tool as an oracle: matches, pairs and figures, to the digits it prints; skipped where it is missing."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boxplus.evaluation.evaluation import Evaluation, evaluate
from boxplus.evaluation.rpe import Delta
from boxplus.formats.trajectory import read_trajectory, write_kitti, write_tum
from tests.evaluation.smooth_paths import SmoothPath, disturbed, moved

pytestmark = pytest.mark.slow

# evo keeps stamps as floats, 0.24 microseconds apart at today's dates: no stamp here lies that close to the middle of two.
PRINTED = 6e-7  # six decimals: half of the last one, and the rounding of two programs


def tool(name: str, *arguments: str) -> tuple[dict[str, float], str]:
    """Figures that evo prints for the same files, and all of its text."""
    program = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    if program is None:
        pytest.skip(f"{name} (pip install evo) is not there")
    text = subprocess.run([program, *arguments, "-v"], check=True, capture_output=True, text=True).stdout
    return {key: float(value) for key, value in re.findall(r"(rmse|mean|median|max|min|std)\s+([\d.]+)", text)}, text


def files(folder: Path, seed: int, estimate_hz: float, truth_hz: float) -> list[str]:
    """A ground truth and an estimate of the same path at other rates, jittered, disturbed, turned and scaled."""
    path, rng = SmoothPath(seed), np.random.default_rng(seed)
    truth = path.sample(np.arange(0.0, 28.0, 1.0 / truth_hz))
    times = np.arange(0.5, 27.0, 1.0 / estimate_hz)
    times = times + rng.uniform(-0.1, 0.1, len(times)) / estimate_hz
    turn = Rotation.from_rotvec(rng.normal(size=3))
    estimate = moved(disturbed(path.sample(times), seed), turn, np.array([1.0, 2.0, 3.0]), 1.1)
    names = [str(folder / "truth.tum"), str(folder / "estimate.tum")]
    write_tum(names[0], truth)
    write_tum(names[1], estimate)
    return names


def compared(names: list[str], **options: object) -> Evaluation:
    return evaluate(read_trajectory(names[1]), read_trajectory(names[0]), **options)


# Estimates sparser than the ground truth, denser, and about as dense (where a pose is matched twice).
@pytest.mark.parametrize(
    ("seed", "estimate_hz", "truth_hz"), [(0, 10.0, 100.0), (1, 100.0, 20.0), (2, 50.0, 40.0), (3, 4.0, 200.0)]
)
def test_figures_of_random_paths(tmp_path: Path, seed: int, estimate_hz: float, truth_hz: float) -> None:
    names = files(tmp_path, seed, estimate_hz, truth_hz)
    given = ("tum", *names, "--t_max_diff", "0.02")
    for flags, alignment in ((["-a"], "se3"), (["-as"], "sim3")):
        theirs, text = tool("evo_ape", *given, *flags)
        ours = compared(names, alignment=alignment)
        assert f"Found {len(ours.association)} of" in text
        assert {figure: getattr(ours.ate, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED)
    for delta, flags in (
        (Delta(1.0, "m"), ("-d", "1", "-u", "m")),
        (Delta(30.0, "deg"), ("-d", "30", "-u", "d")),
        (Delta(10, "frames"), ("-d", "10", "-u", "f")),
    ):
        for pairs, more in (("consecutive", ()), ("all", ("--all_pairs",))):
            theirs, text = tool("evo_rpe", *given, "-a", *flags, *more)
            (ours,) = compared(names, deltas=[delta], rpe_pairs=pairs).relative
            assert f"Compared {len(ours.pairs)} relative pose pairs" in text, (delta, pairs)
            assert {figure: getattr(ours.translation, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED)


def test_first_poses_origin_planes_and_radians(tmp_path: Path) -> None:
    names = files(tmp_path, 6, 10.0, 50.0)
    given = ("tum", *names, "--t_max_diff", "0.02")
    for flags, options in (
        (("-a", "--n_to_align", "80"), {"align_by_first": 80}),
        (("--align_origin",), {"alignment": "origin"}),
        (("-a", "--project_to_plane", "xy"), {"plane": "xy"}),
        (("-a", "--project_to_plane", "xz"), {"plane": "xz"}),
        (("-a", "--project_to_plane", "yz"), {"plane": "yz"}),
    ):
        theirs, _ = tool("evo_ape", *given, *flags)
        ours = compared(names, **options)
        assert {figure: getattr(ours.ate, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED), flags
    theirs, _ = tool("evo_ape", *given, "-a", "--project_to_plane", "xy", "-r", "angle_deg")
    ours = compared(names, plane="xy").ate_rotation
    assert {figure: getattr(ours, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED)
    flags = ("-d", "0.5", "-u", "r", "-r", "angle_deg", "--pairs_from_reference")
    theirs, text = tool("evo_rpe", *given, "-a", "--all_pairs", *flags)
    (turned,) = compared(
        names, deltas=[Delta(float(np.degrees(0.5)), "deg")], rpe_pairs="all", rpe_path_of="ground_truth"
    ).relative
    assert f"Compared {len(turned.pairs)} relative pose pairs" in text
    assert {figure: getattr(turned.rotation, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED)


@pytest.mark.parametrize(("delta", "flags"), [(Delta(1.0, "m"), ("-d", "1", "-u", "m")), (Delta(5, "frames"), ("-d", "5"))])
@pytest.mark.parametrize("pairs", ["consecutive", "all"])
def test_figures_of_recorded_paths(shared_data: Path, delta: Delta, flags: tuple[str, ...], pairs: str) -> None:
    folder = shared_data / "trajectories"
    truth, estimate = folder / "freiburg1_xyz-groundtruth.txt", folder / "freiburg1_xyz-rgbdslam.txt"
    more = ("--all_pairs",) if pairs == "all" else ()
    theirs, text = tool("evo_rpe", "tum", str(truth), str(estimate), "--t_max_diff", "0.02", "-a", *flags, *more)
    (ours,) = evaluate(read_trajectory(estimate), read_trajectory(truth), deltas=[delta], rpe_pairs=pairs).relative
    assert f"Compared {len(ours.pairs)} relative pose pairs" in text
    assert {figure: getattr(ours.translation, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED)


def test_files_without_stamps(tmp_path: Path) -> None:
    truth = SmoothPath(7).sample(np.arange(0.0, 28.0, 0.1))
    names = [str(tmp_path / "truth.txt"), str(tmp_path / "estimate.txt")]
    write_kitti(names[0], truth)
    write_kitti(names[1], disturbed(truth, 7))
    theirs, _ = tool("evo_ape", "kitti", *names, "-a")
    ours = compared(names).ate
    assert {figure: getattr(ours, figure) for figure in theirs} == pytest.approx(theirs, abs=PRINTED)
