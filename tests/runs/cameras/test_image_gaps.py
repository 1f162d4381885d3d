"""Images that are missing are told from a rate that changes."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.runs.cameras.image_gaps import ImageGaps

BEGIN_NS = 10**18


def gaps(times_s: np.ndarray) -> list[tuple[float, float]]:
    watch = ImageGaps()
    for time_ns in (BEGIN_NS + np.rint(times_s * 1e9)).astype(np.int64).tolist():
        watch.add(time_ns)
    return [(round(gap.begin_s, 3), round(gap.duration_s, 3)) for gap in watch.gaps(BEGIN_NS)]


@pytest.mark.parametrize("before_hz, after_hz", [(30.0, 7.5), (60.0, 15.0), (30.0, 2.0), (2.0, 30.0), (200.0, 20.0)])
@pytest.mark.parametrize("when_s", [4.0, 9.0])
def test_a_rate_that_changes_is_no_gap(before_hz: float, after_hz: float, when_s: float) -> None:
    assert not gaps(np.concatenate([np.arange(0.0, when_s, 1.0 / before_hz), when_s + np.arange(0.0, 10.0, 1.0 / after_hz)]))


@pytest.mark.parametrize("rate_hz", [7.5, 20.0, 60.0])
def test_half_a_second_without_images_is_told_wherever_it_is(rate_hz: float) -> None:
    times = np.arange(0.0, 12.0, 1.0 / rate_hz)
    for begin in (times[1], times[30], times[-1] - 0.8):
        missing = (times > begin) & (times < begin + 0.5)
        ((begin_s, duration_s),) = gaps(times[~missing])
        assert abs(begin_s - begin) <= 1.0 / rate_hz and 0.5 - 1e-3 <= duration_s < 0.5 + 2.0 / rate_hz


def test_every_gap_is_told_at_the_rate_that_it_interrupts() -> None:
    times = np.concatenate([np.arange(0.0, 5.0, 1.0 / 30.0), 5.0 + np.arange(0.0, 5.0, 1.0 / 7.5)])
    for begin in (2.0, 7.0):
        times = times[(times <= begin) | (times >= begin + 0.6)]
    assert len(gaps(times)) == 2


def test_one_image_that_is_missing_stamps_that_go_back_and_none_at_all_are_no_gap() -> None:
    times = np.arange(0.0, 5.0, 0.05)
    assert not gaps(np.delete(times, [40, 60, 61]))
    back = times.copy()
    back[50] = times[20]
    assert not gaps(back)
    assert not gaps(times[:0]) and not gaps(times[:1]) and not gaps(np.array([0.0, 5.0]))
