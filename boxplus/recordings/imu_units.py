"""Finding out the units of an IMU from what it measured.

The accelerometer at rest, or in the median of any motion a robot survives, shows one gravity: about 1 in g, about 9.8 in m/s².
The gyroscope is in rad/s, as its message defines (sensor_msgs/Imu and REP 103), unless its rates are beyond any gyroscope.
Nothing that depends on the motion may overrule the definition: a multirotor's specific force, for one, does not turn with its
body. Whether the definition holds, the LiDAR's rotation tells (docs/agreement.md).

Some drivers deliver what is left without gravity. Of a lively motion that has a median of about 1 m/s², which looks like 1 g; but
it is next to nothing ever again, which an accelerometer shows in free fall only, and cancels out within seconds. A robot that
trots falls freely between its steps: what it feels does not cancel out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings.info import Evidence
from boxplus.recordings.options import AccelUnit, GyroUnit, RecordingOptions

STANDARD_GRAVITY = 9.80665
ACCEL_SCALE: dict[AccelUnit, float] = {"m/s2": 1.0, "g": STANDARD_GRAVITY}
GYRO_SCALE: dict[GyroUnit, float] = {"rad/s": 1.0, "deg/s": np.pi / 180.0}

_PLAUSIBLE_NORMS: dict[AccelUnit, tuple[float, float]] = {"g": (0.6, 1.6), "m/s2": (6.0, 16.0)}
_WEIGHTLESS = 0.52
"""Of the median: a tenth of the samples below it is free fall. In walks, drives and flights that tenth is below 0.67 and more,
shaken by 5 m/s² rms along every axis below 0.55; without gravity below 0.1 in walks and drives, 0.5 where it is noise alone."""
_PARTS, _CANCELLED = 4, 0.75
"""Parts of the samples, and the length of their mean accelerations over the median length: below it they cancel out. In flights
above 0.97, trotting above 0.8; flights without their gravity come to 0.14 to 0.63."""
_FASTEST_RAD_S = 35.0
"""2000 °/s, the range of the fastest common gyroscopes."""


def read_accel_unit(accel: NDArray[np.float64], options: RecordingOptions) -> tuple[AccelUnit, Evidence]:
    """Unit of the acceleration (N, 3), from its median norm.

    Raises:
        RecordingError: no finite sample.
        AmbiguityError: the norm is neither one gravity in g nor in m/s², or is about 1 and gravity seems to be missing.
    """
    norms = _norms(accel)
    if not len(norms):
        raise RecordingError("finite accelerations", "none in the first seconds", "check the IMU driver and --imu-topic")
    norm = float(np.median(norms))
    fitting = [unit for unit, (low, high) in _PLAUSIBLE_NORMS.items() if low <= norm <= high]
    given = options.accel_unit
    if given is not None:
        if given in fitting:
            return given, Evidence("accel_unit", given, "ok", f"given; median |acceleration| {norm:.3f} agrees")
        text = f"given, but median |acceleration| is {norm:.3f}, not one gravity: check --accel-unit"
        return given, Evidence("accel_unit", given, "warning", text)
    if not fitting:
        raise AmbiguityError(
            "a median |acceleration| of about 1 (g) or 9.8 (m/s2)",
            f"{norm:.4g} over {len(norms)} samples",
            "say the unit with --accel-unit; if it already is m/s2 or g, gravity is missing from the data and boxplus needs it",
        )
    least = float(np.quantile(norms, 0.1))
    if fitting[0] == "g" and least < _WEIGHTLESS * norm and _mean_length(accel) < _CANCELLED * norm:
        raise AmbiguityError(
            "accelerations with gravity in them, which never come near zero but in free fall",
            f"a median |acceleration| of {norm:.3f}, as of an accelerometer in g, and a tenth of the samples below {least:.3f}, "
            "as of one in m/s2 without gravity",
            "let the driver deliver what the accelerometer measures, gravity included (boxplus needs it); if it really is in g "
            "say so with --accel-unit g",
        )
    return fitting[0], Evidence("accel_unit", fitting[0], "ok", f"median |acceleration| is {norm:.3f} over {len(norms)} samples")


def read_gyro_unit(gyro: NDArray[np.float64], options: RecordingOptions) -> tuple[GyroUnit, Evidence]:
    """Unit of the angular velocity (N, 3): as given, else rad/s unless the fastest tenth is beyond any gyroscope in rad/s."""
    norms = _norms(gyro)
    fast = float(np.quantile(norms, 0.9)) if len(norms) else 0.0
    beyond = fast > _FASTEST_RAD_S
    seen = f"the fastest tenth of the samples turns with {fast:.3g} and more; no gyroscope reaches {_FASTEST_RAD_S:.0f} rad/s"
    given = options.gyro_unit
    if given is not None:
        if given == "rad/s" and beyond:
            return given, Evidence("gyro_unit", given, "warning", f"given, but {seen}: check --gyro-unit")
        return given, Evidence("gyro_unit", given, "ok", "given; 'boxplus inspect' compares with the LiDAR or the cameras")
    if beyond:
        return "deg/s", Evidence("gyro_unit", "deg/s", "ok", seen)
    text = "by the message's definition; 'boxplus inspect' compares with the LiDAR or the cameras"
    return "rad/s", Evidence("gyro_unit", "rad/s", "ok", text)


def _norms(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Norms of those vectors (N, 3) whose norm is finite."""
    with np.errstate(over="ignore"):
        norms: NDArray[np.float64] = np.linalg.norm(vectors, axis=1)
    return norms[np.isfinite(norms)]


def _mean_length(accel: NDArray[np.float64]) -> float:
    """Length of the mean of some seconds' accelerations, in the median of the parts of (N, 3)."""
    with np.errstate(over="ignore"):
        finite = accel[np.isfinite(np.linalg.norm(accel, axis=1))]
    parts = np.array_split(finite, min(_PARTS, len(finite)))
    return float(np.median([np.linalg.norm(part.mean(axis=0)) for part in parts]))
