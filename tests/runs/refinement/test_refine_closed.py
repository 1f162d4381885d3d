"""`boxplus refine` on the folder of `boxplus slam`: from where closed loops and satellites put the run, and held by them."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from boxplus.errors import InputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings import open_recording
from boxplus.runs.refinement.closed_run import read_closed_run
from boxplus.runs.refinement.folder import claim_refine_folder
from boxplus.runs.refinement.refine_run import RefineResult, read_odometry_run, refine_run
from boxplus.runs.slam.config import load_slam_config
from boxplus.runs.slam.gnss_output import read_origin
from boxplus.runs.slam.slam_run import run_slam
from boxplus.simulation.live_recording import GNSS_ORIGIN
from boxplus.simulation.recording_writer import write_recording
from tests.runs.slam.test_slam_run import RECEIVER, SETTINGS, round_a_block
from tests.systems.slam.drives import ate


@dataclass(frozen=True)
class Refined:
    bag: Path
    slam: Path
    folder: Path
    result: RefineResult


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> Refined:
    base = tmp_path_factory.mktemp("closed")
    bag = write_recording(round_a_block(), base / "block", "ros1", gnss=RECEIVER)
    with open_recording(bag) as recording:
        run_slam(recording, base / "slam", load_slam_config(settings=SETTINGS))
    with claim_refine_folder(base / "out", base / "slam") as claimed:
        result = refine_run(read_odometry_run(base / "slam"), claimed)
    return Refined(bag, base / "slam", base / "out", result)


@pytest.mark.slow
def test_it_begins_where_loops_and_satellites_put_the_run(refined: Refined) -> None:
    """And ends on the Earth, with the origin of the run, nearer to the truth."""
    closed = read_trajectory(refined.slam / "trajectory.csv")
    result = refined.result
    np.testing.assert_array_equal(result.time_ns, closed.times)
    np.testing.assert_allclose(result.T_before[:, 4:], closed.p, atol=1e-6)
    truth = round_a_block().ground_truth(result.time_ns).p_world_imu
    assert ate(result.T_after[:, 4:], truth) < ate(result.T_before[:, 4:], truth)
    origin, own = read_origin(refined.slam), read_origin(refined.folder)
    assert origin is not None and own == origin
    # The simulated world is east, north and up of its own origin.
    enu = origin.to_enu(GNSS_ORIGIN.to_geodetic(truth))
    assert np.linalg.norm((result.T_after[:, 4:] - enu).mean(axis=0)) < 0.1
    written = read_trajectory(refined.folder / "trajectory.csv")
    expected = result.T_after if result.summary.accepted else result.T_before
    np.testing.assert_allclose(written.p, expected[:, 4:], atol=1e-6)


def test_it_says_what_loops_and_satellites_came_to(refined: Refined) -> None:
    summary = refined.result.summary
    loops = json.loads((refined.slam / "run.json").read_text())["loops_accepted"]
    assert summary.loops == loops >= 1
    assert summary.loops_contradicted == 0 and 0 <= summary.loops_told_by_planes <= loops
    assert summary.receiver is not None and summary.receiver.fixes > 5
    assert summary.doubt is None  # nothing holds the first pose, and all of them moved within what the place is known to
    assert summary.receiver.lever_arm_sigma_m == (0.0, 0.0, 0.0)  # the recording has it
    np.testing.assert_allclose(summary.receiver.lever_arm_m, RECEIVER.lever)
    assert 0.0 < summary.receiver.heading_sigma_deg < 2.0 and 0.0 < summary.receiver.position_sigma_m < 0.5
    assert summary.time_offset == "held: as time_offset_estimation says" and summary.time_offset_sigma_s == 0.0


def test_runs_that_say_themselves_that_they_are_wrong_are_refused(refined: Refined, tmp_path: Path) -> None:
    facts = json.loads((refined.slam / "run.json").read_text())
    for words, change in {
        "loops contradict": {"contradiction": "loops contradict"},
        "come to its end": {"state": "failed"},
    }.items():
        copy = tmp_path / words.replace(" ", "_")
        shutil.copytree(refined.slam, copy)
        (copy / "run.json").write_text(json.dumps(facts | change))
        with pytest.raises(InputError, match=words):
            read_odometry_run(copy)


def test_fixes_that_are_gone_are_not_left_out_in_silence(refined: Refined, tmp_path: Path) -> None:
    bag = write_recording(round_a_block(), tmp_path / "block", "ros1")
    run = read_odometry_run(refined.slam)
    with (
        claim_refine_folder(tmp_path / "out", refined.slam) as claimed,
        pytest.raises(
            InputError, match="the positions by satellite that the run was laid onto the Earth by – got a recording without"
        ),
    ):
        refine_run(run, claimed, recording=bag)


def test_fixes_that_are_others_end_it(refined: Refined, tmp_path: Path) -> None:
    """Of another base station, say: the map went along with them, by 111 m, under the origin of the run."""
    closed = read_closed_run(refined.slam)
    assert closed.is_located
    place = tmp_path / "slam"
    shutil.copytree(refined.slam, place)
    file = place / "georeference.yaml"
    told = yaml.safe_load(file.read_text())
    told["origin"]["latitude_deg"] += 1e-5
    file.write_text(yaml.safe_dump(told))
    with open_recording(refined.bag) as recording:
        assert closed.fixes(recording) is not None
        with pytest.raises(InputError, match=r"laid onto the Earth by – got others, whose middle lies 1\.11 m away"):
            read_closed_run(place).fixes(recording)


def test_a_place_that_only_satellites_know_is_refined(refined: Refined, tmp_path: Path) -> None:
    """The run is trusted, as they tell where it ends; that of its odometry alone is not."""
    place = tmp_path / "slam"
    shutil.copytree(refined.slam, place)
    file = place / "odometry" / "run.json"
    facts = json.loads(file.read_text())
    said = "it is not known where the run ends"
    file.write_text(json.dumps(facts | {"contradiction": said, "unknown_position": said}))
    assert read_odometry_run(place).closed is not None
    with pytest.raises(InputError, match=said):
        read_odometry_run(place / "odometry")
    file.write_text(json.dumps(facts | {"contradiction": "the gyroscope is wrong", "unknown_position": said}))
    with pytest.raises(InputError, match="gyroscope"):
        read_odometry_run(place)
