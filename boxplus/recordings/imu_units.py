"""Finding out the units of an IMU from what it measured.

The accelerometer at rest, or in the median of any motion a robot survives, shows one gravity: about 1 in g, about 9.8 in m/s².
The gyroscope is compared with it: gravity, seen from the IMU, turns with -ω × g, and only one unit of ω fits. Where the two fit
alike, nothing turned, and the message's definition holds (sensor_msgs/Imu and REP 103: rad/s).
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
_FASTEST_RAD_S = 35.0
"""2000 °/s, the range of the fastest common gyroscopes."""
_WINDOW_S = 0.25
_RAD_FITS = 0.8
_DEG_FITS = 0.3
"""The misfit of one unit as a share of the other's, below which it is taken: stricter for the unusual one."""


def read_accel_unit(accel: NDArray[np.float64], options: RecordingOptions) -> tuple[AccelUnit, Evidence]:
    """Unit of the acceleration (N, 3), from its median norm.

    Raises:
        RecordingError: no finite sample.
        AmbiguityError: the norm is neither one gravity in g nor in m/s².
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
    return fitting[0], Evidence("accel_unit", fitting[0], "ok", f"median |acceleration| is {norm:.3f} over {len(norms)} samples")


def read_gyro_unit(
    time_ns: NDArray[np.int64], gyro: NDArray[np.float64], accel: NDArray[np.float64], options: RecordingOptions
) -> tuple[GyroUnit, Evidence]:
    """Unit of the angular velocity (N, 3), from how fast gravity turns in the accelerometer (N, 3, any unit).

    Raises:
        AmbiguityError: the values are too fast for rad/s and the turn of gravity does not tell deg/s.
    """
    norms = _norms(gyro)
    fast = float(np.quantile(norms, 0.9)) if len(norms) else 0.0
    rad, deg = gravity_misfits(time_ns, gyro, accel)
    measured: GyroUnit | None = "rad/s" if rad < _RAD_FITS * deg else "deg/s" if deg < _DEG_FITS * rad else None
    seen = (
        f"every {_WINDOW_S} s the turn of gravity in the accelerometer differs from the gyroscope's by {np.degrees(rad):.2f} deg "
        f"(rms) if it is in rad/s, by {np.degrees(deg):.2f} deg if in deg/s"
    )
    given = options.gyro_unit
    if given is not None:
        if measured is None or measured == given:
            return given, Evidence("gyro_unit", given, "ok", f"given; {seen}")
        return given, Evidence("gyro_unit", given, "warning", f"given, but {seen}: check --gyro-unit")
    if measured is not None:
        return measured, Evidence("gyro_unit", measured, "ok", seen)
    if fast > _FASTEST_RAD_S:
        raise AmbiguityError(
            f"angular velocities below {_FASTEST_RAD_S:.0f} rad/s (2000 deg/s)",
            f"{fast:.1f} in the fastest tenth of the first samples: deg/s, or a broken sensor",
            "say the unit with --gyro-unit rad/s or deg/s",
        )
    text = f"by the message's definition; {seen}, which does not decide; 'boxplus inspect' compares with the LiDAR"
    return "rad/s", Evidence("gyro_unit", "rad/s", "ok", text)


def _norms(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Norms of those vectors (N, 3) whose norm is finite."""
    with np.errstate(over="ignore"):
        norms: NDArray[np.float64] = np.linalg.norm(vectors, axis=1)
    return norms[np.isfinite(norms)]


def gravity_misfits(time_ns: NDArray[np.int64], gyro: NDArray[np.float64], accel: NDArray[np.float64]) -> tuple[float, float]:
    """How badly the turn of gravity fits a gyroscope in rad/s, and one in deg/s: rms per window [rad].

    Window means of the direction of gravity d change by -ω × d Δt; a constant bias of ω is fitted. Equal misfits (0, 0 without
    data) mean that nothing turned.
    """
    finite = (np.abs(gyro) < 1e6).all(axis=1) & (np.abs(accel) < 1e6).all(axis=1)
    time_ns, gyro, accel = time_ns[finite], gyro[finite], accel[finite]
    if len(time_ns) < 8 or time_ns[-1] - time_ns[0] < 4 * _WINDOW_S * 1e9:
        return 0.0, 0.0
    seconds = (time_ns - time_ns[0]) * 1e-9
    window = np.maximum.accumulate((seconds / _WINDOW_S).astype(np.int64))
    _, begin = np.unique(window, return_index=True)
    count = np.diff(np.append(begin, len(window)))[:, None]
    rate = np.add.reduceat(gyro, begin) / count
    direction = np.add.reduceat(accel, begin) / count
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    step = np.diff(np.add.reduceat(seconds, begin) / count[:, 0])[:, None]
    halfway = 0.5 * (direction[1:] + direction[:-1])
    turned = np.cross(halfway, 0.5 * (rate[1:] + rate[:-1])) * step
    seen = np.diff(direction, axis=0)
    biases = np.stack([np.cross(halfway, unit) * step for unit in np.eye(3)], axis=2).reshape(-1, 3)

    def misfit(scale: float) -> float:
        rest = (seen - scale * turned).reshape(-1)
        rest = rest - biases @ np.linalg.lstsq(biases, rest, rcond=None)[0]
        return float(np.linalg.norm(rest)) / float(np.sqrt(len(seen)))

    return misfit(GYRO_SCALE["rad/s"]), misfit(GYRO_SCALE["deg/s"])
