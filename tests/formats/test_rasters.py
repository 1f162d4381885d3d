"""Images of ROS map_server and GeoTIFF, read by others."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import yaml
from PIL import Image

from boxplus.errors import InputError, OutputError
from boxplus.formats.geotiff import write_geotiff
from boxplus.formats.ros_map import write_ros_map
from boxplus.sensors.satellites.geodesy import EnuFrame


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
    frame = EnuFrame(48.1, 11.5, 520.0)
    for projection in (None, frame.projection):
        write_geotiff(tmp_path / "h.tif", heights, 0.5, (10.0, -20.0), projection=projection, description="up")
        with rasterio.open(tmp_path / "h.tif") as file:
            np.testing.assert_array_equal(file.read(1), heights[::-1].astype(np.float32))
            assert file.xy(6, 0) == (10.25, -19.75)  # the centre of the lower left cell
            assert file.descriptions == ("up",) and np.isnan(file.nodata)
            assert (file.crs is None) == (projection is None)
            crs = file.crs
    # What another library makes of a cell, with the coordinate system that the file carries.
    to_file = pyproj.Transformer.from_crs(4326, crs.to_wkt(), always_xy=True)
    latitude, longitude, _ = frame.to_geodetic([[700.0, -300.0, 12.0]])[0]
    assert to_file.transform(longitude, latitude) == pytest.approx((700.0, -300.0), abs=0.005)


def test_geotiffs_that_cannot_be_written_are_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OutputError, match="expected to write"):
        write_geotiff(tmp_path / "none" / "h.tif", np.zeros((2, 2)), 1.0, (0.0, 0.0))
    with pytest.raises(InputError, match="a projection that PROJ knows"):
        write_geotiff(tmp_path / "h.tif", np.zeros((2, 2)), 1.0, (0.0, 0.0), projection="+proj=nothing")
    assert not list(tmp_path.iterdir())
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(InputError, match=r"rasterio, which writes GeoTIFF .* pip install .*rasterio"):
        write_geotiff(tmp_path / "h.tif", np.zeros((2, 2)), 1.0, (0.0, 0.0))
