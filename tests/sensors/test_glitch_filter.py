"""What is handed on is all but the glitches, however the samples are cut into blocks."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.sensors.glitch_filter import GlitchFilter
from boxplus.sensors.imu import ImuSamples
from tests.sensors.test_imu_values import moving


@given(st.integers(0, 10_000), st.lists(st.integers(5, 57), max_size=4), st.lists(st.integers(0, 60), max_size=8))
@settings(deadline=None)
def test_glitches_are_left_out_and_nothing_else(seed: int, glitches: list[int], cuts: list[int]) -> None:
    imu, alone = moving(seed, 200.0), sorted(k for k in set(glitches) if k - 1 not in glitches and k + 1 not in glitches)
    imu.gyro[alone] += 60.0
    filtering = GlitchFilter()
    taken = [filtering.take(imu.where(slice(*ends))) for ends in zip([0, *sorted(cuts)], [*sorted(cuts), 60], strict=True)]
    handed_on = ImuSamples.joined([*taken, filtering.rest()])
    assert filtering.found == len(alone)
    assert np.setdiff1d(imu.time_ns, handed_on.time_ns).tolist() == imu.time_ns[alone].tolist()
    assert (np.diff(handed_on.time_ns) > 0).all()


def test_a_turn_that_begins_at_once_waits_for_one_sample() -> None:
    gyro = np.zeros((20, 3))
    gyro[10:, 2] = 30.0
    imu, filtering = ImuSamples(5_000_000 * np.arange(20), gyro, np.ones((20, 3))), GlitchFilter()
    handed_on = [len(filtering.take(imu.where(slice(k, k + 1)))) for k in range(20)]
    assert handed_on == [1] * 10 + [0, 2] + [1] * 8 and filtering.found == 0
    assert len(filtering.rest()) == 0
