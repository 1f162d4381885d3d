"""Images of ROS map_server and GeoTIFF, read by others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from boxplus.errors import InputError
from boxplus.formats.geotiff import write_geotiff
from boxplus.formats.ros_map import write_ros_map


def test_a_floor_plan_is_what_map_server_reads(tmp_path: Path) -> None:
    occupied, free = np.zeros((2, 3, 4), dtype=bool)
    occupied[0, 1], free[2, 3] = True, True
    image, text = write_ros_map(tmp_path / "plan.pgm", occupied, free, 0.05, (-1.5, 2.0))
    facts = yaml.safe_load(text.read_text())
    assert facts["image"] == image.name == "plan.pgm" and facts["resolution"] == 0.05 and facts["origin"] == [-1.5, 2.0, 0]
    pixels = np.asarray(Image.open(image))
    assert pixels.shape == (3, 4)
    # As map_server decides, with row 0 at the top.
    share = (255 - pixels[::-1].astype(float)) / 255.0
    np.testing.assert_array_equal(share > facts["occupied_thresh"], occupied)
    np.testing.assert_array_equal(share < facts["free_thresh"], free)


def test_heights_come_back_with_their_place(tmp_path: Path) -> None:
    heights = np.random.default_rng(0).normal(100.0, 5.0, (7, 5))
    heights[2, 3] = np.nan
    write_geotiff(tmp_path / "h.tif", heights, 0.5, (10.0, -20.0))
    with Image.open(tmp_path / "h.tif") as image:
        np.testing.assert_array_equal(np.asarray(image), heights[::-1].astype(np.float32))
        tags = image.tag_v2  # type: ignore[attr-defined]
        assert tags[33550] == (0.5, 0.5, 0.0)
        assert tags[33922] == (0.0, 0.0, 0.0, 10.0, -16.5, 0.0)  # the upper left corner
        assert tags[42113] == "nan"


def test_what_tiff_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="less than 4 GB"):
        write_geotiff(tmp_path / "h.tif", np.broadcast_to(np.float64(0.0), (40_000, 40_000)), 1.0, (0.0, 0.0))
