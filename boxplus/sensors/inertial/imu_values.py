"""Which IMU samples can be measurements at all."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sensors.inertial.imu import ImuSamples

NOT_FINITE, BEYOND = "IMU sample not finite", "IMU sample beyond any sensor"
EMPTY, GLITCH = "IMU sample of zeros", "IMU sample unlike both of its neighbours"
GYRO_LIMIT, ACCEL_LIMIT = 100.0, 400.0  # rad/s, m/s²: more than any IMU on a robot measures
# Per second, and at least: no platform turns or is pushed so much from one sample to the next, and back to the one after.
_GLITCH_GYRO, _GLITCH_ACCEL = (1000.0, 3.0), (20_000.0, 100.0)  # rad/s² and rad/s, m/s³ and m/s²
_USUAL = 10.0  # times what the samples before differ by: a shaken IMU differs from sample to sample
BEFORE, _FEWEST = 20, 8  # steps before a sample that tell what is usual: so many at most, at least


def finite(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples are numbers throughout."""
    return np.asarray(np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1))


def beyond(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples are larger than what any sensor measures; NaN is not."""
    return np.asarray((np.abs(imu.gyro) > GYRO_LIMIT).any(axis=1) | (np.abs(imu.accel) > ACCEL_LIMIT).any(axis=1))


def empty(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples are zero throughout: messages that nobody filled, as nothing measures exactly that."""
    return np.asarray(~(imu.gyro.any(axis=1) | imu.accel.any(axis=1)))


def measurements(imu: ImuSamples, rejected: Counter[str]) -> ImuSamples:
    """Samples that are numbers within what sensors measure; the others are counted by reason."""
    if np.abs(imu.gyro).max(initial=0.0) <= GYRO_LIMIT and np.abs(imu.accel).max(initial=0.0) <= ACCEL_LIMIT:
        return imu  # the usual case; NaN compares false
    numbers, too_large = finite(imu), beyond(imu)
    for reason, mask in ((NOT_FINITE, ~numbers), (BEYOND, too_large & numbers)):
        if mask.any():
            rejected[reason] += int(mask.sum())
    return imu.where(numbers & ~too_large)


def glitches(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples of some in order of time stand out from both of their neighbours, which are alike: no motion does that.

    Far from a neighbour is what no platform could turn or be pushed by in between, and ten times as far as the samples
    before are from one another; the first nine are not judged. Of the last one only the sample before is known.
    """
    mask = np.zeros(len(imu), dtype=bool)
    if len(imu) < 2:
        return mask
    last_is_far = False
    steps, far = np.empty(len(imu) - 1), np.empty(len(imu) - 1, np.bool_)
    for values, (rate, least) in ((imu.gyro, _GLITCH_GYRO), (imu.accel, _GLITCH_ACCEL)):
        if not _steps_into(imu.time_ns, values, rate, least, steps, far):
            continue
        for k in np.flatnonzero(far):  # the step into sample k + 1
            before = steps[max(k - BEFORE, 0) : k]
            if mask[k] or len(before) < _FEWEST or not steps[k] > _USUAL * float(np.median(before)):
                continue
            if k + 2 == len(imu):
                last_is_far = True
            elif far[k + 1]:
                across = float(np.linalg.norm(values[k + 2] - values[k]))
                mask[k + 1] |= across < 0.5 * min(steps[k], steps[k + 1])
    mask[-1] = last_is_far and not mask[-2]
    return mask


@kernel
def _steps_into(
    time_ns: NDArray[np.int64],
    values: NDArray[np.float64],
    rate: float,
    least: float,
    steps: NDArray[np.float64],
    far: NDArray[np.bool_],
) -> bool:
    """How far samples (n, 3) are from the one before, and where that is far (n - 1,); whether it is anywhere: nearly never."""
    any_far = False
    for k in range(len(steps)):
        squared = 0.0
        for axis in range(3):
            squared += (values[k + 1, axis] - values[k, axis]) ** 2
        steps[k] = math.sqrt(squared)
        far[k] = steps[k] > max(least, rate * (1e-9 * (time_ns[k + 1] - time_ns[k])))
        any_far |= far[k]
    return any_far
