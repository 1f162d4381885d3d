"""What a user should know of a bundle adjustment that its numbers do not say: structure, repetitions, units, sigmas."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.solution import Solution
from boxplus.systems.bundle_adjustment.sightings import Sightings, names_text

_HEAVY, _LOAD = 0.01, 0.9  # a share of the observations, and of the cost, that only wrong matches carry
_LEAST_PIXEL = 1e-3  # [px] errors below are rounding
_NARROW = 0.02  # spread of a camera's pixels, as a share of the others' or of the focal length, that asks for their unit
_FEW = 10  # observations from which on a spread means something
_OFF = 5.0  # times the errors may differ from what sigma says
_RAYLEIGH = 1.1774  # median length of a two-dimensional error of standard deviation 1


def input_notes(reconstruction: Reconstruction) -> list[str]:
    """Observations that are there twice, and pixels that look like another unit."""
    seen = Sightings.of(reconstruction)
    said = []
    pair = seen.camera_of * len(seen.points) + seen.point_of
    repeated = len(pair) - len(np.unique(pair))
    if repeated:
        said.append(
            f"{repeated} observations are of a point in a camera that has it already: they count again, as if measured "
            "independently, and contradict each other where the pixels differ"
        )
    m = len(seen.t)
    times = np.bincount(seen.camera_of, minlength=m)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        mean = [np.bincount(seen.camera_of, x, m) / times for x in seen.pixels.T]
        off = [(x - of[seen.camera_of]) ** 2 for x, of in zip(seen.pixels.T, mean, strict=True)]
        spread = np.sqrt(np.bincount(seen.camera_of, off[0] + off[1], m) / times)
    able = times >= _FEW
    if not able.any():
        return said
    usual = float(np.median(spread[able]))
    narrow = np.flatnonzero(able & (spread < _NARROW * usual)).astype(np.int64)
    if len(narrow):
        said.append(
            f"the pixels of cameras {names_text(narrow, getattr(reconstruction, 'image_ids', None))} spread over "
            f"{float(spread[narrow].max()):.3g} px, those of the others over {usual:.3g} px: are they in another unit?"
        )
    if usual < _NARROW * seen.focal_length:
        said.append(
            f"the pixels of a camera spread over {usual:.3g} px at a focal length of {seen.focal_length:.4g} px: are both in the "
            "same unit?"
        )
    return said


def sigma_notes(errors: NDArray[np.float64], sigma_px: float, left: int) -> list[str]:
    """Whether the errors are as large as sigma says, by their median, which wrong matches hardly move.

    Args:
        left: measurements less unknowns.
    """
    known = errors[np.isfinite(errors)]
    if left <= 0 or not len(known):
        return []
    noise = float(np.median(known)) / _RAYLEIGH * np.sqrt(2.0 * len(known) / left)
    if sigma_px / _OFF <= noise <= _OFF * sigma_px:
        return []
    return [
        f"the errors are those of sigma = {noise:.2g} px, {sigma_px:g} px was given: standard deviations are too small by a "
        f"factor of {noise / sigma_px:.2g}, and a robust loss is scaled wrongly"
    ]


def outlier_notes(errors: NDArray[np.float64], loss: Loss | None) -> list[str]:
    """A sentence where a few observations carry nearly all of a cost without robust loss."""
    squared = np.sort(errors[np.isfinite(errors)] ** 2)[::-1]
    few = max(1, int(_HEAVY * len(squared)))
    if loss is not None or len(squared) < 1.0 / _HEAVY or not squared[:few].sum() > _LOAD * squared.sum():
        return []
    if squared[0] < _LEAST_PIXEL**2:
        return []
    return [
        f"{few} of {len(squared)} observations carry {squared[:few].sum() / squared.sum():.0%} of the cost, the largest error is "
        f"{np.sqrt(squared[0]):.4g} px: wrong matches or a wrong start; use a robust loss (--loss huber)"
    ]


def structure_notes(
    point_count: int, camera_of: NDArray[np.int64], point_of: NDArray[np.int64], solution: Solution
) -> tuple[str, ...]:
    """Sentences on the structure; that images alone do not tell where the whole scene lies is no news."""
    gauge = [note for note in solution.notes if note.startswith("nothing ties ")]
    notes = [note for note in solution.notes if note not in gauge]
    if len(gauge) > 1:
        notes.append(
            f"the reconstruction falls into {len(gauge)} pieces that share no point: how they lie to each other, and their "
            "relative scale, are not determined"
        )
    times = np.bincount(point_of, minlength=point_count)
    once = int(np.count_nonzero(times == 1))
    if once:
        notes.append(f"{once} points are seen only once: their depth is not determined and stays near the start")
    few = np.bincount(camera_of)
    few_cameras = int(np.count_nonzero((few > 0) & (few < 4)))
    if few_cameras:
        notes.append(f"{few_cameras} cameras see fewer than 4 points: their pose is not determined and stays near the start")
    return tuple(notes)
