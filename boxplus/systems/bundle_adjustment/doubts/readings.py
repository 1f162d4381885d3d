"""Does a reconstruction mean something else than it is read as? Its own start tells, where it is one.

A start explains its pixels to within a few of them, as it was meant. Read with inverted poses, in degrees or with points in
another unit it is nowhere near; so where another reading explains the pixels far better than the format's own, that was meant.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3
from boxplus.systems.bundle_adjustment.sightings import Sightings, colmap_layout

_FAR_BETTER = 0.2  # times the error as read, that another reading has to reach
_OFF, _NEAR = 0.08, 0.2  # of how far the pixels spread: errors that ask for another reading, and that answer it
_LEAST = 20  # observations
_MOST = 5000  # observations that are looked at
_SIZES, _RESIZED = (0.25, 0.5, 2.0, 4.0), 0.1  # of images, and logarithm of any other size from which on it is told
_UNITS = (1e3, 1e2, 1e-2, 1e-3)
_ANOTHER_UNIT = 50.0  # times as long a focal length, which adjusting does not find; ten times it does
_ROTATION, _TRANSLATION = ("rotation", (0, 1, 2)), ("translation", (3, 4, 5))
_F, _K1, _K2 = ("f", (6,)), ("k1", (7,)), ("k2", (8,))
_COLUMNS = (
    (_ROTATION, _TRANSLATION, _K1, _K2, _F),
    (_ROTATION, _TRANSLATION, _K1, _F, _K2),
    (_ROTATION, _TRANSLATION, _K2, _K1, _F),
    (_TRANSLATION, _ROTATION, _F, _K1, _K2),
    (_F, _K1, _K2, _ROTATION, _TRANSLATION),
    (_F, _K1, _K2, _TRANSLATION, _ROTATION),
)
"""Orders of the numbers of a camera of BAL, and where each stands in the format's own."""
_COLUMN_ADVICE = "BAL has rotation [rad], translation, f [px], k1, k2, in this order"
_HALF_TURN = np.array([1.0, -1.0, -1.0])
_INVERT = "give poses from world to camera, R → Rᵀ and t → −Rᵀ t"
_BAL_AXES = "the cameras of BAL look along −z, x to the right and y upwards"
_TURN = "turn the cameras by half a turn about x: they have to look along +z, y downwards"
_ORDER = "give them in the order of the format"


@dataclass(frozen=True, slots=True)
class _Reading:
    """What it may mean: `got`, what is there, and what to do; not refused where it is a matter of the pixels alone."""

    sightings: Sightings
    got: str
    advice: str
    is_of_pixels: bool = False


def refuse_other_columns(problem: BalProblem) -> None:
    """Refuse cameras of BAL whose nine numbers stand in another order, before anything is made of them.

    Raises:
        InputError: the start explains the pixels far better so.
    """
    if _has_lenses(problem.cameras):
        seen = _some(Sightings.of(problem))
        better = None if seen is None else _better(seen, _of_other_columns(problem))
    else:
        cameras = np.column_stack([problem.cameras[:, :6], np.ones(len(problem.cameras)), np.zeros((len(problem.cameras), 2))])
        seen = _some(Sightings.of(replace(problem, cameras=cameras)))
        better = (
            None
            if seen is None
            else _better(seen, _of_other_columns(problem), "nowhere, with focal lengths that are not positive,")
        )
    if better is not None:
        _refuse(problem, *better)


def reading_doubt(reconstruction: Reconstruction, *, is_lens_held: bool) -> str | None:
    """A sentence where the pixels have other axes or another size than they are read with.

    Args:
        is_lens_held: whether focal lengths are not adjusted, so that another size of the image is not found by that.

    Raises:
        InputError: poses that are inverted, or whose rotations are in degrees or in another order; points in another unit; focal
            lengths of BAL in another unit.
    """
    seen = _some(Sightings.of(reconstruction))
    if seen is None:
        return None
    readings = _readings(reconstruction, seen)
    if is_lens_held:
        readings = itertools.chain(readings, _of_other_size(seen, _principal_points(reconstruction, seen)))
    better = _better(seen, readings)
    if better is None:
        return None
    told, way = better
    if way.is_of_pixels:
        return f"{told}: {way.advice}"
    return _refuse(reconstruction, told, way)


def _refuse(reconstruction: Reconstruction, told: str, way: _Reading) -> NoReturn:
    raise InputError(
        "cameras and points that lie, as the format reads them, near to what was seen",
        f"{told} ({getattr(reconstruction, 'source', 'reconstruction')})",
        way.advice,
    )


def _some(seen: Sightings) -> Sightings | None:
    """Not all of many; None of too few to tell."""
    rows = slice(None, None, max(1, len(seen.pixels) // _MOST))
    seen = replace(seen, camera_of=seen.camera_of[rows], point_of=seen.point_of[rows], pixels=seen.pixels[rows])
    return seen if len(seen.pixels) >= _LEAST else None


def _has_lenses(cameras: NDArray[np.float64]) -> bool:
    return bool((cameras[:, 6] > 0.0).all())


def _better(seen: Sightings, readings: Iterable[_Reading], nowhere: str = "") -> tuple[str, _Reading] | None:
    """The reading that explains the pixels far better than `seen` does, with a sentence on by how much.

    Args:
        nowhere: where points lie as the file is read, where that is at no place.
    """
    off = np.inf if nowhere else _typical(seen)
    share = off / _spread(seen)
    if not share > _OFF:
        return None
    shares = ((_typical(way.sightings) / _spread(way.sightings), way) for way in readings)  # of pixels that another size has, too
    near, way = min(shares, key=lambda one: one[0], default=(np.inf, None))
    if way is None or not (near < _FAR_BETTER * share and near < _NEAR):
        return None
    least = near * _spread(way.sightings)
    as_read = f"within {off:.3g} px" if np.isfinite(off) else nowhere or "behind their cameras"
    return (
        f"half of the points lie within {least:.3g} px of where they were seen {way.got}, and {as_read} as the file is read",
        way,
    )


def _spread(seen: Sightings) -> float:
    """Median distance of pixels from their middle [px]."""
    return max(float(np.median(np.linalg.norm(seen.pixels - np.median(seen.pixels, axis=0), axis=1))), 1e-300)


def _typical(seen: Sightings) -> float:
    """Median error [px]; infinite where half of the points are behind their cameras."""
    with np.errstate(all="ignore"):
        errors = seen.errors(np.arange(len(seen.pixels)), seen.points[seen.point_of])
    return float(np.median(np.where(np.isnan(errors), np.inf, errors)))


def _readings(own: Reconstruction, seen: Sightings) -> Iterator[_Reading]:
    yield from _of_bal(own, seen) if isinstance(own, BalProblem) else _with_quaternions(own, seen)
    for unit in _UNITS:
        scaled = replace(seen, points=unit * seen.points)
        yield _Reading(scaled, f"if the points are {unit:g} times as large", "give points and cameras in the same unit")
    centre = _principal_points(own, seen)
    flipped = [(replace(seen, pixels=(seen.pixels - centre) * flip + centre), flip) for flip in ([-1.0, 1.0], [1.0, -1.0])]
    for (other, _), name in zip(flipped, "xy", strict=True):
        yield _Reading(other, f"with {name} the other way", f"is {name} of the pixels flipped?", True)
    # Where y is counted upwards, what was swapped is negated as well, once it is counted downwards.
    signs = (1.0, -1.0) if isinstance(own, BalProblem) else (1.0,)
    for sign, about in itertools.product(signs, (np.zeros(2), centre)):
        swapped = sign * (seen.pixels - about)[:, ::-1] + about
        yield _Reading(replace(seen, pixels=swapped), "with x and y swapped", "are x and y of the pixels swapped?", True)
    if centre.any():
        of_lens = "are they counted from the principal point?"
        yield _Reading(replace(seen, pixels=seen.pixels + centre), "with the principal point added to the pixels", of_lens, True)


def _of_other_size(seen: Sightings, centre: NDArray[np.float64]) -> Iterator[_Reading]:
    """Of pixels that are so many times as far apart as those of this lens."""
    for size in _SIZES:
        advice = "are the pixels those of an image of another size than the focal length?"
        yield _Reading(replace(seen, pixels=size * seen.pixels), f"with pixels {size:g} times as large", advice, True)
    with np.errstate(all="ignore"):
        projected = seen.projections(np.arange(len(seen.pixels)), seen.points[seen.point_of]) - centre
        ratios = ((seen.pixels - centre) * projected).sum(axis=1) / (projected**2).sum(axis=1)
    size = float(np.median(ratios[np.isfinite(ratios)])) if np.isfinite(ratios).any() else 1.0
    if size > 0.0 and abs(np.log(size)) > _RESIZED:
        advice = "is the focal length wrong, or that of an image of another size?"
        resized = replace(seen, pixels=(seen.pixels - centre) / size + centre)
        yield _Reading(resized, f"with a focal length {size:.4g} times as large", advice, True)


def _of_other_columns(own: BalProblem) -> Iterator[_Reading]:
    for order in _COLUMNS:
        names = [name for name, _ in order]
        places = np.argsort(np.concatenate([places for _, places in order]))
        cameras = np.ascontiguousarray(own.cameras[:, places])
        other = _some(Sightings.of(replace(own, cameras=cameras))) if _has_lenses(cameras) else None
        if other is not None:
            yield _Reading(other, f"if the numbers of a camera are {', '.join(names)}", _COLUMN_ADVICE)


def _of_bal(own: BalProblem, seen: Sightings) -> Iterator[_Reading]:
    as_it_is = replace(seen, R_camera_world=so3.exp(own.cameras[:, :3]), t=own.cameras[:, 3:6])
    inverted = _inverse(as_it_is)
    yield _Reading(_turned(inverted), "if the poses are inverted", _INVERT)
    upwards = seen.pixels * [1.0, -1.0]  # as the file has them
    for pixels in (seen.pixels, upwards):
        forward = replace(inverted, pixels=pixels)
        yield _Reading(forward, "if the poses are inverted and look along +z", f"{_INVERT}; {_BAL_AXES}")
    degrees = replace(seen, R_camera_world=so3.exp(np.radians(own.cameras[:, :3])) * _HALF_TURN[:, None])
    nothing = replace(seen, R_camera_world=np.broadcast_to(np.eye(3) * _HALF_TURN[:, None], degrees.R_camera_world.shape))
    # Rotations that are noise about none at all fit better in degrees, too: as well as none at all.
    if _typical(degrees) < 0.5 * _typical(nothing):
        yield _Reading(degrees, "if the rotations are in degrees", "give them in radians")
    with np.errstate(all="ignore"):
        projected = seen.projections(np.arange(len(seen.pixels)), seen.points[seen.point_of])
        ratios = (seen.pixels * projected).sum(axis=1) / (projected**2).sum(axis=1)
    of_camera = np.ones(len(own.cameras))
    for camera in np.unique(seen.camera_of):
        mine = ratios[(seen.camera_of == camera) & np.isfinite(ratios)]
        of_camera[camera] = np.median(mine) if len(mine) else 1.0
    size = float(np.median(of_camera[np.unique(seen.camera_of)]))
    if size > _ANOTHER_UNIT:
        cameras = own.cameras.copy()
        cameras[:, 6] *= of_camera
        other = _some(Sightings.of(replace(own, cameras=cameras))) if _has_lenses(cameras) else None
        if other is not None:
            yield _Reading(other, f"with focal lengths {size:.3g} times as large", _COLUMN_ADVICE)
    yield _Reading(replace(as_it_is, pixels=upwards), "by cameras that look along +z, y downwards", _BAL_AXES, True)


def _with_quaternions(own: GbpProblem | ColmapModel, seen: Sightings) -> Iterator[_Reading]:
    yield _Reading(_inverse(seen), "if the poses are inverted", _INVERT)
    for order in ([3, 0, 1, 2], [1, 2, 3, 0]):
        other = replace(seen, R_camera_world=quaternion.to_matrix(np.ascontiguousarray(own.T_camera_world[:, order])))
        how = "if the quaternions have another order"
        yield _Reading(other, how, _ORDER)
        yield _Reading(_inverse(other), f"{how} and the poses are inverted", f"{_ORDER}; {_INVERT}")
    axes = "by cameras that look along −z, y upwards"
    yield _Reading(_turned(seen), axes, _TURN)
    yield _Reading(_turned(_inverse(seen)), f"{axes}, of inverted poses", f"{_INVERT}; {_TURN}")
    yield _Reading(_inverse(_turned(seen)), f"if the poses are inverted, {axes}", f"{_INVERT}; {_TURN}")


def _principal_points(own: Reconstruction, seen: Sightings) -> NDArray[np.float64]:
    """(k, 2) or (2,) of the camera of every observation [px]."""
    if isinstance(own, BalProblem):
        return np.zeros(2)
    if isinstance(own, GbpProblem):
        return own.intrinsics[2:]
    of_lens = [(colmap_layout(own, number) @ own.camera_params[number])[2:4] for number in range(len(own.camera_ids))]
    return np.asarray(np.array(of_lens)[seen.lens_of[seen.camera_of]])


def _inverse(seen: Sightings) -> Sightings:
    R = np.ascontiguousarray(seen.R_camera_world.transpose(0, 2, 1))
    return replace(seen, R_camera_world=R, t=-np.einsum("nij,nj->ni", R, seen.t))


def _turned(seen: Sightings) -> Sightings:
    """Cameras turned by half a turn about their x axes."""
    return replace(seen, R_camera_world=seen.R_camera_world * _HALF_TURN[:, None], t=seen.t * _HALF_TURN)
