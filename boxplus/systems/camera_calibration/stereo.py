"""Several cameras on one body: how they are mounted to each other, and whether they were, and looked, together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, SingularProblemError
from boxplus.manifolds import se3
from boxplus.systems.camera_calibration.adjustment import Adjustment, Rig, adjust
from boxplus.systems.camera_calibration.corners import TargetCorners

Floats = NDArray[np.float64]

_FEWEST_SHARED = 3
_SHIFTS = (-2, -1, 1, 2)
_SHIFT_FACTOR = 3.0


@dataclass(frozen=True, slots=True)
class PairAgreement:
    """How well one camera keeps its place to another over the frames.

    Attributes:
        first, second: the cameras.
        frames: that both saw.
        scatter_deg, scatter_m: median distance of a frame's relative pose from the usual one.
        swapped: frames in which the second seems to be the first and the other way round.
        late_frames: by how many frames the second is late, where a shift fits much better than none; 0 else.
    """

    first: int
    second: int
    frames: int
    scatter_deg: float
    scatter_m: float
    swapped: tuple[int, ...]
    late_frames: int


def join(corners: TargetCorners, places: Floats, singles: list[Adjustment]) -> tuple[Adjustment | None, list[PairAgreement]]:
    """The rig of cameras that were calibrated one by one, or None where they do not keep their places at all.

    Args:
        places: (n, 3) of the target's corners [m].
        singles: one for each camera.

    Raises:
        InputError: cameras that never saw the target together.
    """
    poses = [single.rig.T_target_body for single in singles]  # T_target_camera
    count = len(singles)
    T_body_camera = np.full((count, 7), np.nan)
    T_body_camera[0] = se3.exp(np.zeros(6))
    agreements: list[PairAgreement] = []
    waiting = list(range(1, count))
    while waiting:
        link = next(
            (
                (known, new)
                for new in waiting
                for known in range(count)
                if np.isfinite(T_body_camera[known, 0]) and len(_shared(poses[known], poses[new])) >= _FEWEST_SHARED
            ),
            None,
        )
        if link is None:
            raise InputError(
                f"cameras that saw the target together in {_FEWEST_SHARED} frames or more",
                f"cam{waiting[0]} with {max(len(_shared(poses[0], poses[waiting[0]])), 0)} of cam0",
                "give images of one instant the same frame number or time; where the cameras are not triggered together, "
                "calibrate them one by one",
            )
        known, new = link
        waiting.remove(new)
        usual = _usual(_relative(poses[known], poses[new]))
        agreements.append(_agreement(known, new, poses, usual))
        T_body_camera[new] = se3.compose(T_body_camera[known], usual)
    bodies = np.full_like(poses[0], np.nan)
    for camera in reversed(range(count)):
        there = np.isfinite(poses[camera][:, 0])
        bodies[there] = se3.compose(poses[camera][there], se3.inverse(T_body_camera[camera]))
    start = Rig(
        tuple(single.rig.kinds[0] for single in singles),
        tuple(single.rig.models[0] for single in singles),
        T_body_camera,
        bodies,
    )
    try:
        return adjust(corners, places, start), agreements
    except (InputError, SingularProblemError):  # next to nothing of a camera fits to the others
        return None, agreements


def _shared(first: Floats, second: Floats) -> NDArray[np.intp]:
    return np.flatnonzero(np.isfinite(first[:, 0]) & np.isfinite(second[:, 0]))


def _relative(first: Floats, second: Floats) -> Floats:
    """(K, 7) T_first_second of the shared frames."""
    frames = _shared(first, second)
    return se3.compose(se3.inverse(first[frames]), second[frames])


def _distances(T: Floats, reference: Floats) -> tuple[Floats, Floats]:
    """Angle [rad] and distance [m] of poses (K, 7) from one."""
    step = se3.compose(se3.inverse(np.tile(reference, (len(T), 1))), T)
    return np.linalg.norm(se3.log(step)[:, :3], axis=1), np.linalg.norm(step[:, 4:], axis=1)


def _usual(T: Floats) -> Floats:
    """The pose of (K, 7) that is nearest to the others in the median: single frames that are wrong do not matter."""
    scale = float(np.median(np.linalg.norm(T[:, 4:], axis=1))) + 1e-9
    totals = []
    for candidate in T:
        angle, distance = _distances(T, candidate)
        totals.append(float(np.median(angle + distance / scale)))
    return np.asarray(T[int(np.argmin(totals))])


def _scatter(T: Floats, usual: Floats) -> tuple[float, float]:
    angle, distance = _distances(T, usual)
    return float(np.median(angle)), float(np.median(distance))


def _agreement(first: int, second: int, poses: list[Floats], usual: Floats) -> PairAgreement:
    frames, T = _shared(poses[first], poses[second]), _relative(poses[first], poses[second])
    angle, distance = _scatter(T, usual)
    back = se3.inverse(usual)
    straight, crossed = _distances(T, usual)[1], _distances(T, back)[1]
    baseline = float(np.linalg.norm(usual[4:]))
    swapped = frames[(crossed < 0.3 * straight) & (straight > baseline)]
    late = 0
    best = distance
    for shift in _SHIFTS:
        moved = np.full_like(poses[second], np.nan)
        if shift > 0:
            moved[:-shift] = poses[second][shift:]
        else:
            moved[-shift:] = poses[second][:shift]
        T_moved = _relative(poses[first], moved)
        if len(T_moved) < max(_FEWEST_SHARED, len(T) // 2):
            continue
        scatter = _scatter(T_moved, _usual(T_moved))[1]
        if scatter < best and scatter * _SHIFT_FACTOR < distance:
            best, late = scatter, shift
    return PairAgreement(
        first, second, len(frames), float(np.degrees(angle)), distance, tuple(int(frame) for frame in swapped), late
    )
