"""Images of several cameras that are taken together: which belong to one instant.

Cameras that share a trigger are often stamped one by one, as their images arrive or by clocks of their own, and their stamps then
differ by microseconds. Taken for instants of their own, these images are those of one camera alone each.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from boxplus.sensors.images.camera_image import CameraImage

TOGETHER_NS = 1_000_000
"""Images of several cameras whose stamps differ by no more belong together [ns]: a turn of 1 rad/s moves corners by half a pixel
meanwhile."""


class ImageInstants:
    """Images that wait for those of the other cameras, in the order of time.

    The time of an instant is the stamp of its camera of the lowest index.

    Args:
        cameras: how many take images.
    """

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._waiting: dict[int, dict[int, NDArray[Any]]] = {}

    def add(self, image: CameraImage) -> None:
        """Take an image: grey values (H, W) are kept. One of the same camera and stamp replaces the one before."""
        time_ns, images = image.time_ns, self._waiting.pop(image.time_ns, {})
        if not images:
            near = [other for other, waiting in self._waiting.items() if image.camera not in waiting]
            closest = min(near, key=lambda other: abs(other - time_ns), default=None)
            if closest is not None and abs(closest - time_ns) <= TOGETHER_NS:
                images = self._waiting.pop(closest)
                time_ns = time_ns if image.camera < min(images) else closest
        images[image.camera] = image.grey()
        self._waiting[time_ns] = images

    def complete(self, *, final: bool) -> list[int]:
        """Times of the instants [ns] that wait for no image, in their order; all of them where none will come (`final`).

        An instant with images of some cameras only is complete once a later one has begun.
        """
        if not self._waiting:
            return []
        newest = max(self._waiting)
        return [
            time_ns
            for time_ns in sorted(self._waiting)
            if final or time_ns < newest or len(self._waiting[time_ns]) == self._cameras
        ]

    def take(self, time_ns: int) -> dict[int, NDArray[Any]]:
        """The images (H, W) of an instant by camera, which wait no longer."""
        return self._waiting.pop(time_ns)
