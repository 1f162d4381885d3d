"""The campaign of camera recordings: draws that repeat, and a judge that knows what it was told."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.recordings.info import Evidence
from boxplus.simulation.cameras import CAMERA_FAULTS
from tests.campaign_modules import campaign_modules


@pytest.fixture(scope="module")
def campaign() -> Iterator[SimpleNamespace]:
    """The script and its draws, which are no package of the library; they leave no trace."""
    of = {name: f"vio_campaign.{name}" for name in ("draws", "judge", "direct")}
    with campaign_modules(**of, script="camera_campaign") as modules:
        yield modules


def test_every_kind_is_drawn_and_fits(campaign: SimpleNamespace) -> None:
    kinds = [campaign.draws.draw_kinds(seed) for seed in range(600)]
    assert {kind.fault for kind in kinds} == {"none", *CAMERA_FAULTS} - {"wrong_focal_length"}  # asked for by name
    named = campaign.draws.draw(7, "wrong_second_focal_length")
    assert named.kinds.rig == "stereo" and named.fault.name == "wrong_focal_length" and "cam1" in named.fault.description
    assert 0.3 < np.mean([kind.fault == "none" for kind in kinds]) < 0.5
    for kind in kinds:
        assert kind.world in campaign.draws.MOTIONS[kind.motion]
        assert kind.rig == "stereo" or kind.fault not in campaign.draws.STEREO_FAULTS
    assert kinds[7] == campaign.draws.draw_kinds(7) and kinds[7].matches({"world": kinds[7].world})


@pytest.mark.parametrize("fault", ["bare_walls", "constant_velocity_start", "swapped_cameras", "darkness"])
def test_a_fault_by_name_brings_what_it_needs(campaign: SimpleNamespace, fault: str) -> None:
    for kinds_of, made_of in (
        (campaign.draws.draw_kinds, campaign.draws.draw),
        (campaign.direct.draw_direct_kinds, campaign.direct.draw_direct),
    ):
        seed = next(k for k in range(500) if kinds_of(k).world == "stairs" and kinds_of(k).rig == "mono")
        kinds, made = kinds_of(seed), made_of(seed, fault).kinds
        assert made.fault == fault and made.light == kinds.light
        assert made.rig == ("stereo" if fault in campaign.draws.STEREO_FAULTS else kinds.rig)
        in_room = fault in campaign.draws.ROOM_FAULTS
        assert (made.world, made.motion) == (("room", "handheld") if in_room else (kinds.world, kinds.motion))


def test_a_fault_by_name_is_not_ignored(campaign: SimpleNamespace, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        campaign.script.main(["--seeds", "0:0", "--fault", "darkness"])
    assert "--fault needs --vio or --vo" in capsys.readouterr().err


def test_a_seed_repeats_and_its_motion_is_free_of_obstacles(campaign: SimpleNamespace) -> None:
    for seed in range(12):
        one, other = campaign.draws.draw(seed), campaign.draws.draw(seed)
        assert one.duration_s == other.duration_s and one.scenario.rig == other.scenario.rig
        assert (one.fault is None) == (one.kinds.fault == "none")
        truth = one.truth()
        path = truth.ground_truth(np.arange(truth.start_ns, truth.end_ns, 10**8)).p_world_imu
        assert (path == other.truth().ground_truth(np.arange(truth.start_ns, truth.end_ns, 10**8)).p_world_imu).all()
        assert truth.scenario.world.distance(path).min() > 0.2


def drawn(campaign: SimpleNamespace, **only: str) -> Any:
    return campaign.draws.draw(next(seed for seed in range(5000) if campaign.draws.draw_kinds(seed).matches(only)))


def test_the_judge(campaign: SimpleNamespace) -> None:
    judge = campaign.script.judge
    fine = Evidence("cam0_view", "10", "ok", "dark or covered")
    sound, dark = drawn(campaign, fault="none", light="steady"), drawn(campaign, fault="darkness", light="steady")
    said = Evidence("cam0_brightness", "90", "warning", "7 of 100 images are almost black")
    assert judge(sound, [fine]) == "right" and judge(sound, [said]) == "false alarm"
    assert judge(dark, [said]) == "right cause" and judge(dark, [fine]) == "silent"
    assert judge(dark, [Evidence("imu_gaps", "1", "warning", "gap")]) == "flagged"
    assert judge(drawn(campaign, fault="wrong_baseline"), [fine]) == "not for inspect"
    late = drawn(campaign, fault="imu_clock_offset")
    assert judge(late, [Evidence("R_imu_cam0", "unchecked", "ok", "turns too little")]) == "unchecked"
    jumping = drawn(campaign, fault="none", light="jumping")
    assert judge(jumping, [said]) == "right"


def test_tables_of_earlier_runs(campaign: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"seed": k, "fault": fault, "verdict": "right cause"} for k, fault in enumerate(("darkness", "darkness", "drop_imu"))]
    (tmp_path / "a.jsonl").write_text("\n".join(map(json.dumps, rows)))
    campaign.script.main(["--merge", str(tmp_path / "a.jsonl"), "--only", "fault=darkness"])
    assert capsys.readouterr().out.split() == ["darkness", "2", "right", "cause", "all", "2", "right", "cause"]


def test_the_judge_of_the_odometry(campaign: SimpleNamespace) -> None:
    def said(made: Any, error_m: float | None, *flags: str, not_ok: float = 0.0) -> str:
        return str(campaign.judge.judge_run(made, campaign.judge.Outcome(error_m, 10.0, not_ok, list(flags))))

    sound, short = drawn(campaign, fault="none"), drawn(campaign, fault="wrong_baseline")
    assert said(sound, 0.1) == "right" and said(sound, 0.1, "something") == "false alarm"
    assert (
        said(sound, 0.3) == "silent" and said(sound, 0.3, not_ok=0.5) == "flagged" and said(sound, None, "refused") == "flagged"
    )
    assert said(short, 0.01, "anything") == "right" and said(short, 0.4) == "silent"
    assert said(short, 0.4, "the baseline of the rig does not fit the accelerations") == "right cause"
