"""What goes wrong in real recordings, as changes to a stream of events.

A fault takes events and gives events; it leaves alone whatever it does not name. Times count from the first event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._settings import suggestion
from boxplus.errors import InputError
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan

Event = Scan | ImuSamples
Times = NDArray[np.int64]
_STANDARD_GRAVITY = 9.80665

Transform = NDArray[np.float64]


def _unchanged(T_imu_lidar: Transform | None) -> Transform | None:
    return T_imu_lidar


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        name: short name.
        description: one line.
        events: turns the stream of events into the faulty one.
        declared_extrinsic: turns the T_imu_lidar (4, 4) the recording would declare into the one it does; None is none.
    """

    name: str
    description: str
    events: Callable[[Iterable[Event]], Iterator[Event]]
    declared_extrinsic: Callable[[Transform | None], Transform | None] = _unchanged

    def then(self, other: Fault) -> Fault:
        """This fault, and `other` on top of it."""
        return Fault(
            f"{self.name}+{other.name}",
            f"{self.description}; {other.description}",
            lambda events: other.events(self.events(events)),
            lambda T_imu_lidar: other.declared_extrinsic(self.declared_extrinsic(T_imu_lidar)),
        )


class _Change:
    """Applies one function to the scans and one to the IMU samples of a stream.

    The functions get what arrived and `inside`, which says of times (N,) whether they lie in the interval of the fault. They
    return None for an event that is lost.
    """

    def __init__(
        self,
        scan: Callable[[Scan, Callable[[Times], NDArray[np.bool_]]], Scan | None] | None = None,
        imu: Callable[[ImuSamples, Callable[[Times], NDArray[np.bool_]]], ImuSamples] | None = None,
        start_s: float = 0.0,
        duration_s: float = np.inf,
    ) -> None:
        self._scan, self._imu = scan, imu
        self._start_s, self._duration_s = start_s, duration_s

    def __call__(self, events: Iterable[Event]) -> Iterator[Event]:
        origin_ns: int | None = None

        def inside(time_ns: Times) -> NDArray[np.bool_]:
            since = (time_ns - (origin_ns or 0)) * 1e-9
            return (since >= self._start_s) & (since < self._start_s + self._duration_s)

        for event in events:
            if origin_ns is None:
                origin_ns = event.start_ns if isinstance(event, Scan) else int(event.time_ns[0])
            changed: Event | None = event
            if isinstance(event, Scan) and self._scan is not None:
                changed = self._scan(event, inside)
            elif isinstance(event, ImuSamples) and self._imu is not None:
                changed = self._imu(event, inside)
            if changed is not None and (isinstance(changed, Scan) or len(changed)):
                yield changed


_Inside = Callable[[Times], NDArray[np.bool_]]


def _begins(scan: Scan, inside: _Inside) -> bool:
    return bool(inside(np.array([scan.start_ns]))[0])


def _emptied(scan: Scan) -> Scan:
    intensity = None if scan.intensity is None else scan.intensity[:0]
    return Scan(scan.p_lidar[:0], scan.time_ns[:0], intensity, scan.start_ns, scan.end_ns)


def drop_imu(start_s: float = 10.0, duration_s: float = 1.0) -> Fault:
    """No IMU samples for a while."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return samples.where(~inside(samples.time_ns))

    return Fault("drop_imu", f"no IMU samples for {duration_s:g} s", _Change(imu=imu, start_s=start_s, duration_s=duration_s))


def drop_scans(start_s: float = 10.0, duration_s: float = 0.5) -> Fault:
    """No scans for a while."""

    def scan(scan: Scan, inside: _Inside) -> Scan | None:
        return None if _begins(scan, inside) else scan

    return Fault("drop_scans", f"no scans for {duration_s:g} s", _Change(scan, start_s=start_s, duration_s=duration_s))


def empty_scans(start_s: float = 10.0, duration_s: float = 0.5) -> Fault:
    """Scans without a single point for a while (a covered sensor)."""

    def scan(scan: Scan, inside: _Inside) -> Scan:
        return _emptied(scan) if _begins(scan, inside) else scan

    return Fault("empty_scans", f"empty scans for {duration_s:g} s", _Change(scan, start_s=start_s, duration_s=duration_s))


def repeat_stamps(start_s: float = 10.0, duration_s: float = 0.3) -> Fault:
    """All IMU samples, and all scans, that begin within the interval carry the stamp of the first of them."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        frozen: dict[str, int] = {}

        def scan(scan: Scan, inside: _Inside) -> Scan:
            if not _begins(scan, inside):
                return scan
            return scan.shifted(frozen.setdefault("scan", scan.start_ns) - scan.start_ns)

        def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
            chosen = inside(samples.time_ns)
            if not chosen.any():
                return samples
            stamp = frozen.setdefault("imu", int(samples.time_ns[chosen][0]))
            return replace(samples, time_ns=np.where(chosen, stamp, samples.time_ns))

        return _Change(scan, imu, start_s, duration_s)(incoming)

    return Fault("repeat_stamps", f"the same time stamp again and again for {duration_s:g} s", events)


def backward_stamps(start_s: float = 10.0, duration_s: float = 0.3, jump_s: float = 1.0) -> Fault:
    """The stamps of the interval lie `jump_s` too early (a clock that is set back, then corrected)."""
    jump_ns = round(jump_s * 1e9)

    def scan(scan: Scan, inside: _Inside) -> Scan:
        return scan.shifted(-jump_ns) if _begins(scan, inside) else scan

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, time_ns=samples.time_ns - jump_ns * inside(samples.time_ns))

    text = f"time stamps {jump_s:g} s too early for {duration_s:g} s"
    return Fault("backward_stamps", text, _Change(scan, imu, start_s, duration_s))


def nan_burst(start_s: float = 10.0, duration_s: float = 0.2, every: int = 2) -> Fault:
    """NaN in every second point and in every second IMU sample (or every `every`-th) for a while."""

    def scan(scan: Scan, inside: _Inside) -> Scan:
        if not _begins(scan, inside):
            return scan
        p_lidar = scan.p_lidar.copy()
        p_lidar[::every] = np.nan
        return Scan.from_arrays(p_lidar, scan.time_ns, scan.intensity)

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        bad = np.flatnonzero(inside(samples.time_ns))[::every]
        gyro, accel = samples.gyro.copy(), samples.accel.copy()
        gyro[bad] = np.nan
        accel[bad] = np.nan
        return ImuSamples(samples.time_ns, gyro, accel)

    return Fault("nan_burst", f"NaN in points and IMU samples for {duration_s:g} s", _Change(scan, imu, start_s, duration_s))


def imu_in_g() -> Fault:
    """The accelerometer reports in g and nobody says so."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, accel=samples.accel / _STANDARD_GRAVITY)

    return Fault("imu_in_g", "accelerometer in g, declared as m/s²", _Change(imu=imu))


def gyro_in_deg() -> Fault:
    """The gyroscope reports in deg/s and nobody says so."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, gyro=np.rad2deg(samples.gyro))

    return Fault("gyro_in_deg", "gyroscope in deg/s, declared as rad/s", _Change(imu=imu))


def inverted_extrinsic() -> Fault:
    """The mounting is declared the wrong way round: T_lidar_imu in place of T_imu_lidar."""

    def inverse(T_imu_lidar: Transform | None) -> Transform | None:
        return None if T_imu_lidar is None else np.asarray(np.linalg.inv(T_imu_lidar), dtype=np.float64)

    return Fault("inverted_extrinsic", "T_lidar_imu declared as T_imu_lidar", _Change(), inverse)


def saturate_accel(limit: float = 11.0) -> Fault:
    """Every axis of the accelerometer is clipped at ±`limit` [m/s²]."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, accel=np.clip(samples.accel, -limit, limit))

    return Fault("saturate_accel", f"accelerometer clipped at {limit:g} m/s²", _Change(imu=imu))


def wrong_time_unit(factor: float = 1e-3) -> Fault:
    """The times of the points, counted from the first one of their scan, are multiplied by `factor` (µs read as ns: 0.001)."""

    def scan(scan: Scan, inside: _Inside) -> Scan:
        time_ns = scan.start_ns + np.rint((scan.time_ns - scan.start_ns) * factor).astype(np.int64)
        end_ns = scan.start_ns + round((scan.end_ns - scan.start_ns) * factor)
        return replace(scan, time_ns=time_ns, end_ns=end_ns)

    return Fault("wrong_time_unit", f"point times multiplied by {factor:g}", _Change(scan))


def gyro_in_rad_as_deg() -> Fault:
    """The gyroscope reports in rad/s and is taken for one in deg/s."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, gyro=np.deg2rad(samples.gyro))

    return Fault("gyro_in_rad_as_deg", "gyroscope in rad/s, declared as deg/s", _Change(imu=imu))


def flip_gyro() -> Fault:
    """The gyroscope reports every rate with the opposite sign."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, gyro=-samples.gyro)

    return Fault("flip_gyro", "gyroscope with the opposite sign", _Change(imu=imu))


def flip_accel() -> Fault:
    """The accelerometer reports gravity in place of specific force: every value with the opposite sign."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, accel=-samples.accel)

    return Fault("flip_accel", "accelerometer with the opposite sign", _Change(imu=imu))


def clock_offset(offset_s: float = 0.1) -> Fault:
    """The stamps of the IMU lie `offset_s` too late (too early when negative); the messages arrive as ever."""
    shift_ns = round(offset_s * 1e9)

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, time_ns=samples.time_ns + shift_ns)

    return Fault("clock_offset", f"IMU stamps {offset_s:+g} s off", _Change(imu=imu))


def lidar_clock_offset(offset_s: float = 0.05) -> Fault:
    """The stamps of the LiDAR lie `offset_s` too late (too early when negative); the messages arrive as ever."""
    shift_ns = round(offset_s * 1e9)
    return Fault("lidar_clock_offset", f"LiDAR stamps {offset_s:+g} s off", _Change(lambda scan, _: scan.shifted(shift_ns)))


def clock_drift(rate: float = 0.01) -> Fault:
    """The clock of the IMU runs too fast by `rate` (0.01: 10 ms a second); both agree at the first event."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        origin_ns: int | None = None
        for event in incoming:
            if origin_ns is None:
                origin_ns = event.start_ns if isinstance(event, Scan) else int(event.time_ns[0])
            if isinstance(event, ImuSamples):
                late_ns = np.rint((event.time_ns - origin_ns) * rate).astype(np.int64)
                event = replace(event, time_ns=event.time_ns + late_ns)
            yield event

    return Fault("clock_drift", f"the IMU's clock runs {rate:+.3%} too fast", events)


def other_imu(measured: Callable[[int, int, int], ImuSamples]) -> Fault:
    """The samples are those of an IMU on another body.

    Args:
        measured: gives its samples in (begin_ns, end_ns], by begin, end and number of the block: `Simulation.imu_samples` of
            another simulation over the same time.
    """

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        begin_ns: int | None = None
        block = 0
        for event in incoming:
            if isinstance(event, ImuSamples):
                end_ns = int(event.time_ns[-1])
                event = measured(int(event.time_ns[0]) - 1 if begin_ns is None else begin_ns, end_ns, block)
                begin_ns, block = end_ns, block + 1
                if not len(event):
                    continue
            yield event

    return Fault("other_imu", "the IMU of another body", events)


def declare(T_imu_lidar: Transform | None, text: str = "another T_imu_lidar declared") -> Fault:
    """The recording declares this mounting (4, 4), whatever it is in truth; None: it declares none."""
    return Fault("declare", text, _Change(), lambda _: T_imu_lidar)


def scale_points(factor: float = 1.1) -> Fault:
    """All coordinates of points are multiplied by `factor` (3.2808: feet for metres)."""

    def scan(scan: Scan, inside: _Inside) -> Scan:
        return replace(scan, p_lidar=(scan.p_lidar * np.float32(factor)))

    return Fault("scale_points", f"points multiplied by {factor:g}", _Change(scan))


def mirror_points(axis: int = 1) -> Fault:
    """One coordinate of all points has the opposite sign, y by default: a left-handed frame."""

    def scan(scan: Scan, inside: _Inside) -> Scan:
        p_lidar = scan.p_lidar.copy()
        p_lidar[:, axis] *= -1.0
        return replace(scan, p_lidar=p_lidar)

    return Fault("mirror_points", f"points mirrored along {'xyz'[axis]}", _Change(scan))


def permute_gyro(order: tuple[int, int, int] = (1, 2, 0)) -> Fault:
    """The gyroscope reports as x, y and z what its axes `order` measure: one that a driver reads in the wrong order."""

    def imu(samples: ImuSamples, inside: _Inside) -> ImuSamples:
        return replace(samples, gyro=samples.gyro[:, list(order)])

    return Fault("permute_gyro", f"rates about {_axes(order)} as those about xyz", _Change(imu=imu))


def permute_points(order: tuple[int, int, int] = (1, 2, 0)) -> Fault:
    """Points have as x, y and z their coordinates `order`: cyclic a turn by 120°, two swapped a left-handed frame."""

    def scan(scan: Scan, inside: _Inside) -> Scan:
        return replace(scan, p_lidar=np.ascontiguousarray(scan.p_lidar[:, list(order)]))

    return Fault("permute_points", f"coordinates {_axes(order)} of points as xyz", _Change(scan))


def _axes(order: tuple[int, int, int]) -> str:
    return "".join("xyz"[axis] for axis in order)


FAULTS: dict[str, Callable[[], Fault]] = {
    "drop_imu": drop_imu,
    "drop_scans": drop_scans,
    "empty_scans": empty_scans,
    "repeat_stamps": repeat_stamps,
    "backward_stamps": backward_stamps,
    "nan_burst": nan_burst,
    "imu_in_g": imu_in_g,
    "gyro_in_deg": gyro_in_deg,
    "inverted_extrinsic": inverted_extrinsic,
    "saturate_accel": saturate_accel,
    "wrong_time_unit": wrong_time_unit,
    "gyro_in_rad_as_deg": gyro_in_rad_as_deg,
    "flip_gyro": flip_gyro,
    "flip_accel": flip_accel,
    "clock_offset": clock_offset,
    "clock_drift": clock_drift,
    "scale_points": scale_points,
    "mirror_points": mirror_points,
    "permute_gyro": permute_gyro,
    "permute_points": permute_points,
}
"""Name → maker; without arguments the interval begins 10 s after the start."""


def make_fault(name: str) -> Fault:
    """A fault with its default parameters.

    Raises:
        InputError: no fault of that name.
    """
    if name not in FAULTS:
        raise InputError("the name of a fault", repr(name), suggestion(name, FAULTS, "fault"))
    return FAULTS[name]()
