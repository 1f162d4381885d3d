"""What to doubt about a comparison: an alignment that the positions do not determine, files that mean something else."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.evaluation.alignment import Alignment, PositionAlignment, align
from boxplus.evaluation.association import Association
from boxplus.evaluation.doubts.mean_rotation import in_one_world_deg, mean_rotation, scatter_deg, turned_deg, world_turn
from boxplus.evaluation.statistics import rms
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion, so3

_MIRROR = "a mirror image would fit better than any rotation: does one of the files have a flipped axis, or two that are swapped?"
_W_LAST = [1, 2, 3, 0]  # takes for (w, x, y, z) what was read as (x, y, z, w)
_FAR_DEG = 10.0  # scatter of the orientations' differences that no estimate of these positions has
_CLEARLY = 0.2  # times the error as read, that of another reading has to reach
_AS_GOOD = 1.5  # times the error of the better one of two readings, up to which either may be meant
_SCALED, _SCALE = 0.5, 0.01  # times the error, and difference of the scale from 1, from which on a scale is told
_LEAST, _ROUNDS, _TURNS = 50, 10, 0.05  # poses; repetitions; turning in rad, about every axis, for another point to show
_FITS = 0.1  # of the size of the path: an error up to which the positions are of the same path
_CONSTANT_DEG, _LOOSE = 2.0, 2.0  # rotation between body frames that is told, and times what the alignment may be off by
_STILL_DEG, _TURNED_DEG = 0.1, 5.0  # turns from the mean orientation of a file that has none, and of one that has
_BUT_FEW = 0.95  # quantile of these of the one that has
_ALONG = 0.99  # cosine between a lever and the way, where stamps that are off do the same
_UNLIKE = 0.6  # of the size of the path, that an alignment leaves of one with which it has nothing in common
_OVER_NOISE = 1.5  # times the noise of the estimate, which alone leaves a median of 0.9, and no other path shows up to
_STRAIGHT = 0.02  # second against first principal deviation, up to which a way is straight


def alignment_doubts(
    association: Association, alignment: Alignment, translation: NDArray[np.float64], rotation: NDArray[np.float64]
) -> list[str]:
    """What the positions do not determine, and what they fit better.

    Args:
        translation: (M,) errors [m]. rotation: (M, 3) rotation vectors from the estimate's to the true orientations [rad].
    """
    doubts = []
    rmse = rms(translation)
    about_line = alignment.kind in ("se3", "sim3") and alignment.spread_m[1] < rmse
    if about_line:
        doubts.append(
            f"the path strays {alignment.spread_m[1]:.3g} m from a straight line, less than the error of {rmse:.3g} m: the "
            "rotation of the alignment about that line is mostly noise"
        )
    flat = association.ground_truth.p[:, :2]
    wide = float(np.sqrt(((flat - flat.mean(axis=0)) ** 2).sum(axis=1).mean()))
    undetermined = alignment.kind == "yaw" and wide < rmse
    if undetermined:
        doubts.append(
            f"the path spreads over {wide:.3g} m horizontally, less than the error of {rmse:.3g} m: the heading of the alignment "
            "is mostly noise"
        )
    if alignment.mirrored:
        doubts.append(_MIRROR)
    R = so3.exp(rotation)
    mean = so3.log(mean_rotation(R)[None])[0]
    constant = float(np.degrees(np.linalg.norm(mean)))
    scatter = scatter_deg(np.broadcast_to(np.eye(3), R.shape), R)
    loose = _loose(association.ground_truth, alignment, rmse, wide)
    w_first = _w_first(association.estimate, association.ground_truth, alignment, scatter, rmse)
    if w_first is not None:
        doubts.append(w_first)
    elif alignment.kind == "none" and (worlds := _worlds(association, scatter)) is not None:
        doubts.append(worlds)
    elif _is_beyond(mean, loose) and scatter < min(0.5 * constant, _FAR_DEG) and not undetermined:
        w, x, y, z = quaternion.from_matrix(so3.exp(mean[None]))[0]
        doubts.append(
            f"the orientations differ by a constant {constant:.1f}° (scatter {scatter:.1f}°): the body frames are not the same, "
            "and the rotation error and the relative errors contain that; the pose of the one body in the other's frame can be "
            f"given, for this rotation with --transform-right 'xyz_qxyzw: 0 0 0 {x:.5f} {y:.5f} {z:.5f} {w:.5f}'"
        )
    return doubts


def _worlds(association: Association, scatter: float) -> str | None:
    """A sentence where orientations differ by a turn of the world, not of the body.

    Of a body that turns about one axis, as a car does, or not at all, both read alike: there the positions decide.

    Args:
        scatter: of the orientations as they were read [deg].
    """
    world = world_turn(association.estimate, association.ground_truth)
    turn = float(np.degrees(np.linalg.norm(so3.log(world[None])[0])))
    in_one_world = scatter_deg(world @ association.estimate.R, association.ground_truth.R)
    if turn <= _CONSTANT_DEG or in_one_world > max(scatter, _CONSTANT_DEG):
        return None
    if not (scatter > _CONSTANT_DEG and in_one_world < _CLEARLY * scatter):
        estimate, truth = (x.p - x.p.mean(axis=0) for x in (association.estimate, association.ground_truth))
        as_read, turned = (rms(np.linalg.norm(truth - estimate @ R.T, axis=1)) for R in (np.eye(3), world))
        if turned >= _CLEARLY * as_read:
            return None
    return (
        f"the orientations differ by {turn:.1f}° in the world (scatter {in_one_world:.1f}°): the worlds are not the same, and "
        "all errors but the relative ones contain that; --align se3 lays one over the other"
    )


def _loose(truth: Trajectory, alignment: Alignment, rmse: float, wide: float) -> NDArray[np.float64]:
    """Rotation that an alignment by positions may be off by where they are off by `rmse`, as drift is.

    About every principal axis of the path it is that error over the spread around the axis: on a straight way much about the way
    and little about all else.

    Args:
        wide: how far the path spreads horizontally [m].

    Returns:
        (3, 3) whose columns are what that does to the mean rotation between the bodies, in the body's frame [rad].
    """
    if alignment.kind in ("none", "origin"):
        return np.zeros((3, 3))
    if alignment.kind == "yaw":
        axes, around = np.eye(3), np.array([np.inf, np.inf, wide])
    else:
        axes = np.linalg.svd(truth.p - truth.p.mean(axis=0), full_matrices=False)[2].T
        around = np.array([np.hypot(*np.delete(alignment.spread_m, axis)) for axis in range(3)])
    return np.asarray(truth.R.mean(axis=0).T @ axes * (rmse / np.maximum(around, 1e-12)))


def _is_beyond(mean: NDArray[np.float64], loose: NDArray[np.float64]) -> bool:
    """Whether a mean rotation (3,) is more than what is told and the alignment explain together [rad]."""
    least = np.radians(_CONSTANT_DEG) / _LOOSE
    return float(mean @ np.linalg.solve(loose @ loose.T + least**2 * np.eye(3), mean)) > _LOOSE**2


def reading_doubts(association: Association, alignment: Alignment, translation: NDArray[np.float64]) -> list[str]:
    """Whether files agree far better read in another way: quaternion's order, inverse, scale, point of the body."""
    estimate, truth, rmse = association.estimate, association.ground_truth, rms(translation)
    return [
        *_orientation_doubts(estimate, truth, alignment, rmse),
        *_inversion_doubts(estimate, truth, alignment, rmse),
        *_scale_doubts(estimate, truth, alignment),
        *_lever_doubts(estimate, truth, alignment, association.offset_s),
        *_world_doubts(estimate, truth, alignment, rmse),
        *_unrelated_doubts(estimate, truth),
    ]


def _orientation_doubts(estimate: Trajectory, truth: Trajectory, alignment: Alignment, rmse: float) -> Iterator[str]:
    R = alignment.R_world_estimate
    scatter = scatter_deg(R @ estimate.R, truth.R)
    for name, one, other in (("estimate", estimate, truth), ("ground truth", truth, estimate)):
        if turned_deg(one).max() < _STILL_DEG and np.quantile(turned_deg(other), _BUT_FEW) > _TURNED_DEG:
            yield (
                f"the orientations of the {name} never change: it has none, and the rotation error and the relative errors mean "
                "nothing"
            )
            return
    if _may_turn(alignment, rmse, scatter):
        scatter = min(scatter, in_one_world_deg(estimate, truth))
    if scatter < _FAR_DEG:
        return
    conjugates = {
        "the estimate": scatter_deg(R @ estimate.R.transpose(0, 2, 1), truth.R),
        "the ground truth": scatter_deg(R @ estimate.R, truth.R.transpose(0, 2, 1)),
    }
    which = min(conjugates, key=lambda name: conjugates[name])
    least, other_way = conjugates[which], max(conjugates.values())
    if least < _CLEARLY * scatter:
        if other_way < _AS_GOOD * least:  # of one world, either undoes it
            which = "one file"
        yield (
            f"the orientations scatter by {scatter:.0f}° as they were read, and by {least:.1f}° if those of {which} are "
            "inverted and its positions are not: conjugate its quaternions; rotation error and relative errors mean nothing"
        )
        return
    # Where positions differ, too, what makes them differ turns them.
    if _w_first(estimate, truth, alignment, scatter, rmse) is None and rmse < _FITS * alignment.spread_m[0]:
        yield (
            f"the orientations scatter by {scatter:.0f}° against the ground truth's: another convention, or none; "
            "look at the positions alone"
        )


def _may_turn(alignment: Alignment, rmse: float, angle_deg: float) -> bool:
    """Whether a path is so straight that the alignment may be off by this angle about it, for positions off by `rmse`."""
    return bool(alignment.kind in ("se3", "sim3") and np.degrees(rmse) > angle_deg * alignment.spread_m[1])


def _w_first(estimate: Trajectory, truth: Trajectory, alignment: Alignment, scatter: float, rmse: float) -> str | None:
    """A sentence where orientations agree clearly better with other columns; of a body that turns little, they hardly scatter.

    Args:
        scatter: of the orientations as they were read [deg].
    """
    R = alignment.R_world_estimate
    swapped = [quaternion.to_matrix(np.ascontiguousarray(x.q_wxyz[:, _W_LAST])) for x in (estimate, truth)]
    ways = {
        "the estimate": scatter_deg(R @ swapped[0], truth.R),
        "the ground truth": scatter_deg(R @ estimate.R, swapped[1]),
        "both files": scatter_deg(R @ swapped[0], swapped[1]),
    }
    way = min(ways, key=lambda name: ways[name])
    if alignment.kind == "none" or _may_turn(alignment, rmse, scatter):  # worlds that are turned turn the bodies apart
        scatter = min(scatter, in_one_world_deg(estimate, truth))
    if not (scatter > _CONSTANT_DEG and ways[way] < _CLEARLY * scatter):
        return None
    return (
        f"the orientations scatter by {scatter:.1f}° as they were read, and by {ways[way]:.1f}° if the quaternions of {way} are "
        "taken for qw qx qy qz: reorder the columns, the rotation error and the relative errors mean nothing"
    )


def _inversion_doubts(estimate: Trajectory, truth: Trajectory, alignment: Alignment, rmse: float) -> Iterator[str]:
    kind: PositionAlignment = "sim3" if alignment.kind == "sim3" else "se3"
    if alignment.kind in ("none", "origin"):  # of what the worlds have in common, `_world_doubts` tells
        try:
            rmse = rms(np.linalg.norm(align(estimate.p, truth.p, kind).apply(estimate).p - truth.p, axis=1))
        except InputError:
            return
    errors = {}
    for name, one, other in (("estimate", estimate, truth), ("ground truth", truth, estimate)):
        p = -np.einsum("nba,nb->na", one.R, one.p)
        try:
            found = align(p, other.p, kind)
        except InputError:
            continue
        moved = found.apply(replace(one, p=p, covariance=None, lines=None)).p
        errors[name] = rms(np.linalg.norm(moved - other.p, axis=1))
    clear = sorted((error, name) for name, error in errors.items() if error < _CLEARLY * rmse)
    if not clear:
        return
    if len(clear) == 2 and clear[1][0] < _AS_GOOD * clear[0][0]:  # undoing either undoes what the other one does
        yield (
            f"the poses of one of the files seem to be those of the world in the body: the ATE is {errors['estimate']:.4g} m "
            f"with the estimate inverted, {errors['ground truth']:.4g} m with the ground truth, instead of {rmse:.4g} m"
        )
        return
    error, name = clear[0]
    yield (
        f"the poses of the {name} seem to be those of the world in the body: inverted, the ATE is {error:.4g} m instead of "
        f"{rmse:.4g} m"
    )


def _scale_doubts(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> Iterator[str]:
    if alignment.kind == "sim3":
        return
    try:
        rigid, found = align(estimate.p, truth.p), align(estimate.p, truth.p, "sim3")
    except InputError:
        line = _OnLine.of(estimate, truth)
        if line is None:
            return
        scale, rmse, error, spread = line.scale, line.rigid_m, line.scaled_m, line.spread_m
    else:
        rmse, error = (rms(np.linalg.norm(one.apply(estimate).p - truth.p, axis=1)) for one in (rigid, found))
        scale, spread = found.scale, float(rigid.spread_m[0])
    if error < min(_SCALED * rmse, _FITS * spread) and abs(scale - 1.0) > _SCALE:
        yield (
            f"{scale:.4g} times as large the estimate has, rigidly aligned, an ATE of {error:.4g} m instead of {rmse:.4g} "
            "m: a wrong scale is most of its error (--align sim3, for an estimate that has none)"
        )


def _lever_doubts(estimate: Trajectory, truth: Trajectory, alignment: Alignment, offset_s: float) -> Iterator[str]:
    """Whether the ground truth is that of another point of the body: p_truth = s R (p + R_estimate l) + t, with l sought.

    Args:
        offset_s: what was added to the stamps of the estimate before.
    """
    kind: PositionAlignment = "sim3" if alignment.kind == "sim3" else "se3"
    if len(estimate) < _LEAST:
        return
    try:
        found = align(estimate.p, truth.p, kind)
    except InputError:
        return
    rmse = rms(np.linalg.norm(found.apply(estimate).p - truth.p, axis=1))
    turned = (estimate.R - estimate.R.mean(axis=0)).reshape(-1, 3)
    able = np.linalg.svd(turned, full_matrices=False)
    shown = able[1] > _TURNS * np.sqrt(len(estimate))
    if np.count_nonzero(shown) < 2:
        return
    # Along an axis that the body turns about alone, and about no other, no lever shows, and none is told.
    solve = able[2][shown].T @ (able[0][:, shown] / able[1][shown]).T
    for _ in range(_ROUNDS):  # the lever given the alignment, and the other way round: they hardly depend on each other
        rest = (truth.p - found.apply(estimate).p) @ found.R_world_estimate / found.scale
        lever = solve @ (rest - rest.mean(axis=0)).reshape(-1)
        moved = replace(estimate, p=estimate.p + estimate.R @ lever, covariance=None, lines=None)
        found = align(moved.p, truth.p, kind)
    error = rms(np.linalg.norm(found.apply(moved).p - truth.p, axis=1))
    if error < min(_SCALED * rmse, _FITS * found.spread_m[0]) and np.linalg.norm(lever) > error:
        x, y, z = lever
        late_s = _late_s(estimate, lever)
        other = ""
        if late_s is not None:
            digits = max(1 - math.floor(math.log10(abs(late_s))), 0)  # two of what is missing
            other = f"; or stamps are off, as that lies along the way: with about --offset {offset_s + late_s:.{digits}f}"
        yield (
            f"the ground truth seems to be that of another point of the body, at ({x:.3f}, {y:.3f}, {z:.3f}) m in the frame of "
            f"the estimate's: of that point the ATE is {error:.4g} m instead of {rmse:.4g} m (where the axes of both bodies are "
            f"parallel, --transform-right 'xyz: {-x:.3f} {-y:.3f} {-z:.3f}'{other})"
        )


def _late_s(estimate: Trajectory, lever: NDArray[np.float64]) -> float | None:
    """What has to be added to the stamps to move the poses as this lever (3,) does; None where it does not lie along the way."""
    if estimate.time_ns is None:
        return None
    v = np.gradient(estimate.p, (estimate.times - estimate.times[0]) * 1e-9, axis=0)
    forward = np.median(np.einsum("nji,nj->ni", estimate.R, v), axis=0)
    speed, length = float(np.linalg.norm(forward)), float(np.linalg.norm(lever))
    if not (speed > 0.0 and abs(float(lever @ forward)) > _ALONG * speed * length):
        return None
    return -float(lever @ forward) / speed**2


def _world_doubts(estimate: Trajectory, truth: Trajectory, alignment: Alignment, rmse: float) -> Iterator[str]:
    """Whether an alignment that leaves the world as it is, or its vertical, hides that the worlds have other axes."""
    if alignment.kind in ("se3", "sim3"):
        return
    try:
        found = align(estimate.p, truth.p)
    except InputError:
        line = _OnLine.of(alignment.apply(estimate), truth)
        if line is None or alignment.kind == "yaw" or not line.rigid_m < min(_CLEARLY * rmse, _FITS * line.spread_m):
            return
        if line.angle_deg > _CONSTANT_DEG or rmse > _FITS * line.spread_m:  # less a first pose with noise explains
            yield (
                f"both ways are straight, in directions that differ by {line.angle_deg:.1f}°, and laid onto each other they are "
                f"{line.rigid_m:.4g} m apart instead of {rmse:.4g} m: worlds, or first poses, of the files are not the same"
            )
        return
    if found.mirrored:
        yield _MIRROR
    error = rms(np.linalg.norm(found.apply(estimate).p - truth.p, axis=1))
    if not error < min(_CLEARLY * rmse, _FITS * found.spread_m[0]):
        return
    angle = float(np.degrees(np.linalg.norm(so3.log(found.R_world_estimate[None])[0])))
    yield (
        f"with a rotation by {angle:.1f}° and a translation by {np.linalg.norm(found.p_world_estimate):.4g} m the ATE is "
        f"{error:.4g} m instead of {rmse:.4g} m: the worlds of the two files are not the same, or differ in axes (ENU, NED): "
        "--align se3"
    )


def _unrelated_doubts(estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """Whether no alignment brings the two paths together: an estimate of something else, or one that is lost."""
    try:
        found = align(estimate.p, truth.p)
    except InputError:
        return
    # The median, as few poses far off are no other path.
    moved = found.apply(estimate).p
    error = float(np.median(np.linalg.norm(moved - truth.p, axis=1)))
    size = float(np.linalg.norm(found.spread_m))
    if error > max(_UNLIKE * size, _OVER_NOISE * _noise(moved, truth.p)):
        yield (
            f"laid onto each other as well as possible half of the poses are still {error:.4g} m apart, where the path spreads "
            f"over {size:.4g} m: the two have nothing in common, the estimate is lost, or the files are not of the same run"
        )


def _noise(p: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Root mean square of the noise of positions (M, 3), as their second differences exceed those of the motion [m].

    Zero of fewer than three.
    """
    own, true = (float((np.diff(x, 2, axis=0) ** 2).sum()) for x in (p, truth))
    return float(np.sqrt(max(own - true, 0.0) / (6.0 * max(len(p) - 2, 1))))  # of white noise: 1² + 2² + 1²


@dataclass(frozen=True, slots=True)
class _OnLine:
    """Two straight ways: how much longer the ground truth's is, the angle between them, and how far apart they are laid onto each
    other, as they are and scaled [m]; `spread_m` is that of the ground truth."""

    scale: float
    angle_deg: float
    rigid_m: float
    scaled_m: float
    spread_m: float

    @classmethod
    def of(cls, estimate: Trajectory, truth: Trajectory) -> _OnLine | None:
        """None where one of them is no straight way."""
        own, true = (poses.p - poses.p.mean(axis=0) for poses in (estimate, truth))
        axes, along = [], []
        for p in (own, true):
            _, d, Vt = np.linalg.svd(p, full_matrices=False)
            if not d[0] > 0.0 or d[1] > _STRAIGHT * d[0]:
                return None
            axes.append(Vt[0])
            along.append(p @ Vt[0])
        x, y = along
        sign = 1.0 if x @ y > 0.0 else -1.0
        scale = sign * float(x @ y) / float(x @ x)
        angle = float(np.degrees(np.arccos(np.clip(sign * axes[0] @ axes[1], -1.0, 1.0))))
        return cls(scale, angle, rms(sign * x - y), rms(scale * sign * x - y), rms(y))
