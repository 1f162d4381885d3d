"""What few poses of an estimate do to its errors: poses far off, jumps, a pose that is repeated."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted
from boxplus.evaluation.statistics import rms
from boxplus.formats.trajectory import Trajectory

_FAR, _FEW, _LOAD = 10.0, 0.25, 0.5  # times the median error, share of the poses, and of the squared error, of poses far off
_JUMP, _USUAL, _OF_ERROR = 20.0, 0.95, 0.5  # times the usual error of a step, its quantile, and of the whole error
_LEAST, _ROUNDING = 30, 1e-9  # poses, and error as a share of the largest coordinate, for any of that to be told
_STILL, _LEAST_STILL, _WENT = 1e-6, 10, 0.1  # of the path, poses, and of the spread, for a pose that is repeated


def incident_doubts(aligned: Trajectory, truth: Trajectory, translation: NDArray[np.float64]) -> list[str]:
    """What to know of an error that few poses make.

    Args:
        aligned, truth: (M) matched poses in the frame of the ground truth. translation: (M,) errors [m].
    """
    if len(translation) < _LEAST or rms(translation) < _ROUNDING * float(np.abs(truth.p).max()):
        return []
    return [*_far_off(aligned, translation), *_jumps(aligned, truth, translation), *_stands(aligned, truth)]


def jump_doubts(estimate: Trajectory, ground_truth: Trajectory) -> Iterator[str]:
    """Stamps that jump by more than all the rest of a file lasts, where the other file does not reach across the jump."""
    for poses, other, name in ((estimate, ground_truth, "estimate"), (ground_truth, estimate, "ground truth")):
        steps = np.zeros(0) if poses.time_ns is None else np.diff(poses.time_ns) * 1e-9
        if len(steps) >= _LEAST and steps.max() > max(float(steps.sum() - steps.max()), _LEAST * float(np.median(steps))):
            row = int(np.argmax(steps))
            if other.time_ns is not None and other.time_ns[0] <= poses.times[row] and other.time_ns[-1] >= poses.times[row + 1]:
                continue  # one clock: nobody drove meanwhile
            yield (
                f"the stamps of the {name} jump by {steps[row]:.6g} s after pose {row} of {len(poses)}, more than all the rest "
                "lasts: two runs, or two clocks, in one file? Poses on one side of it may not be compared at all"
            )


def _when(trajectory: Trajectory, row: int) -> str:
    return f"pose {row}" if trajectory.time_ns is None else f"{(trajectory.time_ns[row] - trajectory.time_ns[0]) * 1e-9:.2f} s"


def _far_off(aligned: Trajectory, translation: NDArray[np.float64]) -> Iterator[str]:
    far = np.flatnonzero(translation > _FAR * float(np.median(translation)))
    share = float((translation[far] ** 2).sum() / max((translation**2).sum(), 1e-300))
    if 0 < len(far) <= max(_FEW * len(translation), 1) and share > _LOAD:
        worst = far[np.argmax(translation[far])]
        yield (
            f"{len(far)} of the {len(translation)} poses are off by more than {_FAR:g} times the median error and make up "
            f"{share:.0%} of the squared error; the farthest by {translation[worst]:.4g} m at {_when(aligned, int(worst))}: "
            "the ATE speaks for these, the median for the others"
        )


def _jumps(aligned: Trajectory, truth: Trajectory, translation: NDArray[np.float64]) -> Iterator[str]:
    off = np.linalg.norm(np.diff(aligned.p - truth.p, axis=0), axis=1)
    far = np.flatnonzero((off > _JUMP * np.quantile(off, _USUAL)) & (off > _OF_ERROR * rms(translation)))
    if len(far):
        worst = far[np.argmax(off[far])]
        yield (
            f"the estimate jumps {counted(len(far), 'time')} against the ground truth, by {off[worst]:.4g} m at "
            f"{_when(aligned, int(worst) + 1)}: what is before and after may be better than the errors say"
        )


def _stands(aligned: Trajectory, truth: Trajectory) -> Iterator[str]:
    size = float(np.linalg.norm(truth.p.std(axis=0)))
    step = np.linalg.norm(np.diff(aligned.p, axis=0), axis=1)
    moving = np.flatnonzero(np.concatenate([[True], step > _STILL * size, [True]]))
    longest = int(np.argmax(np.diff(moving)))
    first, last = int(moving[longest]), int(moving[longest + 1]) - 1
    # Steps would add up the noise of a ground truth that stands as well.
    went = float(np.linalg.norm(truth.p[first : last + 1] - truth.p[first], axis=1).max())
    if last - first >= _LEAST_STILL and went > _WENT * size:
        yield (
            f"the estimate repeats one position from {_when(aligned, first)} to {_when(aligned, last)}, while the ground truth "
            f"gets {went:.4g} m away: it had stopped there"
        )
