"""Which images belong to one instant: stamps of cameras that are triggered together differ by a little."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus import CameraImage
from boxplus.sensors.images.image_instants import TOGETHER_NS, ImageInstants

PERIOD_NS = 5_000_000


def image(camera: int, time_ns: int, value: int = 0) -> CameraImage:
    return CameraImage(camera, f"cam{camera}", time_ns, np.full((2, 3), value, np.uint8))


@given(st.integers(1, 4), st.integers(1, 6), st.data())
def test_stamps_that_differ_by_less_than_a_millisecond_are_of_one_instant(cameras: int, count: int, data: st.DataObject) -> None:
    late = st.lists(st.integers(0, TOGETHER_NS // 2), min_size=cameras, max_size=cameras)
    stamps = [[PERIOD_NS * (index + 1) + by for by in data.draw(late)] for index in range(count)]
    images = [image(camera, time_ns, index) for index, times in enumerate(stamps) for camera, time_ns in enumerate(times)]
    instants, taken = ImageInstants(cameras), []
    for each in sorted(images, key=lambda each: each.time_ns):
        instants.add(each)
        taken += [(time_ns, instants.take(time_ns)) for time_ns in instants.complete(final=False)]
    assert [time_ns for time_ns, _ in taken] == [times[0] for times in stamps]
    for index, (_, together) in enumerate(taken):
        assert set(together) == set(range(cameras)) and {int(pixels[0, 0]) for pixels in together.values()} == {index}
    assert instants.complete(final=True) == []


def test_stamps_farther_apart_are_instants_of_their_own() -> None:
    instants = ImageInstants(2)
    instants.add(image(0, PERIOD_NS))
    instants.add(image(1, PERIOD_NS + TOGETHER_NS + 1))
    assert instants.complete(final=False) == [PERIOD_NS] and set(instants.take(PERIOD_NS)) == {0}
    assert instants.complete(final=False) == [] and instants.complete(final=True) == [PERIOD_NS + TOGETHER_NS + 1]


def test_an_image_that_has_no_partner_waits_for_the_next_instant() -> None:
    instants = ImageInstants(2)
    for camera, time_ns in itertools.product((1, 0), (PERIOD_NS, 2 * PERIOD_NS)):
        if (camera, time_ns) != (1, PERIOD_NS):
            instants.add(image(camera, time_ns))
    assert instants.complete(final=False) == [PERIOD_NS, 2 * PERIOD_NS]
    assert set(instants.take(PERIOD_NS)) == {0} and set(instants.take(2 * PERIOD_NS)) == {0, 1}


def test_an_image_again_replaces_the_one_before() -> None:
    instants = ImageInstants(2)
    for value in (1, 2):
        instants.add(image(0, PERIOD_NS, value))
    assert instants.complete(final=True) == [PERIOD_NS] and instants.take(PERIOD_NS)[0][0, 0] == 2
