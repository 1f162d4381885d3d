"""Every example is short and runs as it is."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "examples"
# The node needs ROS 2 to run by itself; test_ros2_node.py feeds it with messages.
EXAMPLES = sorted(path for path in FOLDER.glob("*.py") if path.stem != "ros2_node")

# What the output must say for the example to have shown what it is about.
SHOWS = {
    "bundle_adjustment": "before, 0.51 px after",
    "camera_calibration": "findings: none",
    "direct_odometry": "14 ok",
    "dynamic_kdtree": "after delete_box: 24668 (332 removed)",
    "evaluate_trajectory": "ATE rmse: 1.7",
    "incremental_slam": "of the whole problem solved anew 211.732",
    "least_squares_problem": "every fifth is wrong: [0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 55]",
    "line_bundle_adjustment": "after : end points are 0.2",
    "odometry_from_arrays": "position error:",
    "own_vio": "position error 0.",
    "own_residual": "hand_eye_batch: converged after",
    "pose_graph": "largest error: edge 250, 198",
    "sliding_window": "the window is off by 0.1",
    "read_recording": "19 scans, 401 IMU samples; left out: nothing",
}


def test_every_example_is_known() -> None:
    assert {example.stem for example in EXAMPLES} == set(SHOWS)


@pytest.mark.slow
@pytest.mark.parametrize("example", [pytest.param(path, id=path.stem) for path in EXAMPLES])
def test_example_runs(example: Path, tmp_path: Path) -> None:
    assert len(example.read_text(encoding="utf-8").splitlines()) <= (100 if example.stem == "own_vio" else 60)
    done = subprocess.run(
        [sys.executable, "-W", "error", str(example)], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert SHOWS[example.stem] in done.stdout
    assert not list(tmp_path.iterdir())  # leaves nothing behind


def test_the_page_of_own_vio_shows_its_code() -> None:
    script = next(example for example in EXAMPLES if example.stem == "own_vio")
    code = {line.strip() for line in script.read_text(encoding="utf-8").splitlines()}
    page = (script.parents[1] / "docs" / "own_vio.md").read_text(encoding="utf-8")
    shown = [line.strip() for block in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S) for line in block.splitlines()]
    assert len(shown) > 40 and not [line for line in shown if line not in code]


@pytest.mark.slow
def test_odometry_from_arrays_is_accurate(tmp_path: Path) -> None:
    script = next(example for example in EXAMPLES if example.stem == "odometry_from_arrays")
    output = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    line = next(line for line in output.splitlines() if line.startswith("position error:"))
    assert float(line.split()[2]) < 50.0  # mm
