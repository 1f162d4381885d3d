"""Frames as they have to come: of one shape, in the order of time; and those that come again."""

from __future__ import annotations

from boxplus.errors import InputError
from boxplus.sensors.images.image import Image
from boxplus.sensors.images.repeated_images import RepeatedImages


class FrameOrder:
    """Follows the frames of one camera.

    Attributes:
        time_ns: of the last frame [ns]; None before the first.
        again: whether the last image was the one before, to the bit.
    """

    def __init__(self) -> None:
        self.time_ns: int | None = None
        self.again = False
        self._shape: tuple[int, int] | None = None
        self._repeated = RepeatedImages()

    def take(self, time_ns: int, image: Image) -> float:
        """The next frame; returns the time since the one before, 0 for the first [s].

        Raises:
            InputError: an image of another shape, a time that does not go on.
        """
        shape, before_ns = self._shape or image.shape, self.time_ns
        if image.shape != shape:
            raise InputError(
                f"images of shape {shape}, as the first", f"{image.shape}", "resize it, or begin anew with its camera"
            )
        if before_ns is not None and time_ns <= before_ns:
            raise InputError("frames in the order of time", f"{time_ns} ns after {before_ns} ns", "sort them, or drop this one")
        self._shape, self.time_ns = shape, time_ns
        self.again = bool(self._repeated.among({0: image.grey}))
        if not self.again:
            self._repeated.keep({0: image.grey})
        return 0.0 if before_ns is None else (time_ns - before_ns) * 1e-9
