"""What cameras saw of a target: corners in images, one row each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError

_COLUMNS = ("frame_of", "camera_of", "corner_of")


@dataclass(frozen=True, slots=True, eq=False)
class TargetCorners:
    """Corners of one target in the images of a rig of cameras.

    Images of one *frame* were taken at one time.

    Attributes:
        names: of the frames, for messages: numbers or times as the file has them.
        frame_of, camera_of, corner_of: (N,) which frame, camera and corner of the target.
        pixels: (N, 2) where, pixel centres at integers [px].
        sizes: (width, height) of every camera's images [px].
        time_ns: (F,) int64 time of every frame, increasing, or None where it is not known.

    Raises:
        InputError: arrays that do not match, pixels that are not finite or not in the image, a corner twice in an image.

    Example:
        >>> from boxplus.simulation.cameras.target_session import simulate_target_session
        >>> target = bp.AprilGrid(rows=4, columns=4, tag_size=0.1, spacing=0.3)
        >>> lens = bp.Pinhole(460.0, 460.0, 370.0, 240.0, bp.RadialTangential(-0.28, 0.07, 0.0, 0.0))
        >>> mounting = [[1.0, 0, 0, 0, 0, 0, 0]]
        >>> session = simulate_target_session([lens], mounting, (752, 480), target, frames=16, rate_hz=2.0, seed=1)
        >>> session.corners.pixels.shape[1], session.corners.sizes
        (2, ((752, 480),))
    """

    names: tuple[str, ...]
    frame_of: NDArray[np.intp]
    camera_of: NDArray[np.intp]
    corner_of: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sizes: tuple[tuple[int, int], ...]
    time_ns: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        count = len(self.pixels)
        if self.pixels.shape != (count, 2) or any(getattr(self, name).shape != (count,) for name in _COLUMNS):
            shapes = ", ".join(f"{name} {getattr(self, name).shape}" for name in _COLUMNS)
            raise InputError("pixels (N, 2) and three columns (N,)", f"{self.pixels.shape} and {shapes}", "give one row a corner")
        for name, most in zip(_COLUMNS[:2], (len(self.names), len(self.sizes)), strict=True):
            column = getattr(self, name)
            if count and not (column.min() >= 0 and column.max() < most):
                raise InputError(f"{name} from 0 to {most - 1}", f"{column.min()} to {column.max()}", "check the corner file")
        if not np.isfinite(self.pixels).all():
            raise InputError("finite pixels", "NaN or infinite ones", "leave such corners out")
        size = np.array(self.sizes, dtype=np.float64).reshape(-1, 2)[self.camera_of]
        outside = ((self.pixels < -0.5) | (self.pixels > size - 0.5)).any(axis=1)
        if outside.any():
            n = int(np.argmax(outside))
            camera = int(self.camera_of[n])
            raise InputError(
                f"corners inside of images of {' x '.join(map(str, self.sizes[camera]))} px of camera {camera}",
                f"({self.pixels[n, 0]:.1f}, {self.pixels[n, 1]:.1f}) and {int(outside.sum()) - 1} more outside",
                "give the resolution of the images that the corners were found in",
            )
        keys = np.stack([self.frame_of, self.camera_of, self.corner_of], axis=1)
        if len(np.unique(keys, axis=0)) < count:
            raise InputError("every corner at most once in an image", "some twice", "repair the corner file")

    @property
    def cameras(self) -> int:
        """How many cameras the rig has."""
        return len(self.sizes)

    def rows(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> TargetCorners:
        """The same of some of the corners; frames and cameras keep their numbers."""
        return TargetCorners(
            self.names, self.frame_of[chosen], self.camera_of[chosen], self.corner_of[chosen], self.pixels[chosen],
            self.sizes, self.time_ns,
        )  # fmt: skip

    def of_camera(self, camera: int) -> TargetCorners:
        """What one camera saw."""
        return self.rows(self.camera_of == camera)
