"""Two cameras: are their images taken together, and does the calibration fit them, or another reading of it?"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.cameras.calibration import inverse
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.sensors.images.image_instants import TOGETHER_NS

Floats = NDArray[np.float64]

_FEWEST = 50
_EPIPOLAR_PX = 1.5
_FITS_SHARE, _FITS_PX = 0.2, 0.3
_IMAGES = {
    "turned upside down": (True, True),
    "mirrored left to right": (True, False),
    "mirrored top to bottom": (False, True),
}
"""What may have been done to images of both cameras: whether u, and v, count from the other end."""
_MOST_LOG_RATIO, _COARSE, _FINE = 0.7, 0.02, 0.002  # of focal lengths
_PARALLAX_PX = 2.0
_MOST_BEHIND = 0.5
_FARTHEST_M = 10.0


@dataclass(slots=True)
class Corners:
    """Pixels (N, 2) of corners in the images of the first and the second camera of one instant."""

    first: list[Floats] = field(default_factory=list)
    second: list[Floats] = field(default_factory=list)

    def joined(self) -> tuple[Floats, Floats]:
        """All of them."""
        none = [np.zeros((0, 2))]
        return np.concatenate(self.first or none), np.concatenate(self.second or none)


def check_synchronisation(pair: list[CameraStream], times_ns: list[list[int]]) -> Evidence:
    """Whether both cameras take their images together."""
    one, two = (np.array(time_ns, np.int64) for time_ns in times_ns)
    key = f"{pair[0].name}_{pair[1].name}_synchronisation"
    if len(one) < 2 or not len(two):
        return Evidence(key, "unknown", "warning", f"{len(one)} and {len(two)} images: nothing to compare")
    period = float(np.median(np.diff(one)))
    at = np.clip(np.searchsorted(two, one), 1, max(len(two) - 1, 1))
    nearest = np.where(np.abs(two[at - 1] - one) <= np.abs(two[np.minimum(at, len(two) - 1)] - one), at - 1, at)
    nearest = np.minimum(nearest, len(two) - 1)
    apart = (two[nearest] - one) * 1e-6
    partners = np.abs(apart) < 0.25e-6 * period
    alone = int((~partners).sum())
    usual = float(np.median(np.abs(apart[partners]))) if partners.any() else float("inf")
    text = f"{len(one)} and {len(two)} images; {alone} without a partner; stamps of a pair are {usual:.3f} ms apart in the median"
    if not partners.any():
        return Evidence(key, "none", "error", f"{text}: these cameras are not synchronised, their images are no stereo pairs")
    if usual > 1e-6 * TOGETHER_NS or alone > 0.1 * len(one):
        return Evidence(key, f"{usual:.3f} ms", "warning", f"{text}: trigger both cameras together, or treat them as two")
    return Evidence(key, f"{usual:.3f} ms", "ok", text)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Median distance from the epipolar lines [px], and the share of points that would lie behind the cameras."""

    median_px: float
    behind: float

    @property
    def good(self) -> bool:
        return self.median_px <= _EPIPOLAR_PX and self.behind <= _MOST_BEHIND


def check_baseline(pair: list[CameraStream]) -> list[Evidence]:
    """A finding where two cameras are stated farther apart than any rig has them: no epipolar line shows a wrong unit."""
    one, two = pair[0].T_body_camera, pair[1].T_body_camera
    if one is None or two is None:
        return []
    apart = float(np.linalg.norm(two[:3, 3] - one[:3, 3]))
    if apart <= _FARTHEST_M:
        return []
    text = f"between {pair[0].name} and {pair[1].name} by their mountings: translations are metres; are these millimetres?"
    return [Evidence(f"{pair[0].name}_{pair[1].name}_baseline", f"{apart:.1f} m", "warning", text)]


def check_calibration(pair: list[CameraStream], corners: Corners, same: int = 0) -> Evidence:
    """Whether the stereo calibration fits the images: epipolar lines, and points before the cameras.

    Args:
        same: pairs of images that were the same to the bit.
    """
    key = f"{pair[0].name}_{pair[1].name}_epipolar"
    first, second = corners.joined()
    if same:
        text = f"{same} pairs of images of both cameras are the same to the bit: one camera is recorded in the place of the other"
        return Evidence(key, "one camera", "error", text)
    stated = _fit(pair[0], pair[1], first, second)
    if stated is None:
        text = f"{len(first)} corners of pairs of one instant, with calibration: too few to check the stereo calibration"
        return Evidence(key, "unchecked", "warning", text)
    text = f"median distance of {len(first)} corners from their epipolar lines with the calibration that is used"
    value = f"{stated.median_px:.2f} px"
    if stated.good:
        return Evidence(key, value, "ok", text)
    if stated.median_px <= _EPIPOLAR_PX:
        text += f"; but {100 * stated.behind:.0f} % of the points would lie behind the cameras"
    text += ": the stereo calibration does not fit these images"
    readings: dict[str, tuple[CameraStream, CameraStream, Floats, Floats]] = {
        "with the calibrations swapped it fits, so the cameras are swapped": (pair[1], pair[0], first, second),
        "with the inverse of both mountings it fits": (_inverted(pair[0]), _inverted(pair[1]), first, second),
    }
    for what, axes in _IMAGES.items():
        turned_1, turned_2 = (_mirrored(camera, seen, axes) for camera, seen in zip(pair, (first, second), strict=True))
        readings[f"with both images {what} it fits"] = pair[0], pair[1], turned_1, turned_2
    if (ratio := _focal_ratio(pair[0], pair[1], first, second)) is not None:
        cause = (
            f"with a focal length of {pair[1].name} {ratio:.3f} times as long beside that of {pair[0].name} it fits: one of "
            "them is wrong, calibrate both"
        )
        readings[cause] = pair[0], pair[1], first, _drawn(pair[1], second, ratio)
    best: tuple[float, str] | None = None
    for cause, reading in readings.items():
        fit = _fit(*reading)
        if fit is not None and fit.good and fit.median_px <= max(_FITS_SHARE * stated.median_px, _FITS_PX):
            # Of those that fit as well as corners are known the first one is likeliest: swapped cameras look like a mirror.
            rank = max(fit.median_px, _FITS_PX)
            if best is None or rank < best[0]:
                best = rank, f"{cause} ({fit.median_px:.2f} px)"
    if best is not None:
        return Evidence(key, value, "error", f"{text}: {best[1]}")
    return Evidence(key, value, "error", f"{text}; swapping or inverting does not mend it: another rig, or one that has moved?")


def _mirrored(camera: CameraStream, pixels: Floats, axes: tuple[bool, bool]) -> Floats:
    """Pixels (N, 2) with u, v or both counted from the other end."""
    last = np.array([camera.width, camera.height]) - 1.0
    return np.where(axes, last - pixels, pixels)


def _drawn(camera: CameraStream, pixels: Floats, ratio: float) -> Floats:
    """Pixels (N, 2) with the directions that they have by a focal length `ratio` times as long as what is stated."""
    if camera.model is None:
        return pixels
    centre = np.array([camera.model.cx, camera.model.cy])
    drawn: Floats = centre + (pixels - centre) / ratio
    return drawn


def _focal_ratio(one: CameraStream, two: CameraStream, first: Floats, second: Floats) -> float | None:
    """How many times as long the second focal length should be; None where none between half and double fits best."""
    ratio, ratios = 1.0, np.exp(np.arange(-_MOST_LOG_RATIO, _MOST_LOG_RATIO, _COARSE))
    for _ in range(2):  # coarse, and around the best of these
        fits = [_fit(one, two, first, _drawn(two, second, float(k))) for k in ratios]
        # Directions that are drawn together have less noise: misfits are those of the pixels.
        misfits = [np.inf if fit is None else float(k) * fit.median_px for fit, k in zip(fits, ratios, strict=True)]
        best = int(np.argmin(misfits))
        if not 0 < best < len(ratios) - 1:
            return None
        ratio = float(ratios[best])
        ratios = ratio * np.exp(np.arange(-_COARSE, _COARSE + 0.5 * _FINE, _FINE))
    return ratio if abs(float(np.log(ratio))) > _COARSE else None


def _inverted(camera: CameraStream) -> CameraStream:
    T = camera.T_body_camera
    return camera if T is None else replace(camera, T_body_camera=inverse(T))


def _fit(one: CameraStream, two: CameraStream, first: Floats, second: Floats) -> _Fit | None:
    """How well the calibration of two cameras fits corners (N, 2) of their images."""
    if one.model is None or two.model is None or one.T_body_camera is None or two.T_body_camera is None:
        return None
    bearings_1, found_1 = one.model.bearings(first)
    bearings_2, found_2 = two.model.bearings(second)
    kept = found_1 & found_2
    T_2_1 = inverse(two.T_body_camera) @ one.T_body_camera
    turned, seen, t = bearings_1[kept] @ T_2_1[:3, :3].T, bearings_2[kept], T_2_1[:3, 3]
    normals = np.cross(t, turned)
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9
    if usable.sum() < _FEWEST:
        return None
    sines = np.einsum("ni,ni->n", seen[usable], normals[usable]) / lengths[usable]
    # λ of λ R x₁ + t ∥ x₂, for those whose directions differ enough to tell its sign.
    across = np.cross(turned, seen)
    squared = np.einsum("ni,ni->n", across, across)
    wide = squared > (_PARALLAX_PX / two.model.fx) ** 2
    depth = -np.einsum("ni,ni->n", np.cross(t, seen), across)
    behind = float((depth[wide] < 0.0).mean()) if wide.sum() >= _FEWEST else 0.0
    return _Fit(float(np.median(np.abs(sines))) * two.model.fx, behind)
