"""What the images of one camera show: brightness, darkness, a covered lens, surroundings without corners, blur."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.info import Evidence, Verdict
from boxplus.sensors.images.camera_image import CameraImage

GAP_FACTOR = 1.5
"""Times the usual interval between images, from which on some are missing."""

_JUMP = 0.25  # of the mean brightness, between neighbours
_DARK, _BRIGHT = 15.0, 240.0
_BLOCK = 8
_EMPTY, _EMPTY_SHARE = 1.0, 0.25  # grey values between neighbouring blocks, and of the recording's median
_COVERED_AT_LEAST_S = 0.2
_FEW_CORNERS, _FEW_A_PIXEL = 40.0, 0.0004
_LITTLE_STRUCTURE = 3.0
_BLURRED = 0.35
_MANY_BLURRED = 0.1
_CHANGE = 0.5  # of the median change from image to image, before and after images that come again


@dataclass(slots=True)
class Views:
    """What is kept of the images of one camera.

    Attributes:
        time_ns: of each.
        brightness: mean in 255ths.
        structure: mean difference of neighbouring blocks of 8 × 8 pixels, grey values; noise hardly shows in it.
        sharpness: energy of the finest differences over that of four times coarser ones, along the axis where it is less.
        change: mean difference to the image before, grey values; 0 only where it is that image to the bit.
        size: (width, height) [px].
    """

    time_ns: list[int] = field(default_factory=list)
    brightness: list[float] = field(default_factory=list)
    structure: list[float] = field(default_factory=list)
    sharpness: list[float] = field(default_factory=list)
    change: list[float] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)
    _before: NDArray[np.uint8] | None = None

    def note(self, image: CameraImage, grey: NDArray[np.uint8] | None) -> None:
        """Note one image; `grey` (H, W) is left out for depths."""
        self.time_ns.append(image.time_ns)
        self.size = image.shape[1], image.shape[0]
        if grey is not None:
            self.brightness.append(float(grey[::4, ::4].mean()))
            self.structure.append(_structure(grey))
            self.sharpness.append(_sharpness(grey))
            self.change.append(_change(self._before, grey))
            self._before = grey


def _change(before: NDArray[np.uint8] | None, grey: NDArray[np.uint8]) -> float:
    if before is None or before.shape != grey.shape:
        return np.inf
    if np.array_equal(before, grey):
        return 0.0
    return max(float(np.abs(np.subtract(grey[::4, ::4], before[::4, ::4], dtype=np.float32)).mean()), 1e-6)


def _structure(grey: NDArray[np.uint8]) -> float:
    height, width = (size // _BLOCK * _BLOCK for size in grey.shape)
    if not height or not width:
        return float(np.std(grey))
    blocks = grey[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    means = blocks.mean(axis=(1, 3), dtype=np.float32)
    steps = [np.abs(np.diff(means, axis=axis)).ravel() for axis in (0, 1)]
    joined = np.concatenate(steps)
    return float(joined.mean()) if len(joined) else 0.0


def _sharpness(grey: NDArray[np.uint8]) -> float:
    height, width = (size // 4 * 4 for size in grey.shape)
    if height < 16 or width < 16:
        return 1.0
    image = grey[:height, :width].astype(np.float32)
    coarse = image.reshape(height // 4, 4, width // 4, 4).mean(axis=(1, 3))
    # Motion smears along one axis, mostly.
    ratios = [
        float((np.diff(image, axis=k) ** 2).mean()) / max(float((np.diff(coarse, axis=k) ** 2).mean()), 1e-6) for k in (0, 1)
    ]
    return min(ratios)


def check_views(name: str, views: Views) -> list[Evidence]:
    """Findings about the brightness of a camera, and whether it shows anything."""
    found = [_brightness(name, views)]
    if len(views.structure) >= 3:
        found.append(_covered(name, views))
        found += _repeats(name, views)
    return found


def _repeats(name: str, views: Views) -> list[Evidence]:
    """Images that are the one before to the bit, between images that change: nothing that moves stops and goes on so."""
    change, structure = np.array(views.change), np.array(views.structure)
    change[~np.isfinite(change)] = -1.0  # the first image
    usual = float(np.median(change[change > 0.0])) if (change > 0.0).any() else np.inf
    same = (change == 0.0) & (structure >= _EMPTY)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    runs = [
        (begin, end)
        for begin, end in zip(edges[::2], edges[1::2], strict=True)
        if change[begin - 1] > _CHANGE * usual and end < len(change) and change[end] > _CHANGE * usual
    ]
    if not runs:
        return []
    count, (begin, end) = sum(end - begin for begin, end in runs), max(runs, key=lambda run: run[1] - run[0])
    time_s = (np.array(views.time_ns) - views.time_ns[0]) * 1e-9
    text = (
        f"{count} of {len(change)} images are the one before to the bit, with another stamp, between images that change; the "
        f"longest stretch is {end - begin} from {time_s[begin]:.2f} s on: a driver that stalls, or a recorder that fills gaps"
    )
    return [Evidence(f"{name}_repeats", f"{count}", "warning", text)]


def _brightness(name: str, views: Views) -> Evidence:
    values = np.array(views.brightness)
    key = f"{name}_brightness"
    if not len(values):
        return Evidence(key, "unknown", "warning", "no image could be decoded")
    steps = np.abs(np.diff(values)) / np.maximum(values[:-1], 1.0)
    jumps = int((steps > _JUMP).sum())
    outside = int(((values < _DARK) | (values > _BRIGHT)).sum())
    text = f"means from {values.min():.0f} to {values.max():.0f} of 255"
    verdict: Verdict = "ok"
    if jumps:
        verdict = "warning"
        where = (views.time_ns[int(np.argmax(steps)) + 1] - views.time_ns[0]) * 1e-9
        text += (
            f"; {jumps} jumps by more than {100 * _JUMP:.0f} % between neighbours, the largest {where:.2f} s after the start: "
        )
        text += "features are lost there; fix the exposure or let it change slowly"
    if outside:
        verdict = "warning"
        text += f"; {outside} of {len(values)} images are almost black or almost white"
    return Evidence(key, f"{np.median(values):.0f}", verdict, text)


def _covered(name: str, views: Views) -> Evidence:
    key = f"{name}_view"
    structure, brightness = np.array(views.structure), np.array(views.brightness)
    usual = float(np.median(structure))
    value = f"{usual:.1f}"
    text = f"neighbouring blocks of 8 x 8 pixels differ by {usual:.1f} grey values in the median"
    if usual < _EMPTY:
        return Evidence(key, value, "warning", f"{text}: this camera shows nothing, no texture that could be followed")
    # An image without light shows nothing either; that is said of its brightness.
    empty = (structure < np.minimum(_EMPTY, _EMPTY_SHARE * usual)) & (brightness >= _DARK) & (brightness <= _BRIGHT)
    begin, length = _longest(empty)
    time_s = (np.array(views.time_ns) - views.time_ns[0]) * 1e-9
    lasting = float(time_s[begin + length - 1] - time_s[begin]) if length else 0.0
    if lasting >= _COVERED_AT_LEAST_S:
        text += (
            f"; from {time_s[begin]:.2f} s on the camera shows nothing for {lasting:.2f} s while there is light: "
            "the lens is covered, or close to a bare surface"
        )
        return Evidence(key, "covered", "warning", text)
    return Evidence(key, value, "ok", text)


def _longest(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """Beginning and length of the longest run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    begins, ends = edges[::2], edges[1::2]
    if not len(begins):
        return 0, 0
    longest = int(np.argmax(ends - begins))
    return int(begins[longest]), int(ends[longest] - begins[longest])


def check_blur(name: str, views: Views) -> list[Evidence]:
    """A finding about blur: images whose finest differences are small for their coarser ones, beside the recording's sharpest."""
    sharpness = np.array(views.sharpness)
    shown = np.array(views.structure) > _EMPTY
    # Where there is little but noise, the noise is what is sharp.
    if shown.sum() < 20 or float(np.median(views.structure)) < _LITTLE_STRUCTURE:
        return []
    sharpest = float(np.quantile(sharpness[shown], 0.9))
    share = float((sharpness[shown] < _BLURRED * sharpest).mean())
    text = f"{100 * share:.0f} % of the images have less than {100 * _BLURRED:.0f} % of the sharpness of the sharpest"
    if share > _MANY_BLURRED:
        text += ": blur of motion or focus; a shorter exposure or more light helps"
        return [Evidence(f"{name}_sharpness", f"{sharpest:.2f}", "warning", text)]
    return [Evidence(f"{name}_sharpness", f"{sharpest:.2f}", "ok", text)]


def check_corners(name: str, followed: list[int], views: Views) -> list[Evidence]:
    """A finding about how many corners can be followed from image to image; small images have fewer.

    Surroundings without structure leave corners of noise: there, three times as many are few.
    """
    if not followed:
        return []
    median = float(np.median(followed))
    text = f"corners of the first image found again in the second, median of {len(followed)} pairs, at most 300 are looked for"
    few = min(_FEW_CORNERS, _FEW_A_PIXEL * views.size[0] * views.size[1])
    if float(np.median(views.structure)) < _LITTLE_STRUCTURE:
        few *= 3.0
    if median < few:
        text += ": few corners, surroundings with little texture, blur or darkness"
        return [Evidence(f"{name}_corners", f"{median:.0f}", "warning", text)]
    return [Evidence(f"{name}_corners", f"{median:.0f}", "ok", text)]
