"""What a motion shows of the sensors is what an error of would have been named, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.simulation import Simulation
from boxplus.simulation.lidar import SpinningLidar
from boxplus.simulation.motions.manoeuvres import constant_velocity, level
from boxplus.simulation.scenarios import Scenario, mounting
from boxplus.simulation.worlds.worlds import hall
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.finding import Cause, Finding
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions, slope_of
from boxplus.systems.lidar_inertial_agreement.lengths import lengths_of_many
from boxplus.systems.lidar_inertial_agreement.mountings import mounting_of_many, turn_from
from boxplus.systems.lidar_inertial_agreement.shown import Shown, ShownByMotion
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld


def _parts(*agreements: Agreement) -> dict[str, Shown]:
    shown = ShownByMotion()
    for agreement in agreements:
        shown.add(agreement)
    slopes = [slope for slope in map(slope_of, agreements) if slope is not None]
    return {part.part: part for part in shown.parts(slopes)}


@pytest.fixture(scope="module")
def walk() -> tuple[Simulation, Agreement]:
    simulation = handheld(4)
    scans, imu = data(simulation)
    return simulation, compare_sensors(scans, imu, CONFIG, T_declared=simulation.T_imu_lidar)


def test_a_lively_motion_shows_turns_and_clocks(walk: tuple[Simulation, Agreement]) -> None:
    parts = _parts(walk[1])
    assert parts["gyroscope"].shown and parts["clocks"].shown and parts["mounting"].shown
    assert parts["gyroscope"].value == pytest.approx(1.0, abs=0.05)
    assert parts["clocks"].value == pytest.approx(0.0, abs=0.01)


def test_what_is_shown_is_named_where_it_is_wrong(walk: tuple[Simulation, Agreement]) -> None:
    simulation, agreement = walk
    rotation, T = agreement.rotation, simulation.T_imu_lidar
    assert rotation is not None
    clocks, gyroscope = _parts(agreement)["clocks"], _parts(agreement)["gyroscope"]
    assert clocks.unnoticed is not None and gyroscope.unnoticed is not None
    for factor, named in ((1.1, True), (0.9, False)):
        late = replace(rotation, offset_s=factor * clocks.unnoticed)
        assert ("time_offset" in [f.cause for f in contradictions(replace(agreement, rotation=late), T)]) == named
        fast = replace(rotation, scale=1.0 + factor * gyroscope.unnoticed)
        assert ("gyro_scale" in [f.cause for f in contradictions(replace(agreement, rotation=fast), T)]) == named


def test_turns_that_are_explained_coarsely_show_unit_and_sign_alone(walk: tuple[Simulation, Agreement]) -> None:
    rotation = walk[1].rotation
    assert rotation is not None
    gyroscope = _parts(replace(walk[1], rotation=replace(rotation, explained=0.9)))["gyroscope"]
    assert not gyroscope.shown and gyroscope.text == "a wrong scale of the gyroscope"


def test_at_a_steady_speed_nothing_is_shown() -> None:
    motion = constant_velocity(4.0, (-6.0, 0.0, 1.5), (2.0, 0.0, 0.0), level(0.2))
    T = mounting(2.0, -3.0, 25.0, (0.1, 0.0, 0.2))
    scenario = Scenario("hall", hall(seed=3), motion, SpinningLidar(azimuth_steps=450), T_imu_lidar=T)
    simulation = Simulation(scenario, seed=3, duration_s=4.0)
    scans, imu = data(simulation)
    parts = _parts(compare_sensors(scans, imu, CONFIG, T_declared=simulation.T_imu_lidar))
    assert not any(part.shown for part in parts.values())
    assert parts["lengths"].text == "points too long or too short by any factor"


def test_axes_are_shown_by_one_stretch_each(walk: tuple[Simulation, Agreement]) -> None:
    _, agreement = walk
    rotation = agreement.rotation
    assert rotation is not None
    one = rotation.covariance.copy()
    one[:3, :3] = np.diag([1e-4, 1.0, 1e-4])
    other = rotation.covariance.copy()
    other[:3, :3] = np.diag([1e-4, 1e-4, 1.0])
    first = replace(agreement, rotation=replace(rotation, covariance=one))
    later = replace(agreement.path, time_ns=agreement.path.time_ns + 10_000_000_000)
    second = replace(agreement, path=later, rotation=replace(rotation, covariance=other))
    assert _parts(first)["mounting"].text == "a wrong rotation of T_imu_lidar about one axis, by turns"
    assert not _parts(first, first)["mounting"].shown
    assert _parts(first, second)["mounting"].shown


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(0.99, 1.01), st.floats(0.03, 0.29)), min_size=2, max_size=6), st.sampled_from([-1.0, 1.0]))
def test_lengths_are_named_beyond_what_goes_unnoticed(slopes: list[tuple[float, float]], sign: float) -> None:
    lengths = ShownByMotion().parts(slopes)[3]
    if lengths.unnoticed is None:  # never named
        return
    assert lengths.value is not None
    assert lengths.shown == (lengths.unnoticed <= 0.1)
    for factor, named in ((1.05, True), (0.95, False)):
        moved = [(slope + 1.0 - lengths.value + sign * factor * lengths.unnoticed, std) for slope, std in slopes]
        finding = lengths_of_many(moved)
        if min(slope for slope, _ in moved) > 0.0:
            assert (finding is not None) == named


def test_a_factor_known_to_a_third_is_never_named() -> None:
    slopes = [(0.5, 0.1), (1.5, 0.1), (2.5, 0.1)]
    assert lengths_of_many(slopes) is None
    lengths = ShownByMotion().parts(slopes)[3]
    assert not lengths.shown and lengths.unnoticed is None and "by any factor" in lengths.text


@pytest.mark.parametrize(("offset_s", "side"), [(0.05, "early"), (-0.05, "late")])
def test_clocks_are_told_as_where_they_are_named(walk: tuple[Simulation, Agreement], offset_s: float, side: str) -> None:
    rotation = walk[1].rotation
    assert rotation is not None
    moved = replace(walk[1], rotation=replace(rotation, offset_s=offset_s))
    (finding,) = (f for f in contradictions(moved, walk[0].T_imu_lidar) if f.cause == "time_offset")
    assert f"50 ± {rotation.offset_std_s * 1e3:.0f} ms {side}" in finding.text
    assert f"50.0 ± {rotation.offset_std_s * 1e3:.1f} ms {side}" in _parts(moved)["clocks"].text


@settings(max_examples=30)
@given(st.integers(1, 6), st.floats(0.005, 0.04), st.integers(0, 2**32 - 1))
def test_a_mounting_is_named_beyond_what_goes_unnoticed(
    walk: tuple[Simulation, Agreement], count: int, std: float, seed: int
) -> None:
    """By stretches together, or by one alone."""
    simulation, agreement = walk
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    assert agreement.rotation is not None
    covariance = agreement.rotation.covariance.copy()
    covariance[:3, :3], covariance[:3, 3:], covariance[3:, :3] = std**2 * np.eye(3), 0.0, 0.0
    fit = replace(agreement.rotation, covariance=covariance, R_imu_lidar=simulation.T_imu_lidar[:3, :3])
    shown = ShownByMotion(simulation.T_imu_lidar[:3, :3])
    for k in range(count):
        later = replace(agreement.path, time_ns=agreement.path.time_ns + k * 10_000_000_000)
        shown.add(replace(agreement, path=later, rotation=fit))
    mounting = shown.parts([])[2]
    assert mounting.unnoticed is not None
    for factor, named in ((1.05, True), (0.95, False)):
        R = so3.exp(factor * np.radians(mounting.unnoticed) * axis) @ fit.R_imu_lidar
        turned = replace(fit, R_imu_lidar=R)
        if count > 1:
            found = mounting_of_many([turn_from(turned, fit.R_imu_lidar)] * count) is not None
        else:
            findings = contradictions(replace(agreement, rotation=turned), simulation.T_imu_lidar)
            found = any(finding.cause == "extrinsic" for finding in findings)
        assert found == named


@pytest.mark.parametrize(
    ("cause", "parts"),
    [("gyro_sign", {"gyroscope"}), ("not_together", {"gyroscope", "clocks", "mounting"}), ("length_scale", {"lengths"})],
)
def test_what_contradicts_has_been_shown(cause: Cause, parts: set[str]) -> None:
    found = ShownByMotion().parts([], Finding(cause, "wrong"))
    assert {part.part for part in found if part.shown} == parts
    assert all(part.text == "found wrong: wrong" for part in found if part.shown)
