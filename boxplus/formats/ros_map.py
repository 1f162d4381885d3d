"""Floor plans for ROS: the image and the YAML file that map_server and nav2_map_server read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.output import atomic_file

_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205  # as map_saver writes them


def write_ros_map(
    path: str | Path, occupied: NDArray[np.bool_], free: NDArray[np.bool_], resolution: float, origin: tuple[float, float]
) -> tuple[Path, Path]:
    """Write `<path>.pgm` and `<path>.yaml` (the ending of `path` is left out); returns both.

    Args:
        occupied, free: (rows, columns), row 0 at the bottom; a cell that is neither is unknown.
        resolution: side of a cell [m]; origin: x, y of the lower left corner in the map's frame [m].

    Raises:
        OutputError: a file cannot be written.

    Source: the map_server page of the ROS wiki (image, resolution, origin, thresholds, trinary mode).
    """
    stem = Path(path).with_suffix("")
    image, text = stem.with_name(stem.name + ".pgm"), stem.with_name(stem.name + ".yaml")
    values = np.where(occupied, _OCCUPIED, np.where(free, _FREE, _UNKNOWN)).astype(np.uint8)[::-1]
    with atomic_file(image) as file:
        file.write(f"P5\n# {resolution:g} m a pixel\n{values.shape[1]} {values.shape[0]}\n255\n".encode())
        file.write(np.ascontiguousarray(values).tobytes())
    with atomic_file(text) as file:
        file.write(
            f"image: {image.name}\nmode: trinary\nresolution: {resolution:.9g}\norigin: [{origin[0]:.9g}, {origin[1]:.9g}, 0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n".encode()
        )
    return image, text
