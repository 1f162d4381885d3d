"""Which IMU samples can be measurements at all."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.imu import ImuSamples

NOT_FINITE, BEYOND = "IMU sample not finite", "IMU sample beyond any sensor"
EMPTY, GLITCH = "IMU sample of zeros", "IMU sample unlike both of its neighbours"
"""Why a sample is left out that a sensor in order, and its driver, never deliver."""
GYRO_LIMIT, ACCEL_LIMIT = 100.0, 400.0  # rad/s, m/s²: more than any IMU on a robot measures
_GLITCH_GYRO, _GLITCH_ACCEL = 3.0, 100.0  # rad/s, m/s²: no platform turns or is pushed so much within two samples, and back
_USUAL = 10.0  # times what samples usually differ by: a shaken IMU differs from sample to sample
_NEAR_NS = 20_000_000  # farther apart, samples may differ by any motion
_FEWEST = 4


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
    """Samples that can be measurements; the others are counted by reason."""
    numbers, too_large, zero = finite(imu), beyond(imu), empty(imu)
    for reason, mask in ((NOT_FINITE, ~numbers), (BEYOND, too_large & numbers), (EMPTY, zero)):
        if mask.any():
            rejected[reason] += int(mask.sum())
    return imu.where(numbers & ~too_large & ~zero)


def calm(imu: ImuSamples) -> bool:
    """Whether no sample is so far from the one before that it could be a glitch."""
    steps = (np.diff(values, axis=0) for values in (imu.gyro, imu.accel))
    return all(
        not len(step) or float(np.linalg.norm(step, axis=1).max()) <= least
        for step, least in zip(steps, (_GLITCH_GYRO, _GLITCH_ACCEL), strict=True)
    )


def glitches(imu: ImuSamples) -> NDArray[np.bool_]:
    """(N,) which samples of some in order of time stand out from both of their neighbours, to which they are alike.

    A bit that flips on the way, not a motion. Of the last one only the sample before is known.
    """
    mask = np.zeros(len(imu), dtype=bool)
    if len(imu) < _FEWEST:
        return mask
    near, last_is_far = np.diff(imu.time_ns) <= _NEAR_NS, False
    for values, least in ((imu.gyro, _GLITCH_GYRO), (imu.accel, _GLITCH_ACCEL)):
        steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
        largest = steps.max()
        if not largest > least:  # nearly always
            continue
        far = near & (steps > max(least, _USUAL * float(np.median(steps))))
        across = np.linalg.norm(values[2:] - values[:-2], axis=1)
        mask[1:-1] |= far[1:] & far[:-1] & (across < 0.5 * np.minimum(steps[1:], steps[:-1]))
        last_is_far |= bool(far[-1])
    mask[-1] = last_is_far and not mask[-2]
    return mask
