"""Images and their pyramids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.cameras.distortion import Radial
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.residuals.camera.photometric_sampling import sample
from boxplus.sensors.images.image import Image, half_camera


def test_half_is_the_mean_of_two_by_two() -> None:
    grey = np.arange(7 * 9, dtype=np.float32).reshape(7, 9)
    half = Image.from_array(grey).half().grey
    assert half.dtype == np.float32 and half.shape == (3, 4) and half.flags.c_contiguous
    for i in range(3):
        for j in range(4):
            assert half[i, j] == grey[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].mean()


@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(1.0, 5.0))
@settings(max_examples=20)
def test_a_point_keeps_its_grey_value_through_the_pyramid(a: float, b: float, depth: float) -> None:
    """In an image that is linear in u and v, halving keeps values exactly where pixel centres are mapped as they should be."""
    camera = Pinhole(40.0, 44.0, 31.2, 23.7, Radial(0.05, -0.01))
    v, u = np.mgrid[:48, :64]
    image = Image.from_array(2.0 * u - 3.0 * v)
    point = np.array([a, b, 1.0]) * depth
    values = []
    for level in image.pyramid(3):
        values.append(sample(level.grey, camera.project(point)[0])[0])
        camera = half_camera(camera)
    np.testing.assert_allclose(values, values[0], atol=1e-4)


def test_pyramid_and_colours() -> None:
    image = Image.from_array(np.zeros((48, 64)))
    assert [level.shape for level in image.pyramid(4)] == [(48, 64), (24, 32), (12, 16), (6, 8)]
    colours = np.zeros((4, 5, 4), dtype=np.uint8)
    colours[..., 0], colours[..., 1], colours[..., 2], colours[..., 3] = 100, 200, 50, 255
    np.testing.assert_allclose(Image.from_array(colours).grey, 0.299 * 100 + 0.587 * 200 + 0.114 * 50, rtol=1e-6)
    assert np.array_equal(Image.from_array(colours[..., :3]).grey, Image.from_array(colours).grey)


def test_refusals() -> None:
    with pytest.raises(InputError, match=r"image of shape \(height, width\)"):
        Image.from_array(np.zeros((4, 4, 2)))
    with pytest.raises(InputError, match="at least 2×2"):
        Image.from_array(np.zeros((1, 9)))
    with pytest.raises(InputError, match="image finite"):
        Image.from_array(np.full((4, 4), np.inf))
    image = Image.from_array(np.zeros((48, 64)))
    for levels in (0, 6):
        with pytest.raises(InputError, match=f"1 to 5 levels of an image of 64×48 pixels – got {levels}"):
            image.pyramid(levels)
    assert len(image.pyramid(5)) == 5


def test_the_constructor_looks_at_its_values() -> None:
    grey = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    assert Image(grey).grey is grey
    converted = Image(grey[:, ::2].astype(np.float64)).grey  # type: ignore[arg-type]
    assert converted.dtype == np.float32 and converted.flags.c_contiguous and converted.tolist() == grey[:, ::2].tolist()
    large = np.full((3, 4), 3e38, np.float32)  # its sum is infinite, its values are not
    assert Image(large).grey.tolist() == large.tolist()
    for wrong, told in ((np.nan, "finite – got nan at row and column"), (np.inf, "finite – got inf")):
        bad = grey.copy()
        bad[1, 2] = wrong
        with pytest.raises(InputError, match=told):
            Image(bad)
    for shape in ((12,), (1, 12), (2, 2, 3)):
        with pytest.raises(InputError, match=r"grey of shape \(height, width\), at least 2×2"):
            Image(np.zeros(shape, np.float32))
