"""What is handed on is all but the glitches, however the samples are cut into blocks."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.sensors.inertial.glitch_filter import GlitchFilter
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_values import EMPTY, GLITCH
from tests.sensors.inertial.test_imu_values import moving


@given(st.integers(0, 10_000), st.lists(st.integers(12, 57), max_size=4), st.lists(st.integers(0, 60), max_size=8))
@settings(deadline=None)
def test_glitches_are_left_out_and_nothing_else(seed: int, glitches: list[int], cuts: list[int]) -> None:
    imu, alone = moving(seed, 200.0), sorted(k for k in set(glitches) if not {k - 1, k + 1} & set(glitches))
    imu.gyro[alone] += 60.0
    filtering = GlitchFilter()
    taken = [filtering.take(imu.where(slice(*ends))) for ends in zip([0, *sorted(cuts)], [*sorted(cuts), 60], strict=True)]
    handed_on = ImuSamples.joined([*taken, filtering.rest()])
    assert filtering.rejected == ({GLITCH: len(alone)} if alone else {})
    assert np.setdiff1d(imu.time_ns, handed_on.time_ns).tolist() == imu.time_ns[alone].tolist()
    assert (np.diff(handed_on.time_ns) > 0).all()


def test_a_turn_that_begins_at_once_waits_for_one_sample() -> None:
    gyro = np.zeros((20, 3))
    gyro[10:, 2] = 30.0
    imu, filtering = ImuSamples(5_000_000 * np.arange(20), gyro, np.ones((20, 3))), GlitchFilter()
    handed_on = [len(filtering.take(imu.where(slice(k, k + 1)))) for k in range(20)]
    assert handed_on == [1] * 10 + [0, 2] + [1] * 8 and filtering.rejected == {}
    assert len(filtering.rest()) == 0


def test_zeros_amid_measurements_are_left_out_and_an_imu_that_gives_nothing_else_is_not() -> None:
    imu = moving(1, 200.0)
    for k in (0, 7, 8, 30):
        imu.gyro[k] = imu.accel[k] = 0.0
    for size in (1, 60):
        filtering = GlitchFilter()
        handed_on = [filtering.take(imu.where(slice(k, k + size))) for k in range(0, 60, size)]
        assert filtering.rejected == {EMPTY: 3}  # nobody knows yet at the first one
        assert sum(len(block) for block in handed_on) == 57
    dead, filtering = ImuSamples(imu.time_ns, np.zeros((60, 3)), np.zeros((60, 3))), GlitchFilter()
    assert len(filtering.take(dead)) == 60 and filtering.rejected == {}
