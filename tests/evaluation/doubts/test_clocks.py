"""Whether clocks are told apart as well as is said, and whether what is advised makes the errors as small as any offset does."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from boxplus.evaluation.clock_fit import ClockFit
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory, read_trajectory
from tests.evaluation.smooth_paths import SmoothPath, disturbed

FILES = {
    "hand": ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", slice(None)),
    "half": ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", slice(0, 400)),
    "car": ("KITTI_00_ORB.txt", "KITTI_00_gt.txt", slice(0, 1500)),
}


def _files(folder: Path, name: str) -> tuple[Trajectory, Trajectory]:
    """An estimate and its ground truth, as they were recorded; those without stamps were taken at 10 Hz."""
    first, second, rows = FILES[name]
    both = [read_trajectory(folder / file) for file in (first, second)]
    stamped = [poses if poses.time_ns is not None else replace(poses, time_ns=10**8 * np.arange(len(poses))) for poses in both]
    return stamped[0].select(np.arange(len(stamped[0]))[rows]), stamped[1]


def _late(poses: Trajectory, late_s: float) -> Trajectory:
    return replace(poses, time_ns=poses.times + round(1e9 * late_s), lines=None)


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.05, -0.08, 0.3])
@pytest.mark.parametrize("name", list(FILES))
def test_offsets_between_clocks_of_real_files_are_known_as_well_as_is_said(shared_data: Path, name: str, late_s: float) -> None:
    """Orientations and positions of such files contradict each other by 10 to 20 ms, which neither tells alone."""
    estimate, truth = _files(shared_data / "trajectories", name)
    late = _late(estimate, late_s)
    result = evaluate(late, truth, method="interpolate", alignment="sim3", deltas=())
    found = result.association.time_offset
    assert found is not None and abs(found.offset_s + late_s) < min(4.0 * found.deviation_s, 0.02)
    (told,) = (warning for warning in result.warnings if "the motions fit best with" in warning)
    advised = re.search(r"with --offset (\S+) the ATE is (\S+) m", told)
    assert advised is not None or "no offset is advised" in told
    errors = [
        evaluate(late, truth, method="interpolate", alignment="sim3", deltas=(), offset_s=offset_s).ate.rmse
        for offset_s in (0.0 if advised is None else float(advised[1]), *(np.linspace(-0.02, 0.02, 9) - late_s))
    ]
    assert errors[0] < 1.03 * min(errors[1:])
    assert advised is None or errors[0] == pytest.approx(float(advised[2]), rel=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_orientations_that_lag_behind_the_positions_are_no_sure_offset(seed: int) -> None:
    """By 20 ms, as of a filter; the noise of either signal shows a millisecond."""
    path = SmoothPath(seed)
    truth = path.sample(np.arange(0.0, 30.0, 0.01))
    t = np.arange(2.0, 28.0, 0.1)
    lagging = replace(path.sample(t), q_wxyz=path.sample(t - 0.02).q_wxyz)
    found = evaluate(disturbed(lagging, seed, 0.01, 0.002), truth, deltas=()).association.time_offset
    assert found is not None and {*found.signal.split(" and ")} == {"rotation", "translation"}
    for true_s in (0.0, -0.02):
        assert abs(found.offset_s - true_s) < 2.0 * found.deviation_s
    assert found.deviation_s < 0.02


def test_signals_that_agree_are_surer_together_and_those_far_apart_are_not_mixed() -> None:
    one, other, far = (ClockFit(at, 0.002, 0.9, name) for at, name in ((0.010, "a"), (0.012, "b"), (0.5, "b")))
    both = ClockFit.together([one, other])
    assert both is not None and both.offset_s == pytest.approx(0.011)
    assert both.deviation_s == pytest.approx(0.002 / np.sqrt(2.0))
    assert ClockFit.together([one, far]) is one
    assert ClockFit.together([]) is None
