"""One camera on its own: focal length, centre and lens from views of a target, without a guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.systems.camera_calibration.adjustment import Adjustment, Rig, adjust
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.lens import LensKind, lens
from boxplus.systems.camera_calibration.start import starting_lenses, target_pose

Floats = NDArray[np.float64]

FEWEST_VIEWS = 4
"""Below, a plane does not determine focal lengths, centre and distortion with anything to spare."""

_FEWEST_CORNERS = 12
_CANDIDATES = 3
_FIRST_ITERATIONS = 30
_RACING_VIEWS = 15
_TWINS = ((0.45, 0.75), (-0.2, 0.59))
"""ξ and α to look for the other minimum from, for ξ below and above `_BETWEEN_TWINS`."""
_BETWEEN_TWINS, _ONE_MINIMUM = 0.1, 0.1


def calibrate_camera(corners: TargetCorners, places: Floats, kind: LensKind) -> Adjustment:
    """Calibrate the one camera of `corners`.

    Args:
        corners: of one camera.
        places: (n, 3) of the target's corners [m].
        kind: of the lens.

    Raises:
        InputError: too few views, or none that a lens of this kind explains.
    """
    frames = usable_frames(corners)
    if len(frames) < FEWEST_VIEWS:
        raise InputError(
            f"at least {FEWEST_VIEWS} views with {_FEWEST_CORNERS} corners or more of every camera",
            f"{len(frames)} of camera {int(corners.camera_of[0]) if len(corners.pixels) else '?'}",
            "show the target from more sides: 20 to 60 views, tilted by 20 to 45 deg, all over the image",
        )
    alone = replace(corners, camera_of=np.zeros_like(corners.camera_of), sizes=_size_of(corners))
    views = [(alone.pixels[rows], places[alone.corner_of[rows]]) for rows in (alone.frame_of == frame for frame in frames)]
    best: Adjustment | None = None
    reasons = []
    # Which start leads somewhere shows on some of the views.
    racing = set(frames[:: -(-len(frames) // _RACING_VIEWS)])
    race = alone.rows(np.isin(alone.frame_of, list(racing)))
    for _, model in starting_lenses(kind, alone.sizes[0], views, _CANDIDATES):
        poses = _poses(model, frames, views, len(alone.names))
        poses[[frame for frame in frames if frame not in racing]] = np.nan
        if np.isfinite(poses[:, 0]).sum() < FEWEST_VIEWS:
            continue
        try:
            found = adjust(race, places, Rig((kind,), (model,), se3.exp(np.zeros((1, 6))), poses), _FIRST_ITERATIONS)
        except InputError as error:
            reasons.append(error.got)
            continue
        if best is None or _robust_cost(found) < _robust_cost(best):
            best = found
    if best is None:
        raise InputError(
            f"views that a lens of kind {kind} explains",
            reasons[0] if reasons else "none",
            "check the target and the numbering of its corners, or try another --lens",
        )
    poses = _poses(best.rig.models[0], frames, views, len(alone.names))
    found = adjust(alone, places, replace(best.rig, T_target_body=poses))
    return _with_twin(found, places) if kind == "ds-none" else found


def _with_twin(found: Adjustment, places: Floats) -> Adjustment:
    """The better of both minima that a double sphere has.

    Which sphere comes first matters little over a moderate angle: with ξ above and below about 0.1 there is one minimum each, of
    the same focal length on the axis, f/(1 + ξ), and often of nearly the same error.
    """
    fx, fy, cx, cy, xi, _ = found.rig.models[0].parameters
    other_xi, other_alpha = _TWINS[int(xi > _BETWEEN_TWINS)]
    stretch = (1.0 + other_xi) / (1.0 + xi)
    start = lens("ds-none", np.array([stretch * fx, stretch * fy, cx, cy, other_xi, other_alpha]))
    try:
        twin = adjust(found.corners, places, replace(found.rig, models=(start,)))
    except InputError:
        return found
    if np.abs(twin.rig.models[0].parameters[4] - xi) < _ONE_MINIMUM:
        return found
    best, other = sorted((found, twin), key=lambda each: each.sigma_px)
    same = best.kept & other.kept
    squares = [float(np.sum(each.residuals[same] ** 2)) for each in (best, other)]
    return replace(best, other_minimum=max(squares[1] - squares[0], 0.0) / best.sigma_px**2)


def _poses(model: CameraModel, frames: list[int], views: list[tuple[Floats, Floats]], count: int) -> Floats:
    """T_target_camera (count, 7), NaN where a view does not give one."""
    poses = np.full((count, 7), np.nan)
    for frame, (pixels, at) in zip(frames, views, strict=True):
        T = target_pose(model, pixels, at)
        if T is not None:
            poses[frame] = se3.inverse(T)
    return poses


def usable_frames(corners: TargetCorners) -> list[int]:
    """Frames with enough corners."""
    frames, counts = np.unique(corners.frame_of, return_counts=True)
    return [int(frame) for frame in frames[counts >= _FEWEST_CORNERS]]


def _size_of(corners: TargetCorners) -> tuple[tuple[int, int], ...]:
    return (corners.sizes[int(corners.camera_of[0])],)


def _robust_cost(found: Adjustment) -> float:
    """Median error, growing with what was left out: a start that explains half of the corners well explains nothing."""
    lengths = np.linalg.norm(np.nan_to_num(found.residuals, nan=np.inf), axis=1)
    return float(np.percentile(lengths, 80))


def tilts_deg(rig: Rig) -> Floats:
    """(F,) angle between the first camera's axis and the target's normal [deg], NaN where there is no pose."""
    normal = np.full(len(rig.T_target_body), np.nan)
    known = np.isfinite(rig.T_target_body[:, 0])
    R_target_body = quaternion.to_matrix(np.ascontiguousarray(rig.T_target_body[known, :4]))
    normal[known] = np.degrees(np.arccos(np.clip(np.abs(R_target_body[:, 2, 2]), 0.0, 1.0)))
    return normal
