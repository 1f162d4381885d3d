"""What a camera delivers: a time-stamped image as it was recorded, of intensities or of depths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import require
from boxplus.errors import InputError

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # red, green, blue (ITU-R BT.601)


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """One image of one camera, u to the right, v down, pixel centres at integers.

    Attributes:
        camera: index of the camera in its recording (`recording.info.cameras`).
        name: of that camera.
        time_ns: absolute time [ns], in the clock of the IMU where the recording says how they differ.
        pixels: intensities (H, W) uint8 or uint16, or colours (H, W, 3) of either in the order red, green, blue;
            depths (H, W) uint16 or float32, along the optical axis, in units of `depth_unit_m`.
        exposure_s: how long the shutter was open [s], or None where the recording does not say.
        depth_unit_m: metres of one count of a depth image; None: the image holds intensities.

    Raises:
        InputError: pixels of another shape or type, or a depth unit that is not positive.

    Example:
        >>> image = bp.CameraImage(0, "cam0", 1_403_636_579_763_555_584, np.zeros((480, 752), np.uint8))
        >>> image.shape, image.is_depth
        ((480, 752), False)
    """

    camera: int
    name: str
    time_ns: int
    pixels: NDArray[Any]
    exposure_s: float | None = None
    depth_unit_m: float | None = None

    def __post_init__(self) -> None:
        require(self.pixels, np.ndarray, "pixels as an array", "convert the image with np.asarray")
        for name in ("camera", "time_ns"):
            require(getattr(self, name), (int, np.integer), f"{name} as an integer", "times are nanoseconds, cameras numbers")
        require(self.name, str, "name as text", "give that of the topic, the folder or the sensor")
        pixels, kind = self.pixels, np.dtype(self.pixels.dtype)
        if self.depth_unit_m is not None:
            if not 0.0 < self.depth_unit_m < np.inf:
                raise InputError("depth_unit_m positive and finite [m]", f"{self.depth_unit_m}", "None for intensities")
            fits = pixels.ndim == 2 and kind in (np.uint16, np.float32)
        else:
            fits = (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)) and kind in (np.uint8, np.uint16)
        if not fits or min(pixels.shape) < 1:
            raise InputError(
                "intensities (H, W) or colours (H, W, 3), uint8 or uint16, or depths (H, W) uint16 or float32 with their unit",
                f"{kind} of shape {pixels.shape}",
                "convert the array first",
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return int(self.pixels.shape[0]), int(self.pixels.shape[1])

    @property
    def is_depth(self) -> bool:
        """Whether the pixels are depths."""
        return self.depth_unit_m is not None

    def grey(self) -> NDArray[Any]:
        """Intensities (H, W) in the type they were recorded with; colours become 0.299 R + 0.587 G + 0.114 B, rounded.

        Raises:
            InputError: a depth image.
        """
        if self.is_depth:
            raise InputError("an image of intensities", f"depths of {self.name}", "take depth() of it")
        if self.pixels.ndim == 2:
            return self.pixels
        grey: NDArray[Any] = np.rint(self.pixels.astype(np.float32) @ LUMA).astype(self.pixels.dtype)
        return grey

    def depth(self) -> NDArray[np.float32]:
        """Depths (H, W) along the optical axis [m], NaN where the sensor measured none (a count of zero, or not finite).

        Raises:
            InputError: an image of intensities.
        """
        if self.depth_unit_m is None:
            raise InputError("a depth image", f"intensities of {self.name}", "take grey() of it")
        metres: NDArray[np.float32] = (self.pixels.astype(np.float64) * self.depth_unit_m).astype(np.float32)
        metres[~(np.isfinite(metres) & (self.pixels > 0))] = np.nan
        return metres
