"""Faults of cameras that can be named without an estimator: on exact corners, and on simulated recordings."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.comparison import Comparison
from boxplus.runs.inspection.cameras.examination import examine_cameras
from boxplus.runs.inspection.cameras.focal_length import check_focal_length, estimate_focal_length
from boxplus.runs.inspection.cameras.known_turns import KnownTurn, known_turns
from boxplus.runs.inspection.cameras.readout import check_readout, estimate_readout
from boxplus.runs.inspection.cameras.rotation import Turns, align, measured_turns
from boxplus.runs.inspection.cameras.stereo import Corners, check_calibration
from boxplus.runs.inspection.cameras.views import Views, check_blur, check_corners, check_views
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras import CameraSimulation, as_camera_recording, make_camera_fault, make_rig, simulate_cameras
from boxplus.simulation.cameras.sensor import CameraRig, LensKind

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
NOISE_PX = 0.1


def streams(rig: CameraRig) -> list[CameraStream]:
    return [
        CameraStream(
            index, f"cam{index}", "intensity", f"cam{index}", "", camera.sensor.width, camera.sensor.height, 200, 20.0,
            model=camera.sensor.lens.model(), T_body_camera=camera.mounting,
        )
        for index, camera in enumerate(rig.cameras)
    ]  # fmt: skip


def seen(
    simulation: CameraSimulation, camera: int, stamp_ns: int, p_world: np.ndarray, readout_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of points in an image whose rows are read within `readout_s`, and whether they are in it."""
    sensor = simulation.scenario.rig.cameras[camera].sensor
    size = np.array([sensor.width, sensor.height])
    kept = np.arange(len(p_world))
    rows = np.zeros(len(p_world))
    pixels = np.full((len(p_world), 2), -1.0)
    inside = np.ones(len(p_world), dtype=bool)
    for _ in range(3 if readout_s else 1):  # the row decides the instant, the instant the row
        time_ns = stamp_ns + np.rint(readout_s * 1e9 * rows[kept]).astype(np.int64)
        T = np.linalg.inv(simulation.T_world_camera(camera, time_ns if readout_s else time_ns[:1]))
        p = np.einsum("nij,nj->ni", np.broadcast_to(T[:, :3, :3], (len(kept), 3, 3)), p_world[kept]) + T[:, :3, 3]
        found, there = sensor.lens.model().project(p)
        there &= (p[:, 2] > 0.3) & (found > 0).all(axis=1) & (found < size - 1).all(axis=1)
        inside[:] = False
        kept, found = kept[there], found[there]
        inside[kept], pixels[kept], rows[kept] = True, found, found[:, 1] / (sensor.height - 1) - 0.5
    return pixels, inside


def turning(
    seed: int, readout_s: float, lens: LensKind = "radtan", noise_px: float = NOISE_PX
) -> tuple[CameraSimulation, Turns, ImuSamples]:
    """Corners of a moving camera and the samples of its gyroscope, without images."""
    simulation = simulate_cameras("room_moving", seed, duration_s=12.0, rig=make_rig("stereo", lens, 0.5))
    random = np.random.default_rng(seed)
    p_world = random.uniform((-4.0, -3.5, 0.0), (4.0, 3.5, 3.0), (1500, 3))
    walls = random.integers(0, 3, 1500)
    p_world[np.arange(1500), walls] = np.sign(random.uniform(-1, 1, 1500)) * np.array([4.4, 3.7, 1.6])[walls] + 1.6 * (walls == 2)
    turns = Turns(images=deque())
    for index in range(0, simulation.image_count - 3, 2):
        begin_ns, end_ns = simulation.stamp_ns(index), simulation.stamp_ns(index + 3)
        before, in_first = seen(simulation, 0, begin_ns, p_world, readout_s)
        after, in_second = seen(simulation, 0, end_ns, p_world, readout_s)
        both = np.flatnonzero(in_first & in_second)[:150]
        R = simulation.T_world_camera(0, [begin_ns, end_ns])[:, :3, :3]
        R_2_1 = R[1].T @ R[0]
        noise = random.normal(0.0, noise_px, (2, len(both), 2))
        turns.add(begin_ns, end_ns, R_2_1, before[both] + noise[0], after[both] + noise[1])
    return simulation, turns, simulation.imu.samples(simulation.start_ns, simulation.end_ns, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "readout_s"), [(1, 0.0), (3, 0.0), (5, 0.012), (7, -0.02)])
def test_the_time_from_row_to_row_comes_back(seed: int, readout_s: float) -> None:
    simulation, turns, imu = turning(seed, readout_s)
    camera = streams(simulation.scenario.rig)[0]
    aligned = align(turns, imu)
    assert not isinstance(aligned, str)
    known = known_turns(camera, turns, imu, aligned)
    found = estimate_readout(camera, known)
    assert found is not None
    assert abs(found.time_s - readout_s) < 4.0 * found.std_s + 1e-3 and found.std_s < 3e-3
    said = check_readout(camera, known)
    assert (said.verdict == "warning") == (readout_s != 0.0) and ("rolling shutter" in said.text) == (readout_s != 0.0)
    declared = dataclasses.replace(camera, line_delay_s=readout_s / (camera.height - 1))
    assert check_readout(declared, known).verdict == "ok"
    said = check_readout(dataclasses.replace(camera, line_delay_s=(readout_s + 0.03) / camera.height), known)
    assert said.verdict == "warning" and "check line_delay" in said.text
    few = dataclasses.replace(camera, model=None)
    assert known_turns(few, turns, imu, aligned) == [] and check_readout(few, []).value == "unchecked"


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "readout_s"), [(1, 0.0), (7, -0.02)])
def test_an_offset_of_the_clocks_that_is_hardly_known_is_no_rolling_shutter(seed: int, readout_s: float) -> None:
    """A sound drone that turned little was said to have one of 12 ms: its offset was 19 ± 12 ms."""
    simulation, turns, imu = turning(seed, readout_s)
    camera = streams(simulation.scenario.rig)[0]
    aligned = align(turns, imu)
    assert not isinstance(aligned, str)
    vague = dataclasses.replace(aligned, offset_s=aligned.offset_s + 0.015, offset_std_s=0.012)
    known, *apart = (known_turns(camera, turns, imu, vague, side) for side in (0.0, -1.0, 1.0))
    assert len(known) == len(apart[0]) == len(apart[1])
    pulled, found = estimate_readout(camera, known), estimate_readout(camera, known, apart)
    assert pulled is not None and found is not None
    assert abs(pulled.time_s - readout_s) > 2.0 * pulled.std_s
    assert abs(found.time_s - readout_s) < 4.0 * found.std_s + 1e-3
    assert abs(found.time_s - readout_s) < 0.5 * abs(pulled.time_s - readout_s)
    assert (check_readout(camera, known, apart).verdict == "warning") == (readout_s != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0.55, 0.65])
def test_turns_beyond_the_limit_of_the_gyroscope_are_no_wrong_focal_length(limit: float) -> None:
    simulation, turns, imu = turning(3, 0.0)
    camera = streams(simulation.scenario.rig)[0]
    clipped = ImuSamples(imu.time_ns, np.clip(imu.gyro, -limit, limit), imu.accel)
    assert measured_turns(turns, imu) is turns
    kept = measured_turns(turns, clipped)
    assert len(kept.rotation) < len(turns.rotation)
    aligned = align(kept, clipped)
    if not isinstance(aligned, str):
        assert check_focal_length(camera, known_turns(camera, kept, clipped, aligned)).verdict == "ok"


@given(st.integers(0, 2**32 - 1))
def test_misfits_are_those_of_directions_turned_one_by_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    x1, x2 = random.normal((0.0, 0.0, 1.0), 0.3, (2, 50, 3))
    row1, row2 = random.uniform(-0.5, 0.5, (2, 50))
    omega1, omega2 = random.normal(0.0, 1.0, (2, 3))
    turn = KnownTurn(x1[:, :2], x2[:, :2], row1, row2, omega1, omega2, so3.exp(random.normal(0.0, 0.1, 3)))
    times = random.uniform(-0.04, 0.04, 7)
    for time, misfit in zip(times, turn.misfits(x1, x2, times), strict=True):
        y1, y2 = (x + time * row[:, None] * np.cross(omega, x) for x, row, omega in ((x1, row1, omega1), (x2, row2, omega2)))
        distances = np.linalg.svd(np.cross(y2, y1 @ turn.R_2_1.T), compute_uv=False)
        assert misfit == pytest.approx(distances[-1] ** 2 / 50, rel=1e-6, abs=2e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "lens", "factor"), [(1, "radtan", 1.0), (3, "equidistant", 1.0), (5, "radtan", 1.06), (7, "equidistant", 0.9)]
)
def test_a_wrong_focal_length_is_told_from_how_far_the_gyroscope_turns(seed: int, lens: LensKind, factor: float) -> None:
    simulation, turns, imu = turning(seed, 0.0, lens)
    camera = streams(simulation.scenario.rig)[0]
    assert camera.model is not None
    stated = dataclasses.replace(camera.model, fx=factor * camera.model.fx, fy=factor * camera.model.fy)
    camera = dataclasses.replace(camera, model=stated)
    aligned = align(turns, imu)
    assert not isinstance(aligned, str)
    known = known_turns(camera, turns, imu, aligned)
    found = estimate_focal_length(camera, known)
    assert found is not None
    epsilon, sigma = found
    assert abs(epsilon - (1.0 / factor - 1.0)) < 4.0 * sigma + 0.005 and sigma < 0.01
    said = check_focal_length(camera, known)
    assert (said.verdict == "warning") == ("check focal length" in said.text) == (factor != 1.0)
    assert check_readout(camera, known).verdict == "ok"  # one is not taken for the other
    assert check_focal_length(camera, known[:20]).value == "unchecked"


@pytest.mark.slow
def test_a_rolling_shutter_is_no_focal_length() -> None:
    simulation, turns, imu = turning(5, 0.025)
    camera = streams(simulation.scenario.rig)[0]
    aligned = align(turns, imu)
    assert not isinstance(aligned, str)
    assert check_focal_length(camera, known_turns(camera, turns, imu, aligned)).verdict == "ok"


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_a_focal_length_far_off_is_told_too(factor: float) -> None:
    """MH_05 with a focal length stated 30 % too short was "unchecked", as the camera were turning too little."""
    simulation, turns, imu = turning(1, 0.0)
    camera = streams(simulation.scenario.rig)[0]
    assert camera.model is not None
    stated = dataclasses.replace(camera.model, fx=factor * camera.model.fx, fy=factor * camera.model.fy)
    aligned = align(turns, imu)
    assert not isinstance(aligned, str)
    camera = dataclasses.replace(camera, model=stated)
    said = check_focal_length(camera, known_turns(camera, turns, imu, aligned))
    assert said.verdict == "warning" and said.value == ("beyond +36 %" if factor < 1.0 else "beyond -28 %")
    assert "beyond what is looked at, -28 to +36 %: check focal length and distortion" in said.text


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["radtan", "equidistant"])
def test_noise_of_corners_is_no_focal_length(lens: LensKind) -> None:
    """Directions drawn together have less of it: corners good to 1 px asked for a focal length more than a third longer."""
    simulation, turns, imu = turning(1, 0.0, lens, noise_px=1.0)
    camera = streams(simulation.scenario.rig)[0]
    aligned = align(turns, imu)
    assert not isinstance(aligned, str)
    found = estimate_focal_length(camera, known_turns(camera, turns, imu, aligned))
    assert found is not None and abs(found[0]) < 2.0 * found[1] < 0.1


def test_turns_that_no_clock_tells_are_not_compared() -> None:
    """Beyond the offsets looked at, the gyroscope's turns are those of other instants."""
    simulation, turns, imu = turning(1, 0.0)
    compared = Comparison(streams(simulation.scenario.rig)[:1], 1)
    compared.turns = turns
    asked = ["cam0_imu_time_offset", "R_imu_cam0", "cam0_shutter", "cam0_focal_length"]
    assert [finding.key for finding in compared.with_imu(imu)] == asked
    late = dataclasses.replace(imu, time_ns=imu.time_ns + 160_000_000)
    assert [(finding.key, finding.value) for finding in compared.with_imu(late)] == [(asked[0], "beyond the search")]


def pairs(simulation: CameraSimulation) -> Corners:
    random = np.random.default_rng(0)
    p_world = random.uniform((-4.0, -3.5, 0.0), (4.0, 3.5, 3.0), (2000, 3))
    corners = Corners()
    for index in range(0, simulation.image_count, 20):
        first, in_first = seen(simulation, 0, simulation.stamp_ns(index), p_world, 0.0)
        second, in_second = seen(simulation, 1, simulation.stamp_ns(index), p_world, 0.0)
        both = in_first & in_second
        corners.first.append(first[both])
        corners.second.append(second[both])
    return corners


def test_a_stereo_calibration_that_does_not_fit_is_named() -> None:
    simulation = simulate_cameras("room_moving", 0, duration_s=5.0, rig=make_rig("stereo", None, 0.5))
    corners = pairs(simulation)
    one, two = streams(simulation.scenario.rig)
    right = check_calibration([one, two], corners)
    assert right.verdict == "ok" and float(right.value.split()[0]) < 1e-6
    swapped = check_calibration([one, two], Corners(corners.second, corners.first))
    assert swapped.verdict == "error" and "the cameras are swapped" in swapped.text
    for name, words in (
        ("inverted_extrinsic", "with the inverse of both mountings it fits"),
        ("bent_rig", "swapping or inverting does not mend it"),
    ):
        declared = streams(make_camera_fault(name).declared(simulation.scenario.rig))
        said = check_calibration(declared, corners)
        assert said.verdict == "error" and words in said.text and "does not fit these images" in said.text
    # The length of the baseline is not in the epipolar lines.
    assert (
        check_calibration(streams(make_camera_fault("wrong_baseline").declared(simulation.scenario.rig)), corners).verdict == "ok"
    )
    assert check_calibration([one, dataclasses.replace(two, T_body_camera=None)], corners).value == "unchecked"


def test_swapped_cameras_of_one_kind_are_told_by_where_the_points_lie() -> None:
    """Two cameras alike, exactly side by side: epipolar lines fit either way, but the points would lie behind."""
    simulation = simulate_cameras("room_moving", 0, duration_s=5.0, rig=make_rig("stereo", "pinhole", 0.5))
    left, right = simulation.scenario.rig.cameras
    T = left.mounting.copy()
    T[:3, 3] += 0.11 * T[:3, 0]
    twin = left.model_copy(update={"T_imu_camera": tuple(map(tuple, T.tolist()))})
    alike = CameraSimulation(
        dataclasses.replace(simulation.scenario, rig=simulation.scenario.rig.model_copy(update={"cameras": (left, twin)})), 0, 5.0
    )
    corners = pairs(alike)
    assert check_calibration(streams(alike.scenario.rig), corners).verdict == "ok"
    said = check_calibration(streams(alike.scenario.rig), Corners(corners.second, corners.first))
    assert said.verdict == "error" and "behind the cameras" in said.text and "swapped" in said.text
    del right


def noted(pictures: list[np.ndarray]) -> Views:
    views = Views()
    for k, pixels in enumerate(pictures):
        views.note(CameraImage(0, "cam0", 1_700_000_000_000_000_000 + 50_000_000 * k, pixels), pixels)
    return views


def said_of(pictures: list[np.ndarray]) -> dict[str, Evidence]:
    views = noted(pictures)
    return {evidence.key: evidence for evidence in [*check_views("cam0", views), *check_blur("cam0", views)]}


def test_what_images_show() -> None:
    simulation = simulate_cameras("room_moving", 1, duration_s=4.0, rig=make_rig("mono", None, 0.25))
    sharp = [simulation.image(0, k).pixels for k in range(0, 60, 2)]
    assert {evidence.verdict for evidence in said_of(sharp).values()} == {"ok"}
    random = np.random.default_rng(0)
    hand = [np.clip(random.normal(35.0, 2.0, sharp[0].shape), 0, 255).astype(np.uint8)] * 6
    covered = said_of(sharp[:10] + hand + sharp[16:])["cam0_view"]
    assert (covered.verdict, covered.value) == ("warning", "covered") and "from 0.50 s on" in covered.text
    assert said_of(sharp[:10] + hand[:3] + sharp[13:])["cam0_view"].verdict == "ok"  # a hand that passes
    night = [np.clip(random.normal(3.0, 2.0, sharp[0].shape), 0, 255).astype(np.uint8)] * 6
    dark = said_of(sharp[:10] + night + sharp[16:])
    assert "almost black" in dark["cam0_brightness"].text and dark["cam0_view"].verdict == "ok"
    assert "no texture" in said_of(hand * 4)["cam0_view"].text
    smeared = [np.mean([np.roll(p.astype(float), k, 1) for k in range(-4, 5)], axis=0).astype(np.uint8) for p in sharp[:12]]
    blurred = said_of(smeared + sharp[12:])["cam0_sharpness"]
    assert blurred.verdict == "warning" and "blur" in blurred.text
    small, large = noted(sharp), dataclasses.replace(noted(sharp), size=(752, 480))
    assert check_corners("cam0", [], large) == []
    assert check_corners("cam0", [20, 30, 35], large)[0].verdict == "warning"
    assert check_corners("cam0", [20, 30, 35], small)[0].verdict == "ok"
    bare = dataclasses.replace(large, structure=[1.5] * len(large.structure))
    assert check_corners("cam0", [60, 70, 75], large)[0].verdict == "ok"
    assert "few corners" in check_corners("cam0", [60, 70, 75], bare)[0].text


def test_images_that_come_again_between_images_that_change_are_named() -> None:
    texture = np.kron(np.random.default_rng(4).integers(0, 255, (30, 60)), np.ones((16, 16), int)).astype(np.uint8)
    moving = [texture[:240, 3 * k : 3 * k + 320] for k in range(60)]
    assert "cam0_repeats" not in said_of(moving)
    stalled = [moving[20] if 20 < k < 26 else image for k, image in enumerate(moving)]
    stalled[40] = stalled[39]
    found = said_of(stalled)["cam0_repeats"]
    assert (found.value, found.verdict) == ("6", "warning") and "longest stretch is 5 from" in found.text
    # Without noise images are equal at rest, too: these come slowly to a stop and slowly go on.
    places = np.cumsum(np.concatenate([np.arange(6, 0, -1), np.zeros(8, int), np.arange(7)]))
    assert "cam0_repeats" not in said_of([texture[:240, k : k + 320] for k in places])
    assert "cam0_repeats" not in said_of([moving[0]] * 10 + moving)
    black = np.zeros((240, 320), np.uint8)
    assert "cam0_repeats" not in said_of([*moving[:30], black, black, *moving[30:]])


@pytest.fixture(scope="module")
def filmed() -> CameraSimulation:
    """A simulation that renders every image once."""
    simulation = simulate_cameras("room_moving", 1, duration_s=7.0, rig=make_rig("stereo", None, 0.3, 10.0))
    simulation.image = functools.cache(simulation.image)  # type: ignore[method-assign]
    return simulation


@pytest.mark.slow
@needs_cv2
@pytest.mark.parametrize(
    ("name", "key"),
    [
        (None, ""),
        ("covered_lens", "cam0_view"),
        ("swapped_cameras", "cam0_cam1_epipolar"),
        ("drop_frames", "cam0_gaps"),
        ("bare_walls", "cam0_corners"),
    ],
)
def test_a_simulated_recording_says_what_is_wrong_with_it(filmed: CameraSimulation, name: str | None, key: str) -> None:
    fault = None if name is None else make_camera_fault(name)
    found = examine_cameras(as_camera_recording(filmed, fault), lambda _: None)
    wrong = {evidence.key: evidence for evidence in found if evidence.verdict != "ok"}
    if fault is None:
        assert not wrong
    else:
        assert key in wrong and fault.named_in(" ".join(evidence.text for evidence in wrong.values()))


@pytest.mark.slow
@needs_cv2
def test_a_rest_before_the_motion_leaves_camera_and_gyroscope_alike() -> None:
    """Between images that stand any rotation fits: half a minute of rest passed for a gyroscope of another platform."""
    simulation = simulate_cameras("room_moving", 5, duration_s=6.0, rig=make_rig("mono", None, 0.4, 20.0))
    random, period_ns, rests = np.random.default_rng(5), 50_000_000, 300
    images = [simulation.image(0, k) for k in range(simulation.image_count)]
    imu = simulation.imu.samples(simulation.start_ns, simulation.end_ns, 0)
    first = images[0]
    still = [
        dataclasses.replace(
            first,
            time_ns=first.time_ns - (rests - k) * period_ns,
            pixels=np.clip(first.pixels + random.normal(0.0, 1.0, first.pixels.shape), 0, 255).astype(np.uint8),
        )
        for k in range(rests)
    ]
    before_ns = np.arange(still[0].time_ns - 500_000_000, imu.time_ns[0], 5_000_000)
    noise = random.normal(0.0, 2e-3, (len(before_ns), 3))
    rest = ImuSamples(before_ns, noise, np.tile([0.0, 0.0, 9.81], (len(before_ns), 1)))
    comparison = Comparison(streams(simulation.scenario.rig), rests + len(images))
    for image in [*still, *images]:
        comparison.note(image, image.grey().astype(np.uint8))
    found = {finding.key: finding for finding in comparison.with_imu(ImuSamples.joined([rest, imu]))}
    assert found["R_imu_cam0"].verdict == "ok" and "deg apart" in found["R_imu_cam0"].value
