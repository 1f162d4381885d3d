"""What a user should know of a bundle adjustment that its numbers do not say: structure, repetitions, units, sigmas."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded, chi_square_quantile, chi_square_sf
from boxplus._words import counted, either
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.solution import Solution
from boxplus.systems.bundle_adjustment.sightings import Sightings, names_text

_GROSS, _LOAD = 5.5, 0.5  # typical errors beyond which is no noise, once in four million, and the share of the cost that tells
_LEAST = 100  # observations from which on shares mean something
_LEAST_PIXEL = 1e-3  # [px] errors below are rounding
_NARROW = 0.02  # spread of a camera's pixels, as a share of the others' or of the focal length, that asks for their unit
_ONE_PIXEL = 1.0  # spread, below which pixels are none
_FEW = 10  # observations from which on a spread means something
_OFF, _OFF_GIVEN = 5.0, 2.0  # times the errors may differ from what sigma says: one that was assumed, and one that was given
_FAR_OFF = 3.0  # the same, of a given sigma, from which on nothing is to be trusted; few wrong matches hardly move a median
_COARSE = 0.01  # of the focal length, by which half of the observations are off in no image
_CONTRADICTED, _MISFIT = 25.0, 2.0  # times what a given sigma promises of χ², for a doubt and for a sentence
_FAR = 4.0  # times the median distance from the middle
_CLEARLY = 0.3  # times what is left of the points after a rotation, that a mirror image has to leave
_STRANGE = 1e-4  # chance that a point of a sound reconstruction, the worst of all, stands out
_COUNTS = 0.25  # weight of an observation under a robust loss, below which it says nothing; noise comes by it once in a million
_RAYLEIGH = 1.1774  # median length of a two-dimensional error of standard deviation 1


def input_notes(reconstruction: Reconstruction) -> list[str]:
    """Observations that are there twice, and pixels that look like another unit."""
    seen = Sightings.of(reconstruction)
    said = []
    pair = seen.camera_of * len(seen.points) + seen.point_of
    repeated = len(pair) - len(np.unique(pair))
    if repeated:
        said.append(
            f"{counted(repeated, 'observation')} {either(repeated, 'is', 'are')} of a point in a camera that has it already: "
            f"{either(repeated, 'it counts', 'they count')} again, as if measured independently, and "
            f"{either(repeated, 'contradicts the other', 'contradict each other')} where the pixels differ"
        )
    spread = _pixel_spreads(seen)
    able = np.isfinite(spread)
    if not able.any():
        return said
    usual = float(np.median(spread[able]))
    narrow = np.flatnonzero(spread < _NARROW * usual).astype(np.int64)
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


def unit_doubt(reconstruction: Reconstruction) -> str | None:
    """A sentence where the pixels of every camera lie within one of each other, at a focal length of far more of them.

    Where the focal length itself is one or a few, as of normalised coordinates, both may well be in the same unit.
    """
    seen = Sightings.of(reconstruction)
    spread = _pixel_spreads(seen)
    widest = float(spread[np.isfinite(spread)].max(initial=0.0))
    if not 0.0 < widest < _ONE_PIXEL <= _NARROW * seen.focal_length:
        return None
    return (
        f"the pixels of every camera spread over {widest:.3g} px at most, as those of no image do at a focal length of "
        f"{seen.focal_length:.4g} px: give both in pixels"
    )


def _pixel_spreads(seen: Sightings) -> NDArray[np.float64]:
    """(m,) root mean square distance of a camera's pixels from their mean [px]; NaN of too few."""
    m = len(seen.t)
    times = np.bincount(seen.camera_of, minlength=m)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        mean = [np.bincount(seen.camera_of, x, m) / times for x in seen.pixels.T]
        off = [(x - of[seen.camera_of]) ** 2 for x, of in zip(seen.pixels.T, mean, strict=True)]
        spread = np.sqrt(np.bincount(seen.camera_of, off[0] + off[1], m) / times)
    return np.where(times >= _FEW, spread, np.nan)


def mirror_doubt(before: NDArray[np.float64], after: NDArray[np.float64]) -> str | None:
    """A sentence where the adjusted points (n, 3) are a mirror image of those of the input (n, 3), but for place, turn and size.

    A mirrored scene explains pixels with one axis flipped as well as the true one explains the true pixels.
    """
    apart = [np.linalg.norm(p - np.median(p, axis=0), axis=1) for p in (before, after)]
    # Far points would decide alone.
    near = np.all([np.isfinite(d) & (d <= _FAR * np.nanmedian(d)) for d in apart], axis=0)
    if np.count_nonzero(near) < _FEW:
        return None
    x, y = (p[near] - p[near].mean(axis=0) for p in (before, after))
    x, y = (p / max(float(np.sqrt((p * p).mean())), 1e-300) for p in (x, y))
    U, d, Vt = np.linalg.svd(y.T @ x)
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    total = float((x * x).sum())
    if not (total > 0.0 and (y * y).any()):  # all in one place
        return None
    rotated, mirrored = (max(1.0 - (float(d[:2].sum()) + s * float(d[2])) / total, 0.0) for s in (sign, -sign))
    if not mirrored < _CLEARLY * rotated:
        return None
    return (
        "the result is a mirror image of the input: is one axis of the pixels flipped, or are the two swapped (BAL counts y "
        "upwards, all others downwards), or were the points?"
    )


def sigma_notes(errors: NDArray[np.float64], sigma_px: float, left: int, *, is_given: bool) -> list[str]:
    """Whether the errors are as large as sigma says, by their median, which wrong matches hardly move.

    Args:
        left: measurements less unknowns.
        is_given: whether somebody meant sigma, or it is the default.
    """
    noise = pixel_noise(errors, left)
    off = _OFF_GIVEN if is_given else _OFF
    if noise is None or sigma_px / off <= noise <= off * sigma_px:
        return []
    taken = "given" if is_given else "assumed (--sigma)"
    wrong = "small" if noise > sigma_px else "large"
    return [
        f"the errors are those of sigma = {noise:.2g} px, {sigma_px:g} px was {taken}: standard deviations are too {wrong} by a "
        f"factor of {max(noise / sigma_px, sigma_px / noise):.2g}, and a robust loss is scaled wrongly"
    ]


def coarse_doubt(
    errors: NDArray[np.float64], left: int, reconstruction: Reconstruction, sigma_px: float, *, is_given: bool
) -> str | None:
    """Where the typical error is none of a camera, or of the sigma that somebody meant, with or without a robust loss."""
    noise, focal = pixel_noise(errors, left), Sightings.of(reconstruction).focal_length
    if noise is None:
        return None
    if noise > max(_COARSE * focal, sigma_px):
        return (
            f"half of the errors are larger than {noise * _RAYLEIGH:.3g} px, {noise * _RAYLEIGH / focal:.1%} of the focal "
            "length: no image is measured so coarsely; wrong matches, a wrong start or lens, or pixels with other axes"
        )
    if is_given and noise > _FAR_OFF * sigma_px:
        return (
            f"the errors are those of sigma = {noise:.2g} px, {noise / sigma_px:.2g} times the {sigma_px:g} px that were given: "
            "a wrong start or lens, wrong matches, or a sigma too small"
        )
    return None


def pixel_noise(errors: NDArray[np.float64], left: int) -> float | None:
    """Standard deviation of a pixel as the median of the errors has it [px]; None where nothing is left over to tell."""
    known = errors[np.isfinite(errors)]
    if left <= 0 or not len(known):
        return None
    return float(np.median(known)) / _RAYLEIGH * float(np.sqrt(2.0 * len(known) / left))


def typical_error(errors: NDArray[np.float64]) -> float:
    """Standard deviation of a pixel by the median of the errors (k,), of which NaN do not count [px]."""
    return max(float(np.nanmedian(errors)) / _RAYLEIGH, _LEAST_PIXEL)


def outlier_notes(errors: NDArray[np.float64], loss: Loss | None) -> list[str]:
    """A sentence where errors that no noise explains carry most of a cost without robust loss."""
    known = errors[np.isfinite(errors)]
    if loss is not None or len(known) < _LEAST:
        return []
    squared = known**2
    gross = known > _GROSS * typical_error(known)
    if not squared[gross].sum() > _LOAD * squared.sum():
        return []
    gross_count = int(np.count_nonzero(gross))
    return [
        f"{gross_count} of {len(known)} observations {either(gross_count, 'is', 'are')} off by more than {_GROSS:g} times the "
        f"typical error, with {squared[gross].sum() / squared.sum():.0%} of the cost; the largest is {known.max():.4g} px: wrong "
        "matches or a wrong start, to which all else is bent; use a robust loss (--loss huber)"
    ]


def misfit_notes(cost: float, left: int, sigma_px: float, loss: Loss | None, *, is_given: bool) -> list[str]:
    """A sentence where χ² is more than a sigma that somebody meant promises, though not so much that nothing is to be trusted."""
    if not is_given or loss is not None or left <= 0 or sigma_doubt(cost, left, sigma_px, loss, is_given=is_given):
        return []
    if not (2.0 * cost > _MISFIT * left and chi_square_sf(2.0 * cost, left) < _STRANGE):
        return []
    return [
        f"χ² is {2.0 * cost / left:.3g} times what sigma = {sigma_px:g} px promises: few wrong matches, a wrong lens, or a sigma "
        "too small"
    ]


def point_notes(
    errors: NDArray[np.float64], point_of: NDArray[np.int64], weights: NDArray[np.float64] | None, ids: NDArray[np.int64] | None
) -> list[str]:
    """A sentence on points whose observations contradict each other: they are somewhere, and nothing confirms where.

    Args:
        weights: (k,) under a robust loss; None for least squares, where those count that carry most of the cost.
    """
    known = np.isfinite(errors)
    times = np.bincount(point_of[known])
    if weights is not None:
        heavy = np.bincount(point_of[known], weights[known] >= _COUNTS, len(times))
        loose = np.flatnonzero((times >= 2) & (heavy < 2)).astype(np.int64)
        if not len(loose):
            return []
        return [
            f"{counted(len(loose), 'point')} {either(len(loose), 'rests', 'rest')} on fewer than two observations that "
            f"count under the robust loss, so that nothing confirms where {either(len(loose), 'it is', 'they are')}: "
            f"{names_text(loose, ids)}"
        ]
    squared = np.bincount(point_of[known], errors[known] ** 2, len(times))
    able = np.flatnonzero(times >= 2)
    spare = 2 * times[able] - 3
    if len(able) < _FEW:
        return []
    half, limit = np.zeros(int(spare.max()) + 1), np.zeros(int(spare.max()) + 1)
    for dof in np.unique(spare):
        half[dof], limit[dof] = chi_square_quantile(0.5, int(dof)), chi_square_exceeded(_STRANGE / len(able), int(dof))
    scale = max(float(np.median(squared[able] / half[spare])), _LEAST_PIXEL**2)
    bad = squared[able] > scale * limit[spare]
    if not squared[able[bad]].sum() > _LOAD * squared.sum():
        return []
    worst = able[bad][np.argsort(-squared[able[bad]] / limit[spare[bad]], kind="stable")]
    share = squared[worst].sum() / squared.sum()
    return [
        f"{counted(len(worst), 'point')} {either(len(worst), 'has', 'have')} observations that contradict each other, and "
        f"{either(len(worst), 'carries', 'carry')} {share:.0%} of the cost; the worst: "
        f"{names_text(worst.astype(np.int64), ids)}"
    ]


def sigma_doubt(cost: float, left: int, sigma_px: float, loss: Loss | None, *, is_given: bool) -> str | None:
    """Where the errors contradict a sigma that somebody meant."""
    if not is_given or loss is not None or left <= 0 or not 2.0 * cost > _CONTRADICTED * left:
        return None
    return (
        f"χ² is {2.0 * cost / left:.3g} times what sigma = {sigma_px:g} px promises: wrong matches, a wrong start or lens, or "
        "a sigma too small"
    )


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
        notes.append(
            f"{counted(once, 'point')} {either(once, 'is seen only once: its', 'are seen only once: their')} depth is not "
            "determined and stays near the start"
        )
    few = np.bincount(camera_of)
    few_cameras = int(np.count_nonzero((few > 0) & (few < 4)))
    if few_cameras:
        notes.append(
            f"{counted(few_cameras, 'camera')} {either(few_cameras, 'sees', 'see')} fewer than 4 points: "
            f"{either(few_cameras, 'its', 'their')} pose is not determined and stays near the start"
        )
    return tuple(notes)
