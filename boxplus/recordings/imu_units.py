"""Finding out the units of an IMU from what it measured.

The accelerometer at rest, or in the median of any motion a robot survives, shows one gravity: about 1 in g, about 9.8 in m/s².
The gyroscope is compared with it: gravity, seen from the IMU, turns with -ω × g, so the ratio of the two is 1 in rad/s and
57.3 in deg/s. Where too little turns to tell, the message's definition holds (sensor_msgs/Imu and REP 103: rad/s).
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
_LEAST_TURN_RAD = 0.03
_SIGNIFICANT = 6.0


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
    ratio, turned = gravity_turn_ratio(time_ns, gyro, accel)
    measured: GyroUnit | None = None
    if ratio is not None:
        measured = "rad/s" if ratio < 7.6 else "deg/s"
    seen = f"gyro and accelerometer turn by a ratio of {ratio:.1f} (1 in rad/s, 57.3 in deg/s)" if ratio is not None else ""
    given = options.gyro_unit
    if given is not None:
        if measured is None or measured == given:
            return given, Evidence("gyro_unit", given, "ok", f"given; {seen or 'too little rotation to check it'}")
        return given, Evidence("gyro_unit", given, "warning", f"given, but {seen}: check --gyro-unit")
    if measured is not None:
        return measured, Evidence("gyro_unit", measured, "ok", seen)
    if fast > _FASTEST_RAD_S:
        raise AmbiguityError(
            f"angular velocities below {_FASTEST_RAD_S:.0f} rad/s (2000 deg/s)",
            f"{fast:.1f} in the fastest tenth of the first samples: deg/s, or a broken sensor",
            "say the unit with --gyro-unit rad/s or deg/s",
        )
    text = (
        f"by the message's definition: the turn of gravity in the first seconds ({np.degrees(turned):.1f} deg, noise included) "
        f"does not show it; the fastest tenth turns at {fast:.3f}; 'boxplus inspect' compares with the LiDAR"
    )
    return "rad/s", Evidence("gyro_unit", "rad/s", "ok", text)


def _norms(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Norms of those vectors (N, 3) whose norm is finite."""
    with np.errstate(over="ignore"):
        norms: NDArray[np.float64] = np.linalg.norm(vectors, axis=1)
    return norms[np.isfinite(norms)]


def gravity_turn_ratio(
    time_ns: NDArray[np.int64], gyro: NDArray[np.float64], accel: NDArray[np.float64]
) -> tuple[float | None, float]:
    """How much faster the gyroscope turns than gravity does in the accelerometer, and by how much gravity turned [rad].

    Window averages of the direction of gravity d change by -ω × d; the ratio is the least-squares factor between both
    sides, with the gyroscope's bias estimated beside it, and None where it is not significant.
    """
    finite = (np.abs(gyro) < 1e6).all(axis=1) & (np.abs(accel) < 1e6).all(axis=1)
    time_ns, gyro, accel = time_ns[finite], gyro[finite], accel[finite]
    if len(time_ns) < 8 or time_ns[-1] - time_ns[0] < 4 * _WINDOW_S * 1e9:
        return None, 0.0
    seconds = (time_ns - time_ns[0]) * 1e-9
    window = np.maximum.accumulate((seconds / _WINDOW_S).astype(np.int64))
    _, begin = np.unique(window, return_index=True)
    count = np.diff(np.append(begin, len(window)))[:, None]
    rate = np.add.reduceat(gyro, begin) / count
    direction = np.add.reduceat(accel, begin) / count
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    middle = np.add.reduceat(seconds, begin) / count[:, 0]
    step = np.diff(middle)[:, None]
    halfway = 0.5 * (direction[1:] + direction[:-1])
    seen = np.diff(direction, axis=0)
    turned = float(np.sqrt((seen**2).sum()))
    # seen = -k (rate × d) Δt + (bias × d) Δt, linear in k = 1/ratio and the bias.
    A = np.empty((len(seen), 3, 4))
    A[:, :, 0] = np.cross(halfway, 0.5 * (rate[1:] + rate[:-1])) * step
    for axis, unit in enumerate(np.eye(3)):
        A[:, :, 1 + axis] = np.cross(unit, halfway) * step
    rows, b = A.reshape(-1, 4), seen.reshape(-1)
    solution = np.linalg.lstsq(rows, b, rcond=None)[0]
    biases = rows[:, 1:]
    information = float(np.linalg.norm(rows[:, 0] - biases @ np.linalg.lstsq(biases, rows[:, 0], rcond=None)[0]))
    sigma = float(np.linalg.norm(b - rows @ solution)) / float(np.sqrt(max(len(b) - 4, 1)))
    k = float(solution[0])
    if turned < _LEAST_TURN_RAD or k * information < _SIGNIFICANT * max(sigma, 1e-9):
        return None, turned
    return 1.0 / k, turned
