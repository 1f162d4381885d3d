"""What a motion shows of the sensors is what an error of would have been named, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.simulation import Simulation
from boxplus.simulation.lidar import SpinningLidar
from boxplus.simulation.motions.manoeuvres import constant_velocity, level
from boxplus.simulation.scenarios import Scenario, mounting
from boxplus.simulation.worlds.worlds import hall
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions, slope_of
from boxplus.systems.lidar_inertial_agreement.lengths import lengths_of_many, slope_finding
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
    assert not gyroscope.shown and gyroscope.text == "the gyroscope's scale"


def test_at_a_steady_speed_nothing_is_shown() -> None:
    motion = constant_velocity(4.0, (-6.0, 0.0, 1.5), (2.0, 0.0, 0.0), level(0.2))
    T = mounting(2.0, -3.0, 25.0, (0.1, 0.0, 0.2))
    scenario = Scenario("hall", hall(seed=3), motion, SpinningLidar(azimuth_steps=450), T_imu_lidar=T)
    simulation = Simulation(scenario, seed=3, duration_s=4.0)
    scans, imu = data(simulation)
    parts = _parts(compare_sensors(scans, imu, CONFIG, T_declared=simulation.T_imu_lidar))
    assert not any(part.shown for part in parts.values())
    assert parts["lengths"].text == "lengths: points too long or too short by any factor"


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
    assert _parts(first)["mounting"].text == "the rotation of T_imu_lidar about one axis"
    assert not _parts(first, first)["mounting"].shown
    assert _parts(first, second)["mounting"].shown


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(0.99, 1.01), st.floats(0.03, 0.29)), min_size=1, max_size=6), st.sampled_from([-1.0, 1.0]))
def test_lengths_are_named_beyond_what_goes_unnoticed(slopes: list[tuple[float, float]], sign: float) -> None:
    lengths = ShownByMotion().parts(slopes)[3]
    assert lengths.unnoticed is not None and lengths.value is not None and lengths.std is not None
    assert lengths.shown == (lengths.unnoticed <= 0.1)
    for factor, named in ((1.05, True), (0.95, False)):
        moved = [(slope + 1.0 - lengths.value + sign * factor * lengths.unnoticed, std) for slope, std in slopes]
        finding = lengths_of_many(moved) if len(moved) > 1 else slope_finding(*moved[0])
        if lengths.std < 0.3 and min(slope for slope, _ in moved) > 0.0:
            assert (finding is not None) == named
