"""What single comparisons leave open, the watch puts together."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement import watch
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from boxplus.systems.lidar_inertial_agreement.translation import SLOPE
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, FINE, data, handheld, true_poses, true_twists, turned


@pytest.mark.slow
def test_a_length_that_one_stretch_asks_for_and_the_others_do_not_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=T)
    assert seen.translation is not None
    covariance = seen.translation.covariance.copy()
    covariance[SLOPE, SLOPE] = 0.045**2
    slopes = iter([0.99, 1.3, 1.0, 1.01, 0.98, 1.0])
    sure = replace(seen.translation, covariance=covariance, slope_reserve=0.0)
    single = replace(seen, translation=replace(sure, slope=1.3))
    assert [finding.cause for finding in contradictions(single, T)] == ["length_scale"]

    def compare(scans: Sequence[Scan], *_: Any, **__: Any) -> Agreement:
        time_ns = np.linspace(scans[0].start_ns, scans[-1].end_ns, len(seen.path)).astype(np.int64)
        fit = replace(sure, slope=next(slopes), explained=0.9)
        return replace(seen, path=replace(seen.path, time_ns=time_ns), translation=fit)

    monkeypatch.setattr(watch, "compare_sensors", compare)
    following = watch.Watch(CONFIG, T)
    still = np.zeros(3), np.zeros(3)
    assert not any(following.add(scans[0].shifted(k * 100_000_000), imu, T, still) for k in range(160))
    following.finish()
    assert following.contradiction is None and next(slopes) < 1.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scales", "named", "stays"),
    [
        ((0.5, 1.0, 1.0), False, False),
        ((1.0, 0.5, 1.0, 0.5), False, False),
        ((0.5, 0.5, 1.0), True, False),
        ((0.5, 0.5, None, 0.5), True, True),  # None: nothing turned
        ((0.5, None, 0.5), True, True),
        ((0.5, -0.5, 0.5), True, True),  # negative: the scale is not known well enough
        ((0.5,), True, True),
        ((None, 0.5, None), True, True),
        ((1.0, 0.5), False, False),  # once right, once not
    ],
)
def test_a_gyroscope_s_scale_is_said_by_two_comparisons(
    monkeypatch: pytest.MonkeyPatch, scales: tuple[float | None, ...], named: bool, stays: bool
) -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=T)
    assert seen.rotation is not None
    rotation = replace(seen.rotation, explained=0.99)
    assert [finding.cause for finding in contradictions(replace(seen, rotation=replace(rotation, scale=0.5)), T)] == [
        "gyro_scale"
    ]
    following_scales = iter(scales)
    last = scales[-1]

    def compare(scans: Sequence[Scan], *_: Any, **__: Any) -> Agreement:
        time_ns = np.linspace(scans[0].start_ns, scans[-1].end_ns, len(seen.path)).astype(np.int64)
        scale = next(following_scales, last)
        fit = None if scale is None else replace(rotation, scale=abs(scale), explained=0.99 if scale > 0.0 else 0.93)
        return replace(seen, path=replace(seen.path, time_ns=time_ns), rotation=fit, translation=None)

    monkeypatch.setattr(watch, "compare_sensors", compare)
    following = watch.Watch(CONFIG, T)
    still = np.zeros(3), np.zeros(3)
    said = [following.add(scans[0].shifted(k * 100_000_000), imu, T, still) for k in range(75 * len(scales))]
    said.append(following.finish())
    assert any(text is not None and "times as far as the LiDAR" in text for text in said) == named
    assert (following.contradiction is not None) == stays


@pytest.mark.slow
@pytest.mark.parametrize(("slope", "named"), [(0.88, True), (1.12, True), (0.96, False)])
def test_lengths_are_named_by_several_comparisons(monkeypatch: pytest.MonkeyPatch, slope: float, named: bool) -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=T)
    assert seen.translation is not None
    covariance = seen.translation.covariance.copy()
    covariance[SLOPE, SLOPE] = 0.045**2
    walking = replace(seen, translation=replace(seen.translation, slope=slope, covariance=covariance, explained=0.9))
    assert contradictions(walking, T) == []
    compared = []

    def compare(scans: Sequence[Scan], *_: Any, **__: Any) -> Agreement:
        compared.append(scans[-1].end_ns)
        time_ns = np.linspace(scans[0].start_ns, scans[-1].end_ns, len(walking.path)).astype(np.int64)
        return replace(walking, path=replace(walking.path, time_ns=time_ns))

    monkeypatch.setattr(watch, "compare_sensors", compare)
    following = watch.Watch(CONFIG, T)
    still = np.zeros(3), np.zeros(3)
    said = [following.add(scans[0].shifted(k * 100_000_000), imu, T, still) for k in range(220)]
    following.finish()
    assert len(compared) >= 3
    assert [text for text in said if text is not None and "the points are not in metres" in text] == [
        text for text in said if text is not None
    ]
    assert (following.contradiction is not None) == named == any(said)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.5, 20.0, 120.0])
def test_a_mounting_that_nobody_gave_is_borne_out_or_contradicted(degrees: float) -> None:
    simulation = handheld(5)
    scans, imu = data(simulation)
    in_use = turned(simulation.T_imu_lidar, degrees, seed=3)
    following = watch.Watch(CONFIG, None)
    for k, (scan, twist) in enumerate(zip(scans, true_twists(simulation, scans), strict=True)):
        samples = imu.time_ns // 100_000_000 == scan.start_ns // 100_000_000
        block = replace(imu, time_ns=imu.time_ns[samples], gyro=imu.gyro[samples], accel=imu.accel[samples])
        following.add(scan, imu if k == 0 else block, in_use, twist)
    following.finish()
    assert following.mounting_borne_out == (degrees < 1.0)
    if degrees < 1.0:
        assert following.contradiction is None
    else:
        assert following.contradiction is not None and following.contradiction.cause == "extrinsic"
        assert "under the mounting in use, which nobody gave" in following.contradiction.text


def test_an_estimate_that_has_gone_astray_stays_contradicted_when_it_moves_rightly_again() -> None:
    simulation = handheld(5, 12.0, lidar=FINE)
    scans, imu = data(simulation)
    right = true_twists(simulation, scans)
    R_world_lidar, _ = true_poses(simulation, np.array([scan.end_ns for scan in scans]))
    runaway = np.array([2.0, 0.0, 0.0])  # m/s
    wrong = [(rate, velocity + R.T @ runaway) for (rate, velocity), R in zip(right, R_world_lidar, strict=True)]
    following = watch.Watch(CONFIG, simulation.T_imu_lidar)
    said = []
    for k, scan in enumerate(scans):
        said.append(following.add(scan, imu if k == 0 else _no(imu), simulation.T_imu_lidar, wrong[k] if k < 50 else right[k]))
    following.finish()
    assert [text for text in said if text is not None and "it has gone astray" in text]
    assert following.contradiction is not None and following.contradiction.cause == "astray"


def _no(imu: ImuSamples) -> ImuSamples:
    return ImuSamples(imu.time_ns[:0], imu.gyro[:0], imu.accel[:0])


def test_a_guess_that_was_corrected_does_not_stay_contradicted(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a platform that turns about one axis, by what this axis shows; a stretch that shows another one clears nothing."""
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=T)
    assert seen.rotation is not None
    rotation = replace(seen.rotation, R_imu_lidar=T[:3, :3].copy())
    unknown = ["z"]

    def compare(scans: Sequence[Scan], *_: Any, **__: Any) -> Agreement:
        covariance = rotation.covariance.copy()
        covariance[:3, :3] = np.diag([9.0 if axis in unknown else 0.005**2 for axis in "xyz"])
        time_ns = np.linspace(scans[0].start_ns, scans[-1].end_ns, len(seen.path)).astype(np.int64)
        shown = replace(rotation, covariance=covariance)
        return replace(seen, path=replace(seen.path, time_ns=time_ns), rotation=shown, translation=None)

    monkeypatch.setattr(watch, "compare_sensors", compare)
    following = watch.Watch(CONFIG, None)
    wrong = T.copy()
    wrong[:3, :3] = so3.exp(np.array([np.deg2rad(20.0), 0.0, 0.0])) @ T[:3, :3]
    still, said, clock = (np.zeros(3), np.zeros(3)), [], 0

    def go_on(T_in_use: np.ndarray, scans_more: int) -> bool:
        nonlocal clock
        for _ in range(scans_more):
            news = following.add(scans[0].shifted(clock * 100_000_000), imu, T_in_use, still)
            said.extend([] if news is None else [news])
            clock += 1
        return following.contradiction is not None

    assert go_on(wrong, 100)
    unknown[:] = ["x"]
    assert go_on(T, 200)
    unknown[:] = ["z"]
    assert not go_on(T, 300)
    following.finish()
    assert len(said) == 1 and not following.mounting_borne_out


def test_live_no_scan_waits_for_the_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison ends when it may; until then scans go through, and after it the next one brings the verdict."""
    simulation = handheld(4)
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=simulation.T_imu_lidar)
    may_end = threading.Event()

    def compare(*_: Any, **__: Any) -> Agreement:
        assert may_end.wait(60.0)
        return seen

    monkeypatch.setattr(watch, "compare_sensors", compare)
    wrong = turned(simulation.T_imu_lidar, 20.0, seed=3)
    following = watch.Watch(CONFIG, None, live=True)
    still = np.zeros(3), np.zeros(3)
    for k in range(200):
        assert following.add(scans[0].shifted(k * 100_000_000), imu, wrong, still) is None
    assert following.contradiction is None
    may_end.set()
    told = following.finish()
    assert told is not None and following.contradiction is not None and following.contradiction.text == told


def test_nothing_is_compared_across_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where pauses have left few scans among the last seconds, more come before the last pause is past."""
    simulation = handheld(4)
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=simulation.T_imu_lidar)
    compared: list[int] = []

    def compare(scans: Sequence[Scan], *_: Any, **__: Any) -> Agreement:
        compared.append(scans[0].start_ns)
        return seen

    monkeypatch.setattr(watch, "compare_sensors", compare)
    following, still = watch.Watch(CONFIG, simulation.T_imu_lidar), (np.zeros(3), np.zeros(3))
    paused = 10, 22, 34  # tenths of a second
    times = [k for k in range(150) if not any(k in range(pause, pause + 8) for pause in paused)]
    after = [times.index(pause + 8) for pause in paused]
    for number, tenths in enumerate(times):
        scan = scans[0].shifted(tenths * 100_000_000)
        following.add(scan, imu, simulation.T_imu_lidar, still, suspicious=True, blind=number in after)
    following.finish()
    last = scans[0].start_ns + times[after[-1]] * 100_000_000
    assert compared and min(compared) > last


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "named"), [(6.0, True), (0.0, False)])
def test_a_given_mounting_is_contradicted_by_all_stretches_together_and_stays_so(degrees: float, named: bool) -> None:
    """Also past a stretch that asks for another length by itself, and one that shows nothing."""
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation)
    seen = compare_sensors(scans[:25], imu, CONFIG, T_declared=T)
    assert seen.rotation is not None and seen.translation is not None
    covariance, of_slope = seen.rotation.covariance.copy(), seen.translation.covariance.copy()
    covariance[:3, :3], of_slope[SLOPE, SLOPE] = np.deg2rad(0.9) ** 2 * np.eye(3), 0.045**2
    rotation = replace(seen.rotation, R_imu_lidar=turned(T, degrees, 0)[:3, :3], covariance=covariance)
    assert contradictions(replace(seen, rotation=rotation), T) == []  # by no stretch alone
    following, stages = watch.Watch(CONFIG, T), []
    for k, slope in enumerate([1.0, 1.0, 1.0, 1.0, 1.3, 1.0, None]):
        time_ns = seen.path.time_ns - seen.path.time_ns[0] + k * 8_000_000_000
        translation = replace(seen.translation, slope=slope or 1.0, covariance=of_slope, explained=0.9)
        shown = None if slope is None else rotation
        agreement = replace(seen, path=replace(seen.path, time_ns=time_ns), rotation=shown, translation=translation)
        following._take_up(agreement)
        stages.append((following.contradiction is not None, following.mounting_borne_out))
    assert stages[0] == (False, True)
    first = next((k for k, (contradicted, _) in enumerate(stages) if contradicted), len(stages))
    assert (first < 4) == named
    assert all(contradicted and not borne_out for contradicted, borne_out in stages[first:])
    if named:
        assert following.contradiction is not None and "stretches together" in following.contradiction.text
