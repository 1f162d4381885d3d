"""A part of the view that moves by itself is told with its share; of one motion, however badly it is known, nothing is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.runs.inspection.cameras.carried import Followed
from boxplus.runs.inspection.cameras.examination import examine_cameras
from boxplus.runs.inspection.cameras.two_motions import check_motions
from boxplus.simulation.cameras import as_camera_recording, faults, make_rig, simulate_cameras

pytest.importorskip("cv2")

CAMERA = as_camera_recording(simulate_cameras("room", 1, duration_s=1.0, rig=make_rig("mono", None, 0.5, 10.0))).info.cameras[0]
SIZE = np.array([CAMERA.width, CAMERA.height], float)
PERIOD_NS, FIRST_NS, ORIGIN_NS, N = 100_000_000, 5_000_000_000, 3_000_000_000, 160
Floats = NDArray[np.float64]


def motion(random: np.random.Generator) -> tuple[Floats, Floats]:
    """Of a tenth of a second, in the frame of the camera; across the view, as what goes along it shows least."""
    angle = random.uniform(0.0, 2.0 * np.pi)
    return Rotation.from_rotvec(random.uniform(-0.05, 0.05, 3)).as_matrix(), 0.15 * np.array([np.cos(angle), np.sin(angle), 0.0])


def pairs(
    share: float, seed: int, *, count: int = 12, place: str = "left", wrong: float = 0.03, still: bool = False
) -> list[Followed]:
    """Corners of points 1.5 to 6 m away; a share of the view shows something 1.3 m away that has a motion of its own.

    Args:
        place: "left" of the view, "anywhere" (another side from pair to pair), or "among" the other corners.
        wrong: share of the corners that were followed wrongly.
        still: the camera carries it along, and it stands still in the image.
    """
    random, made, model = np.random.default_rng(seed), [], CAMERA.model
    assert model is not None
    for k in range(count):
        before = random.uniform(5.0, SIZE - 5.0, (N, 2))
        side = int(random.integers(0, 6)) if place == "anywhere" else 0
        ahead = (before / SIZE) @ np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [0.6, 0.6], [-0.6, 0.6]][side])
        own = ahead < np.quantile(ahead, share) if place != "among" else random.uniform(size=N) < share
        depth = np.where(own, 1.3, random.uniform(1.5, 6.0, N))
        X = model.unproject(before)[0] * depth[:, None]
        (R, t), (R_own, t_own) = motion(random), motion(random)
        after, seen = model.project(np.where(own[:, None], X @ R_own.T + t_own, X @ R.T + t))
        if still:
            after[own], seen[own] = before[own], True
        after += random.normal(0.0, 0.1, (N, 2))
        lost = random.uniform(size=N) < wrong
        after[lost] = random.uniform(5.0, SIZE - 5.0, (int(lost.sum()), 2))
        begin_ns = FIRST_NS + k * PERIOD_NS
        made.append(Followed(begin_ns, begin_ns + PERIOD_NS, before[seen], after[seen]))
    return made


@settings(max_examples=5, deadline=None)
@given(share=st.floats(0.25, 0.48), seed=st.integers(0, 1000))
def test_something_that_moves_by_itself_is_told_with_its_share_and_its_time(share: float, seed: int) -> None:
    (said,) = check_motions(CAMERA, pairs(share, seed), ORIGIN_NS)
    assert said.key == "cam0_motions" and said.verdict == "warning" and "moves by itself" in said.text
    told = float(said.text.split(" fills ")[1].split("%")[0]) / 100.0
    assert abs(told - share) < 0.1
    begin_s, end_s = (float(said.text.split(word)[1].split()[0]) for word in ("between ", " and "))
    assert 2.0 <= begin_s < end_s <= 3.2 + 1e-9  # counted from what was given


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000), wrong=st.floats(0.0, 0.3))
def test_nothing_is_said_of_one_motion_even_where_corners_are_followed_wrongly(seed: int, wrong: float) -> None:
    assert check_motions(CAMERA, pairs(0.0, seed, wrong=wrong), ORIGIN_NS) == []


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000), factor=st.floats(0.8, 1.25), shear=st.floats(-0.02, 0.02))
def test_nothing_is_said_where_the_calibration_is_wrong_or_the_shutter_rolls(seed: int, factor: float, shear: float) -> None:
    def bent(pixels: Floats, rate: float) -> Floats:
        bent = SIZE / 2.0 + factor * (pixels - SIZE / 2.0)
        bent[:, 0] += rate * shear * (pixels[:, 1] - SIZE[1] / 2.0)
        return bent

    made = [replace(p, before=bent(p.before, 1.0), after=bent(p.after, -1.0)) for p in pairs(0.0, seed)]
    assert check_motions(CAMERA, made, ORIGIN_NS) == []


@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_part_is_a_place_that_stays_and_moves(seed: int) -> None:
    assert check_motions(CAMERA, pairs(0.4, seed, place="among"), ORIGIN_NS) == []
    assert check_motions(CAMERA, pairs(0.3, seed, place="anywhere", count=24), ORIGIN_NS) == []
    assert check_motions(CAMERA, pairs(0.4, seed, still=True), ORIGIN_NS) == []


@pytest.mark.slow
def test_inspect_tells_when_something_passes_before_the_camera() -> None:
    simulation = simulate_cameras("room_moving", 1, duration_s=5.0, rig=make_rig("mono", None, 0.5, 15.0))
    fault = faults.moving_object(1.5, 3.0)
    found = examine_cameras(as_camera_recording(simulation, fault), lambda _: None)
    (said,) = [finding for finding in found if finding.key == "cam0_motions"]
    assert fault.named_in(said.text)
    begin_s, end_s = (float(said.text.split(word)[1].split()[0]) for word in ("between ", " and "))
    assert 1.2 < begin_s < end_s < 4.8
    assert not any(finding.key == "cam0_motions" for finding in examine_cameras(as_camera_recording(simulation), lambda _: None))


def test_pairs_that_tell_follow_one_another() -> None:
    """Five of a minute are accidents, and the time between them is not that of anything."""
    told, quiet = pairs(0.4, 0, count=12), pairs(0.0, 1, count=60)
    spread = [told[k // 10] if k % 10 == 0 else pair for k, pair in enumerate(quiet)]
    assert check_motions(CAMERA, spread, ORIGIN_NS) == []
    assert len(check_motions(CAMERA, [*quiet[:10], *told, *quiet[10:]], ORIGIN_NS)) == 1


def test_a_calibration_that_is_wrong_is_named_beside_what_moves() -> None:
    (said,) = check_motions(CAMERA, pairs(0.4, 3), ORIGIN_NS)
    assert "where nothing passed by, the calibration of the camera is wrong" in said.text


def test_a_few_pairs_or_corners_and_a_camera_that_is_not_known_say_nothing() -> None:
    assert check_motions(CAMERA, pairs(0.4, 0, count=4), ORIGIN_NS) == []
    assert check_motions(replace(CAMERA, model=None), pairs(0.4, 0), ORIGIN_NS) == []
    few = [replace(p, before=p.before[:40], after=p.after[:40]) for p in pairs(0.4, 0)]
    assert check_motions(CAMERA, few, ORIGIN_NS) == []
    assert check_motions(CAMERA, [], ORIGIN_NS) == []
