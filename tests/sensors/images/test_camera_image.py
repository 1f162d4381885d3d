"""Images as they were recorded: which pixels are taken, and the grey values of colours."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.sensors.images.camera_image import CameraImage


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_grey_values_of_colours_keep_their_type_and_range(kind: type[np.unsignedinteger]) -> None:
    largest = np.iinfo(kind).max
    pixels = np.array([[[largest, largest, largest], [0, 0, 0], [largest, 0, 0], [0, largest, 0], [0, 0, largest]]], kind)
    grey = CameraImage(0, "cam0", 0, pixels).grey()
    assert grey.dtype == kind
    np.testing.assert_allclose(grey[0] / largest, [1.0, 0.0, 0.299, 0.587, 0.114], atol=0.5 / largest + 1e-6)


@pytest.mark.parametrize("pixels", [
    np.zeros((4, 5), np.float32), np.zeros((4, 5, 3), np.int16), np.zeros((4, 5, 4), np.uint8), np.zeros((0, 5), np.uint8),
], ids=["floats", "signed", "four channels", "empty"])  # fmt: skip
def test_what_is_no_image_of_intensities_is_refused(pixels: np.ndarray) -> None:
    with pytest.raises(InputError, match="intensities"):
        CameraImage(0, "cam0", 0, pixels)
