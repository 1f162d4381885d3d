"""What to do about a lens that was held and is wrong: which options, or which camera model, let its parameters be as they are."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.reconstruction_problem import free_parameters
from boxplus.systems.bundle_adjustment.sightings import Sightings, colmap_layout, colmap_pinhole

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
PARTS = {"f": (0, 1), "cx, cy": (2, 3), "k1": (4,), "k2": (5,), "p1, p2": (6, 7)}
"""Parameters that a lens has together, and their places."""
_TWO = 0.3  # of what a lens moves its pixels by, that is lost with one focal length instead of two
_MODELS = {  # the poorest first
    "SIMPLE_PINHOLE": frozenset({"f"}),
    "PINHOLE": frozenset({"f", "fx, fy"}),
    "SIMPLE_RADIAL": frozenset({"f", "k1"}),
    "RADIAL": frozenset({"f", "k1", "k2"}),
    "OPENCV": frozenset({"f", "fx, fy", "k1", "k2", "p1, p2"}),
}


def free_already(given: Reconstruction, used: NDArray[np.bool_], config: BundleAdjustmentConfig) -> tuple[frozenset[str], int]:
    """Names of `PARTS` that an adjustment moves, of some lens at least, and how many numbers of all lenses together.

    Args:
        used: (k,) observations that are adjusted.
    """
    if isinstance(given, BalProblem):
        return _MODELS["RADIAL"], 3 * len(np.unique(given.camera_of[used]))
    if not isinstance(given, ColmapModel) or config.intrinsics == "held":
        return frozenset(), 0
    seen = given.point_of >= 0
    seen[seen] = used
    lenses = np.unique(given.camera_of[given.image_of[seen]])
    count = sum(int(np.count_nonzero(free_parameters(given, number, config)[0])) for number in lenses)
    parts = {part for number in lenses for part in _MODELS[given.camera_models[number]]} & set(PARTS)
    return frozenset(parts | ({"cx, cy"} if config.principal_point == "refined" else set())), count


def lens_advice(given: Reconstruction, parts: Set[str], before: ColmapModel, after: ColmapModel) -> str:
    """Which options, camera model or line of the file let the lenses be those of `after`.

    Args:
        given: as it was read. before: the same, with lenses that may have any parameter; after: these as they were found.
        parts: names of `PARTS` that differ.
    """
    lens = set(parts) - {"cx, cy"}
    if "f" in parts and any(_has_two(before, after, number) for number in range(len(before.camera_ids))):
        lens.add("fx, fy")
    if not isinstance(given, ColmapModel):
        if lens <= {"f", "fx, fy"}:
            return "correct the second line of the file"
        return "the second line of the file knows no distortion: take it out of the pixels, or write the scene as a COLMAP model"
    options = "--refine-intrinsics" + (" --refine-principal-point" if "cx, cy" in parts else "")
    lacking = {model: sorted(lens - _MODELS[model]) for model in given.camera_models if not lens <= _MODELS[model]}
    if not lacking:
        return options
    if len(set(given.camera_models)) > 1:  # which of them needs it, the images tell once they may have it
        told = " and ".join(f"{model}, which has no {' and no '.join(names)}" for model, names in sorted(lacking.items()))
        return f"{options}, with richer camera models in place of {told}"
    has = _MODELS[given.camera_models[0]]
    kept = set(has)  # what the camera model says already is not to get lost
    if all(params[0] == params[1] for params in before.camera_params):
        kept.discard("fx, fy")
    model = next(name for name, own in _MODELS.items() if lens | kept <= own)
    return f"{options}, with {model} in place of the camera model, which has no {' and no '.join(sorted(lens - has))}"


def _has_two(before: ColmapModel, after: ColmapModel, number: int) -> bool:
    """Whether a lens moves pixels by two focal lengths that differ otherwise than they did."""
    seen = Sightings.of(after)
    rays, found = seen.bearings(np.arange(len(seen.pixels)))
    rays = rays[(seen.lens_of[seen.camera_of] == number) & found]
    if not len(rays):
        return False
    old, new = (colmap_layout(model, number) @ model.camera_params[number] for model in (before, after))
    alike = new.copy()
    alike[:2] = old[:2] * np.mean(new[:2] / old[:2])
    return _apart(before, number, rays, new, alike) > _TWO * _apart(before, number, rays, old, new)


def _apart(
    model: ColmapModel, number: int, rays: NDArray[np.float64], one: NDArray[np.float64], other: NDArray[np.float64]
) -> float:
    """Root mean square [px] between the projections by two lenses of all parameters."""
    pixels = []
    for parameters in (one, other):
        params = tuple(parameters if k == number else known for k, known in enumerate(model.camera_params))
        pixels.append(colmap_pinhole(replace(model, camera_params=params), number).project(rays)[0])
    return float(np.sqrt(np.nanmean(((pixels[0] - pixels[1]) ** 2).sum(axis=1))))
