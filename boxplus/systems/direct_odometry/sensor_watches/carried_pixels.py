"""Pixels that the camera carries along: an arm or the bow of its own platform, text in its images, dirt on its lens.

They have gradients like others, and no depth of a landmark fits them: they stay where they are while the camera turns. By the
rotation alone a landmark moves from pixel p to π(R m), and to stay it takes a translation that undoes that, at its own depth and
from keyframe to keyframe. At a small octave, the gradient of every pixel is compared with the one that it had at first, both by
the gain of their keyframes: of two that lie on different things hardly one in ten is the same by chance. A pixel whose gradient
stays, keyframe after keyframe, over a turn of some degrees, while a good part of the others changes, is carried along; it gets
no depth, so that nothing is tracked or adjusted by it, until its gradient changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from boxplus._jit import kernel
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_alignment.keyframe import image_noise

Floats = NDArray[np.float32]

_WIDTH = 320  # of the octave, at most
_STRIDE = 8  # pixels of it that a rotation moves alike
_SAME = 0.35  # of a gradient, by which it may change
_NOISE = 4.0  # standard deviations of the gradients' noise that one with texture has
_LEAST_PX = 2.0  # of a rotation from keyframe to keyframe that counts
_TURNED_PX, _TURNED = 20.0, 0.1  # by which rotations would have moved a pixel, in pixels and in focal lengths
_FEWEST = 4  # keyframes over which it stayed
_OTHERS = 0.25  # share of the pixels with texture that have to change, or the images stand
_TOGETHER = 0.25  # share of the pixels around one that are carried along as well
_LEAST_SHARE, _MUCH = 0.005, 0.1  # of the pixels with texture: to be left out, and to draw poses
_PLAIN, _CHANGES, _STAYS = 0, 1, 2  # kinds of pixels
_NOTHING_MOVED = np.zeros((1, 1), np.float32)


class CarriedPixels:
    """Follows the gradients of keyframes, in their order.

    Attributes:
        share: of the pixels with texture that the camera carries along; the largest so far.
    """

    def __init__(self) -> None:
        self.share, self._known_from_start = 0.0, False
        self._R_world_before: NDArray[np.float64] | None = None
        self._first = np.zeros((0, 0, 2), np.float32)  # gradients (h, w, 2)
        self._turned, self._stayed = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int16)
        self._kind = np.zeros((0, 0), np.int8)

    def begin(self, first: Image, second: Image) -> None:
        """Two images of one camera alone between which it moved, and of which a part stands still: that is carried along."""
        self._start(_small(first)[0])
        grey = _small(second)[0]
        _compare(grey, self._first, (_NOISE * _gradient_noise(grey)) ** 2, _SAME**2, self._kind)
        stays = self._kind == _STAYS
        self._turned[stays], self._stayed[stays], self._known_from_start = np.inf, _FEWEST, True

    def _start(self, grey: Floats) -> None:
        self._first, self._R_world_before = np.zeros((*grey.shape, 2), np.float32), None
        self._turned, self._stayed = np.zeros(grey.shape, np.float32), np.zeros(grey.shape, np.int16)
        self._kind = np.zeros(grey.shape, np.int8)
        _follow(grey, self._kind, _NOTHING_MOVED, np.float32(_LEAST_PX), self._first, self._turned, self._stayed)

    def find(
        self, image: Image, T_world_camera: NDArray[np.float64], log_gain: float, camera: Pinhole
    ) -> NDArray[np.bool_] | None:
        """(H, W) which pixels of a keyframe the camera carries along; None where there are none.

        Args:
            image: of the keyframe; T_world_camera: (7,) its pose; log_gain: by which its grey values are divided.
        """
        grey, step = _small(image)
        grey = grey * np.float32(np.exp(-log_gain))
        if not self._first.size:
            self._start(grey)
        R, R_before = quaternion.to_matrix(T_world_camera[:4]), self._R_world_before
        self._R_world_before = R
        texture, stay = _compare(grey, self._first, (_NOISE * _gradient_noise(grey)) ** 2, _SAME**2, self._kind)
        moved = _NOTHING_MOVED
        if R_before is not None and texture - stay >= max(_OTHERS * texture, 1):
            moved = _by_turn(R_before.T @ R, (grey.shape[0], grey.shape[1]), step, camera)
        _follow(grey, self._kind, moved, np.float32(_LEAST_PX), self._first, self._turned, self._stayed)
        carried = (self._stayed >= _FEWEST) & (self._turned >= max(_TURNED_PX, _TURNED * camera.fx))
        if carried.sum() < _LEAST_SHARE * texture:
            return None
        carried &= (self._kind == _STAYS) & (uniform_filter(carried.astype(np.float32), 5) > _TOGETHER)
        share = float(carried.sum()) / max(texture, 1)
        if share < _LEAST_SHARE:
            return None
        self.share = max(self.share, share)
        around = maximum_filter(carried, 3)
        mask = np.zeros(image.shape, np.bool_)
        whole = np.repeat(np.repeat(around, step, axis=0), step, axis=1)
        mask[: whole.shape[0], : whole.shape[1]] = whole
        return mask

    @property
    def remark(self) -> str:
        """What was found, in a sentence; empty where nothing was."""
        if not self.share:
            return ""
        return (
            f"up to {self.share:.0%} of what has texture stood still in the image while the camera moved: a part of the platform "
            "or text in view, dirt on the lens, or the middle of a circle that it moved on; it is left out from then on"
        )

    @property
    def contradiction(self) -> str:
        """That poses were drawn to it before it was known, in a sentence; empty where they hardly were."""
        if self._known_from_start or self.share < _MUCH:
            return ""
        return f"{self.remark}, and poses until then are drawn to it: cover it by a mask"


def _small(image: Image) -> tuple[Floats, int]:
    """Grey values (h, w) at an octave, and its pixels in those of the image."""
    step = 1
    while image.shape[1] > _WIDTH:
        step, image = 2 * step, image.half()
    return image.grey, step


def _gradient_noise(grey: Floats) -> float:
    """Standard deviation of the noise of central differences."""
    return image_noise(grey) * float(np.sqrt(0.5))


@kernel
def _compare(grey: Floats, first: Floats, least: float, same: float, kind: NDArray[np.int8]) -> tuple[int, int]:
    """The kind of each pixel by its gradient at first, whose square is at least `least`; how many have texture, and stay."""
    texture = stay = 0
    for i in range(1, grey.shape[0] - 1):
        for j in range(1, grey.shape[1] - 1):
            kind[i, j] = _PLAIN
            strength = first[i, j, 0] ** 2 + first[i, j, 1] ** 2
            if strength > least:
                texture += 1
                across = np.float32(0.5) * (grey[i, j + 1] - grey[i, j - 1]) - first[i, j, 0]
                down = np.float32(0.5) * (grey[i + 1, j] - grey[i - 1, j]) - first[i, j, 1]
                kind[i, j] = _CHANGES
                if across**2 + down**2 < same * strength:
                    kind[i, j] = _STAYS
                    stay += 1
    return texture, stay


@kernel
def _follow(
    grey: Floats,
    kind: NDArray[np.int8],
    moved: Floats,
    least_px: float,
    first: Floats,
    turned: Floats,
    stayed: NDArray[np.int16],
) -> None:
    """Add up the turns `moved`, by blocks of pixels, of pixels that stay; others begin anew with the gradient that they have."""
    for i in range(1, grey.shape[0] - 1):
        for j in range(1, grey.shape[1] - 1):
            if kind[i, j] == _STAYS:
                px = moved[min(i // _STRIDE, moved.shape[0] - 1), min(j // _STRIDE, moved.shape[1] - 1)]
                if px >= least_px:
                    turned[i, j] += px
                    stayed[i, j] += 1
            else:
                first[i, j, 0] = np.float32(0.5) * (grey[i, j + 1] - grey[i, j - 1])
                first[i, j, 1] = np.float32(0.5) * (grey[i + 1, j] - grey[i - 1, j])
                turned[i, j], stayed[i, j] = 0.0, 0


def _by_turn(R: NDArray[np.float64], shape: tuple[int, int], step: int, camera: Pinhole) -> Floats:
    """How far a rotation R_before_now alone moves blocks of pixels of an octave (h, w) [pixels of the image]."""
    height, width = shape
    at = step * (np.arange(max(height, width)) + 0.5) - 0.5
    every = slice(None, None, _STRIDE)
    u, v = np.meshgrid(at[:width][every], at[:height][every])
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, known = camera.unproject(pixels)
    there, seen = camera.project(rays @ R)
    moved: Floats = np.where(known & seen, np.linalg.norm(there - pixels, axis=1), 0.0).reshape(u.shape).astype(np.float32)
    return moved
