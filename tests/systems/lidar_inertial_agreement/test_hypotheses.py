"""Every known mistake is named for what it is, and nothing is named where nothing is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.simulation import Fault, ImuModel, Scenario, Simulation, faults
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.scenarios import mounting
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement import agreement as agreement_module
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import (
    contradictions,
    judges_clocks,
    judges_lengths,
    judges_rotation,
    slope_of,
)
from boxplus.systems.lidar_inertial_agreement.lengths import lengths_of_many
from boxplus.systems.lidar_inertial_agreement.watch import clock_drift
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, LIDAR, data, handheld, turned

FEET = 3.28084


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 3, 6])
def test_sound_sensors_are_not_contradicted(seed: int) -> None:
    simulation = handheld(seed)
    agreement = compare_sensors(*data(simulation), CONFIG, T_declared=simulation.T_imu_lidar)
    assert contradictions(agreement, simulation.T_imu_lidar) == []
    assert agreement.rotation is not None
    assert judges_rotation(agreement) and judges_clocks(agreement.rotation)
    assert judges_lengths(agreement)


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "cause", "words"), [
    (faults.gyro_in_deg(), "gyro_unit", "reports deg/s"),
    (faults.gyro_in_rad_as_deg(), "gyro_unit", "were taken for deg/s and are rad/s"),
    (faults.flip_gyro(), "gyro_sign", "negate its rates"),
    (faults.flip_accel(), "force_sign", "its sign is flipped"),
    (faults.mirror_points(), "mirrored", "the points are mirrored"),
    (faults.scale_points(1.1), "length_scale", "not in metres"),
    (faults.scale_points(FEET), "length_scale", "feet"),
], ids=lambda value: value.name if isinstance(value, Fault) else None)  # fmt: skip
def test_mistakes_are_named(fault: Fault, cause: str, words: str) -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    found = contradictions(compare_sensors(*data(simulation, fault), CONFIG, T_declared=T), T)
    assert [finding.cause for finding in found] == [cause]
    assert words in found[0].text


@pytest.mark.slow
@pytest.mark.parametrize("offset_ms", [-500, -100, -20, 20, 50, 300])
def test_clock_offsets_are_measured(offset_ms: int) -> None:
    simulation = handheld(2)
    agreement = compare_sensors(
        *data(simulation, faults.clock_offset(offset_ms * 1e-3)), CONFIG, T_declared=simulation.T_imu_lidar
    )
    found = contradictions(agreement, simulation.T_imu_lidar)
    assert [finding.cause for finding in found] == ["time_offset"]
    assert agreement.rotation is not None
    # The IMU's stamps are late by the offset: so much has to be added to the LiDAR's times.
    assert abs(agreement.rotation.offset_s - offset_ms * 1e-3) < 0.01
    assert f"--lidar-time-offset {agreement.rotation.offset_s:.3f}" in found[0].text


def test_a_given_offset_makes_the_clocks_agree() -> None:
    simulation = handheld(2)
    scans, imu = data(simulation, faults.clock_offset(0.08))
    shifted = [scan.shifted(80_000_000) for scan in scans]
    agreement = compare_sensors(shifted, imu, CONFIG, T_declared=simulation.T_imu_lidar)
    assert contradictions(agreement, simulation.T_imu_lidar) == []
    assert agreement.rotation is not None and abs(agreement.rotation.offset_s) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [5.0, 10.0, 20.0])
def test_wrong_mountings_are_named(degrees: float) -> None:
    simulation = handheld(3)
    wrong = turned(simulation.T_imu_lidar, degrees, round(degrees))
    found = contradictions(compare_sensors(*data(simulation), CONFIG, T_declared=wrong), wrong)
    assert "extrinsic" in [finding.cause for finding in found]
    named = float(found[0].text.split(" deg apart")[0].split()[-1])
    assert abs(named - degrees) < 2.0


def test_an_inverted_mounting_is_named() -> None:
    simulation = handheld(4)
    inverse = np.linalg.inv(simulation.T_imu_lidar)
    found = contradictions(compare_sensors(*data(simulation), CONFIG, T_declared=inverse), inverse)
    assert found[0].cause == "extrinsic" and "its inverse fits" in found[0].text


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0])
def test_the_imu_of_another_platform_is_named(seed: int) -> None:
    simulation, other = handheld(seed), handheld(seed + 5)
    found = contradictions(
        compare_sensors(*data(simulation, faults.other_imu(other.imu_samples)), CONFIG, T_declared=simulation.T_imu_lidar),
        simulation.T_imu_lidar,
    )
    assert [finding.cause for finding in found] == ["not_together"]


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_a_gyroscope_that_never_changes_is_named(rate: float) -> None:
    simulation = handheld(0, seconds=4.0)
    scans, imu = data(simulation)
    agreement = compare_sensors(scans, replace(imu, gyro=np.full_like(imu.gyro, rate)), CONFIG, T_declared=simulation.T_imu_lidar)
    found = contradictions(agreement, simulation.T_imu_lidar)
    assert [finding.cause for finding in found] == ["not_together"] and "gives the same values all the time" in found[0].text


@pytest.mark.slow
def test_drifting_clocks_are_named() -> None:
    simulation = handheld(5, seconds=12.0)
    T = simulation.T_imu_lidar
    for fault, drifts in ((None, False), (faults.clock_drift(0.005), True)):
        scans, imu = data(simulation, fault)
        middle = len(scans) // 2
        early, late = (compare_sensors(part, imu, CONFIG, T_declared=T) for part in (scans[:middle], scans[middle:]))
        finding = clock_drift(early, late)
        assert (finding is not None) == drifts
        if finding is not None:
            assert finding.cause == "clock_drift" and "changed by +" in finding.text


def test_without_motion_nothing_is_claimed() -> None:
    simulation = handheld(0, speed=0.001, rate=1e-3)
    T = simulation.T_imu_lidar
    for fault in (None, faults.gyro_in_deg(), faults.flip_gyro(), faults.clock_offset(0.1)):
        agreement = compare_sensors(*data(simulation, fault), CONFIG, T_declared=T)
        assert contradictions(agreement, T) == []
        assert not judges_rotation(agreement)


def test_too_few_scans_or_samples_are_no_verdict() -> None:
    simulation = handheld(0)
    scans, imu = data(simulation)
    few = type(imu)(imu.time_ns[:1], imu.gyro[:1], imu.accel[:1])
    for agreement in (
        compare_sensors(scans[:4], imu, CONFIG),
        compare_sensors([], imu, CONFIG),
        compare_sensors(scans[:12], few, CONFIG),
    ):
        assert agreement.rotation is None and contradictions(agreement, np.eye(4)) == []


@pytest.mark.slow
def test_stretches_together_show_lengths() -> None:
    simulation = handheld(2, seconds=9.0, speed=2.2, rate=1.0)
    T = simulation.T_imu_lidar
    for fault, causes in ((None, []), (faults.scale_points(0.9), ["length_scale"])):
        scans, imu = data(simulation, fault)
        agreements = [compare_sensors(scans[k : k + 22], imu, CONFIG, T_declared=T) for k in range(0, 88, 22)]
        assert {finding.cause for agreement in agreements for finding in contradictions(agreement, T)} <= set(causes)
        slopes = [slope for slope in map(slope_of, agreements) if slope is not None]
        found = lengths_of_many(slopes)
        assert [finding.cause for finding in (found,) if finding is not None] == causes
    assert found is not None and "the points are not in metres" in found.text


@pytest.mark.slow
def test_a_path_that_misses_a_rotation_shows_no_lengths() -> None:
    """From rest a registration may lag behind: it misses the accelerations as well as the turn."""
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    agreement = compare_sensors(*data(simulation, faults.scale_points(0.9)), CONFIG, T_declared=T)
    assert [finding.cause for finding in contradictions(agreement, T)] == ["length_scale"] and judges_lengths(agreement)
    assert agreement.rotation is not None
    lagging = replace(agreement, rotation=replace(agreement.rotation, explained=0.6))
    assert contradictions(lagging, T) == []
    assert not judges_lengths(lagging) and slope_of(lagging) is None


def test_a_path_that_accelerates_out_of_nothing_flips_no_sign() -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    agreement = compare_sensors(*data(simulation, faults.flip_accel()), CONFIG, T_declared=T)
    assert [finding.cause for finding in contradictions(agreement, T)] == ["force_sign"]
    assert agreement.translation is not None and agreement.rotation is not None
    # About one axis a flipped gyroscope fits a mounting half a turn off: where none was given it may be that as well.
    about_one = replace(agreement, rotation=replace(agreement.rotation, mirrored=agreement.rotation.explained))
    for T_declared, said in ((None, True), (T, False)):
        found = contradictions(about_one, T_declared)
        assert [finding.cause for finding in found] == ["force_sign"]
        assert ("the gyroscope's sign is flipped" in found[0].text) == said
    astray = replace(agreement, translation=replace(agreement.translation, slope=-14.6))
    assert contradictions(astray, T) == []


@pytest.mark.slow
def test_a_mounting_that_explains_little_replaces_none(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = handheld(4)
    T = simulation.T_imu_lidar
    rotation = compare_sensors(*data(simulation), CONFIG, T_declared=T).rotation
    assert rotation is not None
    elsewhere = replace(rotation, R_imu_lidar=turned(T, 20.0, 0)[:3, :3])
    for explained, kept in ((0.95, False), (0.3, True)):
        fit = replace(elsewhere, explained=explained)
        monkeypatch.setattr(agreement_module, "compare_rotations", lambda *_, fit=fit: fit)
        compared = compare_sensors(*data(simulation), CONFIG, T_declared=T)
        assert np.array_equal(compared.R_imu_lidar, T[:3, :3]) == kept


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(3))
def test_points_that_may_be_mirrored_are_said_to_be(axis: int) -> None:
    """Half a turn about an axis of the points, and more about one that the motion does not show."""
    simulation = handheld(3)
    T = simulation.T_imu_lidar
    agreement = compare_sensors(*data(simulation), CONFIG, T_declared=T)
    assert agreement.rotation is not None
    covariance = agreement.rotation.covariance.copy()
    covariance[:3, :3] = np.diag([1e-4, 1e-4, 1.0])
    half_turn = 2.0 * np.outer(np.eye(3)[axis], np.eye(3)[axis]) - np.eye(3)
    R = so3.exp(np.array([0.0, 0.0, 0.5])) @ T[:3, :3] @ half_turn
    about_z = replace(agreement.rotation, R_imu_lidar=R, covariance=covariance, main_axis=np.array([0.0, 0.0, 1.0]))
    seen = replace(agreement, rotation=about_z, translation=None)
    found = contradictions(seen, T)
    assert [finding.cause for finding in found] == ["extrinsic"]
    assert "the points are mirrored" in found[0].text
    other = replace(seen.rotation, R_imu_lidar=so3.exp(np.array([1.2, 0.0, 0.0])) @ T[:3, :3])
    assert "mirrored" not in contradictions(replace(seen, rotation=other), T)[0].text


@pytest.mark.slow
@pytest.mark.parametrize(("std_deg", "off_deg", "named"), [(4.0, 80.0, True), (4.0, 15.0, False), (15.0, 80.0, False)])
def test_a_quarter_turn_is_seen_where_the_mounting_is_known_coarsely(std_deg: float, off_deg: float, named: bool) -> None:
    """As from attitudes of a stairwell, none of whose axes is known to three degrees."""
    simulation = handheld(3)
    T = simulation.T_imu_lidar
    agreement = compare_sensors(*data(simulation), CONFIG, T_declared=T)
    assert agreement.rotation is not None
    covariance = agreement.rotation.covariance.copy()
    covariance[:3, :3] = np.deg2rad(std_deg) ** 2 * np.eye(3)
    coarse = replace(agreement, rotation=replace(agreement.rotation, covariance=covariance), translation=None)
    assert contradictions(coarse, T) == []
    found = contradictions(coarse, turned(T, off_deg, 1))
    assert [finding.cause for finding in found] == ["extrinsic"] * named
    assert not named or (f"{off_deg:.0f} deg apart" in found[0].text and "found R_imu_lidar" not in found[0].text)


def test_attitudes_known_coarsely_show_no_lengths() -> None:
    simulation = handheld(4)
    agreement = compare_sensors(*data(simulation), CONFIG, T_declared=simulation.T_imu_lidar)
    assert agreement.rotation is not None and judges_lengths(agreement)
    coarse = replace(agreement, rotation=replace(agreement.rotation, coarse=True))
    assert not judges_lengths(coarse) and slope_of(coarse) is None and slope_of(agreement) is not None


@pytest.mark.slow
def test_on_a_circle_at_a_constant_rate_lengths_are_not_judged() -> None:
    """Force, bias and a turned gravity are constant there: a bend of the path by millimetres chooses between them."""
    motion = manoeuvres.constant_turn(8.0, (0.0, 0.0, 1.5), 1.3, 0.6)
    T = mounting(20.0, 10.0, 25.0, (0.0, 0.05, -0.1))
    circle = Simulation(Scenario("circle", worlds.room(seed=1), motion, LIDAR, ImuModel(), T), 1, 8.0)
    agreement = compare_sensors(*data(circle), CONFIG, T_declared=T)
    assert agreement.translation is not None
    assert not judges_lengths(agreement) and slope_of(agreement) is None
    wrong = replace(agreement, translation=replace(agreement.translation, slope=2.7, sigma=0.005, explained=0.9))
    assert "length_scale" not in [finding.cause for finding in contradictions(wrong, T)]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "rate"), [(6, 0.05), (8, 0.02), (3, 0.02)])
def test_feet_are_named_where_little_turns_and_the_fit_turns_the_mounting_far(seed: int, rate: float) -> None:
    simulation = handheld(seed, rate=rate)
    T = simulation.T_imu_lidar
    agreement = compare_sensors(*data(simulation, faults.scale_points(FEET)), CONFIG, T_declared=T)
    assert agreement.translation is not None and np.degrees(np.linalg.norm(agreement.translation.turn)) > 15.0
    assert [finding.cause for finding in contradictions(agreement, T)] == ["length_scale"]


def test_a_few_poses_show_no_lengths() -> None:
    """Two seconds of a LiDAR at 5 Hz are ten poses, which fit lengths twice the right ones to millimetres."""
    simulation = handheld(0, seconds=3.0)
    agreement = compare_sensors(*data(simulation), CONFIG, T_declared=simulation.T_imu_lidar)
    assert agreement.translation is not None
    covariance = np.diag([1e-4] * 13)
    for samples, causes in ((10, []), (20, ["length_scale"])):
        fit = replace(agreement.translation, slope=2.15, covariance=covariance, sigma=0.004, explained=0.92)
        fit = replace(fit, samples=samples, slope_reserve=0.0)
        doubtful = replace(agreement, translation=fit)
        assert [finding.cause for finding in contradictions(doubtful, simulation.T_imu_lidar)] == causes
        assert judges_lengths(doubtful) == bool(causes) and (slope_of(doubtful) is None) == (not causes)


def test_what_few_groups_of_poses_leave_unsure_counts_for_a_stretch_alone() -> None:
    simulation = handheld(0, seconds=3.0)
    agreement = compare_sensors(*data(simulation), CONFIG, T_declared=simulation.T_imu_lidar)
    assert agreement.translation is not None
    fit = replace(agreement.translation, slope=0.87, covariance=np.diag([1e-3] * 13), sigma=0.004, explained=0.92, samples=40)
    fit = replace(fit, excursion_m=100.0)
    for reserve, causes in ((0.0, ["length_scale"]), (1.3e-3, [])):
        alone = replace(agreement, translation=replace(fit, slope_reserve=reserve))
        assert [finding.cause for finding in contradictions(alone, simulation.T_imu_lidar)] == causes
        assert slope_of(alone) == (0.87, pytest.approx(np.hypot(np.sqrt(1e-3), 0.03)))
