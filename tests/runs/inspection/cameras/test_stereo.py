"""What is said of two cameras: images that were turned or mirrored, one camera in place of the other, millimetres for metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.recordings.cameras.calibration import inverse
from boxplus.recordings.cameras.info import CameraStream
from boxplus.runs.inspection.cameras.stereo import Corners, check_baseline, check_calibration
from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras

PAIR = as_camera_recording(simulate_cameras("room", 1, duration_s=1.0, rig=make_rig("stereo", "radtan", 0.5, 10.0))).info.cameras


def corners(seed: int, mirrored: tuple[bool, bool] = (False, False), swapped: bool = False) -> Corners:
    """Of points 1 to 8 m before the first camera, in images of both that count u, or v, from the other end."""
    random = np.random.default_rng(seed)
    size = np.array([PAIR[0].width, PAIR[0].height])
    before = random.uniform((20.0, 20.0), size - 20.0, (800, 2))
    X = PAIR[0].model.unproject(before)[0] * random.uniform(1.0, 8.0, (800, 1))
    T = inverse(PAIR[1].T_body_camera) @ PAIR[0].T_body_camera
    after, seen = PAIR[1].model.project(X @ T[:3, :3].T + T[:3, 3])
    pixels = [p[seen] + random.normal(0.0, 0.1, (int(seen.sum()), 2)) for p in (before, after)]
    pixels = [np.where(mirrored, size - 1.0 - p, p) for p in (pixels[::-1] if swapped else pixels)]
    return Corners([pixels[0]], [pixels[1]])


@pytest.mark.parametrize("seed", [1, 3, 5])
@pytest.mark.parametrize(
    ("mirrored", "swapped", "words"),
    [
        ((False, False), False, ""),
        ((True, True), False, "turned upside down it fits"),
        ((False, True), False, "mirrored top to bottom it fits"),
        ((False, False), True, "the cameras are swapped"),
    ],
)
def test_images_that_were_turned_mirrored_or_swapped_are_told_apart(
    seed: int, mirrored: tuple[bool, bool], swapped: bool, words: str
) -> None:
    said = check_calibration(PAIR, corners(seed, mirrored, swapped))
    assert said.verdict == ("error" if words else "ok") and words in said.text, said


def scaled(camera: CameraStream, factor: float) -> CameraStream:
    return replace(camera, model=replace(camera.model, fx=factor * camera.model.fx, fy=factor * camera.model.fy))


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 1000), factor=st.floats(0.75, 1.35).filter(lambda factor: abs(factor - 1.0) > 0.06), second=st.booleans()
)
def test_the_focal_length_of_one_camera_is_told_with_its_ratio(seed: int, factor: float, second: bool) -> None:
    pair = [PAIR[0], scaled(PAIR[1], factor)] if second else [scaled(PAIR[0], factor), PAIR[1]]
    said = check_calibration(pair, corners(seed))
    assert said.verdict == "error" and "focal length of cam1" in said.text and "calibrate both" in said.text
    ratio = float(said.text.split(" times as long")[0].split()[-1])
    assert abs(ratio * factor - 1.0 if second else ratio / factor - 1.0) < 0.01


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000), turn_deg=st.floats(0.7, 3.0), sign=st.sampled_from((-1.0, 1.0)), axis=st.sampled_from((0, 2)))
def test_a_camera_that_has_turned_is_no_other_reading(seed: int, turn_deg: float, sign: float, axis: int) -> None:
    T = PAIR[1].T_body_camera.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(np.radians(sign * turn_deg) * np.eye(3)[axis])
    said = check_calibration([PAIR[0], replace(PAIR[1], T_body_camera=T)], corners(seed))
    assert said.verdict == "ok" or "swapping or inverting does not mend it" in said.text, said


def test_one_camera_recorded_twice_is_said_whatever_its_corners() -> None:
    said = check_calibration(PAIR, corners(1), same=3)
    assert said.verdict == "error" and "3 pairs of images of both cameras are the same to the bit" in said.text


def test_mountings_in_millimetres_are_told_by_the_distance_of_the_cameras() -> None:
    def in_millimetres(camera: CameraStream) -> CameraStream:
        T = camera.T_body_camera.copy()
        T[:3, 3] *= 1000.0
        return replace(camera, T_body_camera=T)

    assert check_baseline(PAIR) == []
    (said,) = check_baseline([in_millimetres(camera) for camera in PAIR])
    assert said.verdict == "warning" and said.value == "110.0 m" and "millimetres" in said.text
    assert check_baseline([PAIR[0], replace(PAIR[1], T_body_camera=None)]) == []
