"""KITTI raw drives as recordings (Geiger et al., IJRR 2013; layout of the raw data development kit).

velodyne_points/data/*.bin (float32 x, y, z, reflectance), velodyne_points/timestamps{,_start,_end}.txt: the laser facing
forward, and at both ends of its turn, which begins at the rear and goes clockwise
oxts/data/*.txt (30 columns), oxts/timestamps.txt
calib_imu_to_velo.txt beside the drive, above it, or inside: p_velodyne = R p_imu + T
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.info import Evidence, PointTimeReading, RecordingInfo, Topic, Verdict, no_imu
from boxplus.recordings.kitti_oxts import oxts_fixes, read_oxts
from boxplus.recordings.options import NO_GNSS, NO_IMU, NO_POINT_TIME, RecordingOptions, check_start
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.satellites.gnss import GnssFixes

_POINT_BYTES = 16
_CALIBRATION = "calib_imu_to_velo.txt"


@dataclass(frozen=True, slots=True)
class SensorFiles:
    """File names and times of one sensor; a time without its data file, and a file without its time, are left out and counted."""

    paths: list[Path]
    time_ns: NDArray[np.int64]
    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    missing: int
    untimed: int

    def incomplete(self, name: str, what: str) -> list[Evidence]:
        """What is left out of the sensor of a name, whose files are each a `what`."""
        texts, found = list[str](), len(self.paths)
        if self.missing:
            texts.append(f"{self.missing} of the {self.missing + found} times in {name} have no {what}: these are gaps")
        if self.untimed:
            texts.append(
                f"{self.untimed} of the {self.untimed + found} {what}s in {name} have no time and are left out: a time file was "
                "cut; unpack the whole drive"
            )
        return [Evidence("file", "incomplete", "warning", text) for text in texts]


def open_kitti(path: Path, options: RecordingOptions) -> Recording:
    """Open a KITTI raw drive: the folder that holds `velodyne_points` and, with an IMU, `oxts`.

    Raises:
        RecordingError: a sensor or its times are missing, or the times cannot be read.
    """
    scans = _scan_files(path / "velodyne_points", options)
    imu = None if options.imu_topic == NO_IMU or not (path / "oxts").is_dir() else sensor_files(path / "oxts", ".txt")
    times = np.concatenate([scans.start_ns, scans.end_ns, *([] if imu is None else [imu.time_ns])])
    first, last = int(times.min()), int(times.max())
    check_start(options.start_s, (last - first) * 1e-9)
    T_imu_lidar, source = (None, "") if imu is None else _calibration(path)
    evidence = [_point_time_evidence(scans, options, path / "velodyne_points")]
    for name, files in (("velodyne_points", scans), ("oxts", imu)):
        if files is not None:
            evidence += files.incomplete(name, "data file")
    if imu is None:
        evidence.append(no_imu(options.imu_topic == NO_IMU))
    else:
        evidence += _imu_evidence(imu, source)
    has_gnss = imu is not None and options.gnss_topic != NO_GNSS
    if has_gnss:
        text = "latitude, longitude and altitude of the OXTS, its own solution of satellites and inertial sensors"
        evidence.append(Evidence("gnss_topic", "oxts", "ok", text))
    info = RecordingInfo(
        path=path,
        format="KITTI raw folder",
        topics=[Topic("velodyne_points", "Velodyne HDL-64E", len(scans.paths)), *_imu_topic(imu)],
        duration_s=(last - first) * 1e-9,
        message_count=len(scans.paths) + (len(imu.paths) if imu is not None else 0),
        lidar_topic="velodyne_points",
        imu_topic="" if imu is None else "oxts",
        lidar_frame="velodyne",
        imu_frame="imu",
        point_time=PointTimeReading(None if options.point_time_field == NO_POINT_TIME else "azimuth", "ns", "absolute", "clock"),
        gyro_unit="rad/s",
        accel_unit="m/s2",
        T_imu_lidar=T_imu_lidar,
        T_imu_lidar_source=source,
        gnss_topic="oxts" if has_gnss else "",
        p_imu_antenna=np.zeros(3) if has_gnss else None,
        evidence=evidence,
    )
    start_ns = first + round(options.start_s * 1e9)
    stop_ns = last + 1 if options.duration_s is None else start_ns + round(options.duration_s * 1e9)

    def read(tally: Tally) -> Iterator[Event]:
        return _events(scans, imu, options, start_ns, stop_ns, tally)

    def read_fixes() -> GnssFixes:
        if imu is None:
            return GnssFixes.from_arrays([], [])
        chosen = np.flatnonzero((imu.time_ns >= start_ns) & (imu.time_ns < stop_ns))
        return oxts_fixes([imu.paths[k] for k in chosen], imu.time_ns[chosen])

    return Recording(info, read, lambda: None, read_fixes if has_gnss else None)


def _imu_topic(imu: SensorFiles | None) -> list[Topic]:
    return [] if imu is None else [Topic("oxts", "OXTS RT3003", len(imu.paths))]


def _imu_evidence(imu: SensorFiles, source: str) -> list[Evidence]:
    """The IMU's rate where it is low, and where its mounting comes from."""
    evidence = []
    rate = (len(imu.time_ns) - 1) / max((imu.time_ns.max() - imu.time_ns.min()) * 1e-9, 1e-9)
    if rate < 50:
        text = f"{rate:.1f} Hz (a synchronised drive): the unsynchronised 'extract' drives have 100 Hz"
        evidence.append(Evidence("imu_rate", f"{rate:.1f} Hz", "warning", text))
    found: Verdict = "ok" if source else "warning"
    text = f"from {source}" if source else f"no {_CALIBRATION} in, beside or above the drive: give --T-imu-lidar"
    return [*evidence, Evidence("T_imu_lidar", source or "unknown", found, text)]


def read_times(file: Path) -> NDArray[np.int64]:
    """Times of a KITTI time file, (N,) int64 nanoseconds since 1970.

    Raises:
        RecordingError: no such file, or a line that is no time.
    """
    if not file.is_file():
        raise RecordingError(f"the times {file.name}", f"none in {file.parent}", "unpack the whole drive, with its time files")
    lines = [line.strip() for line in file.read_text(errors="replace").splitlines() if line.strip()]
    try:
        return np.array([line.replace(" ", "T") for line in lines], dtype="datetime64[ns]").astype(np.int64)
    except ValueError as error:
        raise RecordingError(
            "lines like 2011-09-26 13:02:25.594360375", f"{error} in {file}", "unpack the drive again"
        ) from error


def sensor_files(folder: Path, suffix: str, time_file: str = "timestamps.txt") -> SensorFiles:
    """The files of a sensor, `data/0000000000` and so on, with a time each.

    Raises:
        RecordingError: no times, or not one data file.
    """
    time_ns = read_times(folder / time_file)
    paths = [folder / "data" / f"{index:010d}{suffix}" for index in range(len(time_ns))]
    present = np.array([path.is_file() for path in paths], dtype=bool)
    if not present.any():
        raise RecordingError(f"data files like 0000000000{suffix}", f"none in {folder / 'data'}", "unpack the whole drive")
    kept = [path for path, there in zip(paths, present, strict=True) if there]
    time_ns = time_ns[present]
    # A copy that was cut ends its time file early, and what it then says nothing of would be a shorter drive.
    numbers = (path.stem for path in (folder / "data").glob(f"*{suffix}"))
    untimed = sum(1 for number in numbers if number.isdecimal() and int(number) >= len(paths))
    return SensorFiles(kept, time_ns, time_ns, time_ns, int((~present).sum()), untimed)


def _scan_files(folder: Path, options: RecordingOptions) -> SensorFiles:
    if options.point_time_field == NO_POINT_TIME:
        return sensor_files(folder, ".bin")
    if not _has_turn_times(folder):
        return _turns_around(sensor_files(folder, ".bin"), folder)
    starts = sensor_files(folder, ".bin", "timestamps_start.txt")
    ends = sensor_files(folder, ".bin", "timestamps_end.txt")
    if len(starts.time_ns) != len(ends.time_ns):
        raise RecordingError(
            "as many start times as end times of the scans",
            f"{len(starts.time_ns)} and {len(ends.time_ns)} in {folder}",
            "unpack the drive again",
        )
    return SensorFiles(starts.paths, starts.time_ns, starts.time_ns, ends.time_ns, starts.missing, starts.untimed)


def _has_turn_times(folder: Path) -> bool:
    return all((folder / f"timestamps_{end}.txt").is_file() for end in ("start", "end"))


def _turns_around(forward: SensorFiles, folder: Path) -> SensorFiles:
    """Both ends of every turn, from the times at which the laser faced forward: halfway to its neighbours.

    Across a gap the turn takes as long as the median one.
    """
    steps = np.diff(forward.time_ns)
    if not (steps > 0).any():
        raise RecordingError(
            "two times one after the other in timestamps.txt, which show how long a turn takes, or the times of its ends",
            f"{len(forward.time_ns)} times that do not go on in {folder}",
            "unpack the whole drive, or accept distorted scans with --point-time-field none",
        )
    turn = np.median(steps[steps > 0])
    half = np.where((steps > 0.5 * turn) & (steps < 1.5 * turn), steps, turn).astype(np.int64) // 2
    ends = round(float(turn)) // 2
    start_ns = forward.time_ns - np.concatenate(([ends], half))
    end_ns = forward.time_ns + np.concatenate((half, [ends]))
    return SensorFiles(forward.paths, forward.time_ns, start_ns, end_ns, forward.missing, forward.untimed)


def _point_time_evidence(scans: SensorFiles, options: RecordingOptions, folder: Path) -> Evidence:
    key = "point_time_field"
    if options.point_time_field == NO_POINT_TIME:
        text = "every point is taken at the time of its scan, as asked for: motion within a scan is not corrected"
        return Evidence(key, "none", "warning", text)
    duration = float(np.median(scans.end_ns - scans.start_ns)) * 1e-9
    turns = "the laser turns clockwise from the rear"
    if not _has_turn_times(folder):
        text = (
            "the times of the points are reconstructed: timestamps_start.txt or timestamps_end.txt is missing, so a turn takes "
            f"{duration:.4f} s around the time in timestamps.txt, at which the laser faces forward; {turns}; unpack the whole "
            "drive for measured times, or take a scan as one instant with --point-time-field none"
        )
        return Evidence(key, "azimuth", "warning", text)
    text = f"a turn takes {duration:.4f} s from timestamps_start to timestamps_end; {turns}"
    return Evidence(key, "azimuth", "ok" if 0.02 < duration < 0.5 else "warning", text)


def _calibration(path: Path) -> tuple[NDArray[np.float64] | None, str]:
    file = calibration_file(path, _CALIBRATION)
    if file is None:
        return None, ""
    T_velo_imu = rigid_transform(calibration_lines(file), file)
    T_imu_lidar = np.eye(4)
    T_imu_lidar[:3, :3] = T_velo_imu[:3, :3].T
    T_imu_lidar[:3, 3] = -T_velo_imu[:3, :3].T @ T_velo_imu[:3, 3]
    return T_imu_lidar, file.name


def calibration_file(path: Path, name: str) -> Path | None:
    """A calibration of the date of a drive: inside of the drive, above it, or beside it with the drive's name before its own."""
    folders = (path, path.parent, path.parent.parent)
    files = [folder / name for folder in folders] + [path.parent / f"{path.name}.{name}"]
    return next((file for file in files if file.is_file()), None)


def calibration_lines(file: Path) -> dict[str, NDArray[np.float64]]:
    """The lines `name: numbers` of a calibration; those with something else are left out."""
    values = {}
    for line in file.read_text(errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        try:
            values[name.strip()] = np.array(numbers.split(), dtype=np.float64)
        except ValueError:
            continue
    return values


def rigid_transform(values: dict[str, NDArray[np.float64]], file: Path, R: str = "R", T: str = "T") -> NDArray[np.float64]:
    """(4, 4) of the lines R and T.

    Raises:
        RecordingError: one is missing, or R is no rotation.
    """
    rotation, translation = values.get(R, np.empty(0)), values.get(T, np.empty(0))
    rotates = rotation.size == 9 and translation.size == 3
    rotates = rotates and np.allclose(rotation.reshape(3, 3) @ rotation.reshape(3, 3).T, np.eye(3), atol=1e-3)
    if not rotates or np.linalg.det(rotation.reshape(3, 3)) < 0:
        raise RecordingError(
            f"{R} (9 numbers, a rotation) and {T} (3 numbers)", f"something else in {file}", "download the calibration again"
        )
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation.reshape(3, 3), translation
    return transform


def _events(
    scans: SensorFiles, imu: SensorFiles | None, options: RecordingOptions, start_ns: int, stop_ns: int, tally: Tally
) -> Iterator[Event]:
    lidar_order = ((int(end), 1, index) for index, end in enumerate(scans.end_ns))
    imu_order = ((int(time), 0, index) for index, time in enumerate(imu.time_ns if imu is not None else ()))
    for received_ns, is_scan, index in heapq.merge(imu_order, lidar_order):
        tally.done += 1
        if not start_ns <= received_ns < stop_ns:
            continue
        event: Event | None = None
        if is_scan:
            event = _read_scan(scans, index, options, tally)
        elif imu is not None:
            event = _read_imu(imu, index, tally)
        if event is not None:
            yield event


def _read_scan(scans: SensorFiles, index: int, options: RecordingOptions, tally: Tally) -> Scan | None:
    try:
        raw = scans.paths[index].read_bytes()
    except OSError:
        tally.rejected["messages: unreadable scan file"] += 1
        return None
    if len(raw) % _POINT_BYTES:
        tally.rejected[f"messages: scan file is not a multiple of {_POINT_BYTES} bytes"] += 1
        return None
    points = np.frombuffer(raw, "<f4").reshape(-1, 4)
    start_ns, end_ns = int(scans.start_ns[index]), int(scans.end_ns[index])
    turned = 0.5 - np.arctan2(points[:, 1], points[:, 0], dtype=np.float64) * (0.5 / np.pi)
    offset = np.where(np.isfinite(turned), turned, 0.0) * (end_ns - start_ns)
    time_ns = start_ns + np.rint(offset).astype(np.int64)
    if not len(points):
        return Scan(np.empty((0, 3), np.float32), time_ns, None, start_ns, start_ns, {})
    return Scan.from_arrays(points[:, :3], time_ns, points[:, 3], min_range=options.min_range, max_range=options.max_range)


def _read_imu(imu: SensorFiles, index: int, tally: Tally) -> ImuSamples | None:
    values = read_oxts(imu.paths[index])
    if isinstance(values, str):
        tally.rejected[f"messages: {values}"] += 1
        return None
    return ImuSamples.from_arrays(imu.time_ns[index : index + 1], values[:3], values[3:])
