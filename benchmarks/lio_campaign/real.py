"""Recordings with a real IMU on a real flight: windows of EuRoC sequences, with scans cast exactly along their ground truth.

`make_lio_recording.py` of the shared folder writes them; the fault is laid upon what the reader delivers.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings import open_recording
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.recording import Event, Recording, Tally
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import Fault, Motion
from lio_campaign.draws import EXTRINSICS, FAULTY_SHARE, Kinds
from lio_campaign.spoil import FAULT_KINDS, MOUNTING_FAULTS, Setting, deliver, draw_spoiling

_FLIGHTS = {"V1_03_difficult": 104.0, "MH_05_difficult": 110.0}
"""Sequences with the seconds of them that may be used."""
_SENSORS = {"velodyne": (-15.0, 15.0), "ouster": (-22.5, 22.5), "livox": (0.0, 0.0)}
"""Sensors with the elevations of their lowest and highest ring [deg]; a Livox has none."""
_JUMP_M, _CLOSE_S = 0.005, 0.02


@dataclass(frozen=True)
class RealDraw:
    """One of these recordings; the attributes are those of `draws.Draw`.

    Attributes:
        path: of the bag.
        T_true: (4, 4) the true mounting.
        channels, elevation_deg: of a spinning LiDAR, its lowest and highest ring; 1 and zero of others.
    """

    seed: int
    kinds: Kinds
    detail: str
    featureless: bool
    duration_s: float
    spoiled: Fault
    path: Path
    T_true: NDArray[np.float64]
    channels: int
    elevation_deg: tuple[float, float]
    recording_options: dict[str, Any] = field(default_factory=dict)
    T_imu_lidar: NDArray[np.float64] | None = None

    def truth(self) -> RecordedTruth:
        """The motion along which the scans were cast."""
        return RecordedTruth(_beside(self.path, ".gt.tum"))


class RecordedTruth:
    """Smooth interpolation of the ground truth's poses, which lie 10 ms apart.

    Attributes:
        start_ns, end_ns: its first and last time.
        jumps_ns: (J,) where a step differs from those before and after it, as no flight does: the ground truth of MH_05 does so
            a dozen times, by up to 5 cm.
    """

    def __init__(self, path: Path) -> None:
        poses = read_trajectory(path, "tum")
        assert poses.time_ns is not None
        self.start_ns, self.end_ns = int(poses.time_ns[0]), int(poses.time_ns[-1])
        time_s = (poses.time_ns - self.start_ns) * 1e-9
        self._p = CubicSpline(time_s, poses.p)
        assert float(np.median(np.diff(time_s))) < _CLOSE_S, "poses farther apart differ from one another by their motion"
        v = np.diff(poses.p, axis=0) / np.diff(time_s)[:, None]
        odd = np.linalg.norm(v[1:-1] - 0.5 * (v[:-2] + v[2:]), axis=1) * np.diff(time_s)[1:-1] > _JUMP_M
        self.jumps_ns = poses.time_ns[1:-2][odd]
        self._R = RotationSpline(time_s, Rotation.from_quat(poses.q_wxyz[:, [1, 2, 3, 0]]))

    def ground_truth(self, time_ns: NDArray[np.int64]) -> Motion:
        """At `time_ns` (N,) within `[start_ns, end_ns]`."""
        s = (np.asarray(time_ns) - self.start_ns) * 1e-9
        return Motion(self._R(s).as_matrix(), self._p(s), self._p(s, 1), self._p(s, 2), self._R(s, 1))


def why_not(shared: Path) -> str | None:
    """Why there can be no such recordings; None when there can."""
    tool = shared / "tools" / "make_lio_recording.py"
    missing = [path for path in (tool, *(_csv(shared, flight, "imu") for flight in _FLIGHTS)) if not path.exists()]
    return f"{missing[0]} is not there" if missing else None


def draw_real(seed: int, shared: Path, work: Path) -> RealDraw:
    """Draw a recording and write it into the folder `work`."""
    random = np.random.Generator(np.random.PCG64([seed, 3]))
    flight = str(random.choice(list(_FLIGHTS)))
    duration_s = float(random.uniform(12.0, 20.0))
    start_s = float(random.uniform(0.0, _FLIGHTS[flight] - duration_s))
    sensor, corridor = str(random.choice(list(_SENSORS))), bool(random.uniform() < 0.15)
    extrinsic = str(random.choice(EXTRINSICS, p=(0.4, 0.4, 0.2)))
    fault = str(random.choice(FAULT_KINDS)) if random.uniform() < FAULTY_SHARE else "none"
    if fault in MOUNTING_FAULTS and extrinsic == "absent":
        extrinsic = "recorded"
    path = work / "recording.bag"
    rings = int(random.choice((16, 32)))
    arguments = {
        "imu": _csv(shared, flight, "imu"),
        "gt": _csv(shared, flight, "gt"),
        "out": path,
        "start": f"{start_s:.2f}",
        "seconds": f"{duration_s:.2f}",
        "sensor": sensor,
        "seed": seed,
        "rings": rings,
        "cols": 7200 // rings,
        "sigma": f"{random.uniform(0.01, 0.03):.3f}",
        "margin": f"{random.uniform(1.5, 5.0):.2f}",
        "boxes": int(random.integers(4, 16)),
        "cylinders": int(random.integers(0, 8)),
    }
    command = [sys.executable, str(shared / "tools" / "make_lio_recording.py"), *(["--corridor"] if corridor else [])]
    subprocess.run(command + [f"--{key}={value}" for key, value in arguments.items()], check=True, capture_output=True)
    facts = json.loads(_beside(path, ".json").read_text(encoding="utf-8"))
    T_true = np.eye(4)
    T_true[:3, :3], T_true[:3, 3] = facts["R_imu_lidar"], facts["t_imu_lidar"]
    other = next(name for name in _FLIGHTS if name != flight)
    setting = Setting(float(random.uniform(4.0, 0.6 * duration_s)), False, T_true, _other_imu(_csv(shared, other, "imu")))
    spoiling = draw_spoiling(fault, setting, random)
    spoiled, option = deliver(extrinsic, spoiling.fault, T_true)
    world = "corridor" if corridor else "room"
    return RealDraw(
        seed=seed,
        kinds=Kinds(world, flight[:5], sensor, "real", extrinsic, fault, "real"),
        detail=f"{spoiling.detail} (from {start_s:.1f} s)".strip(),
        featureless=corridor,
        duration_s=duration_s,
        spoiled=spoiled,
        path=path,
        T_true=T_true,
        channels=1 if sensor == "livox" else rings,
        elevation_deg=_SENSORS[sensor],
        recording_options=spoiling.recording_options,
        T_imu_lidar=option,
    )


@contextmanager
def opened_real(made: RealDraw, options: RecordingOptions) -> Iterator[Recording]:
    """The recording as its reader delivers it, then spoilt."""
    with open_recording(made.path, options) as recording:
        declared = made.spoiled.declared_extrinsic(made.T_true)
        source = "" if declared is None else "the campaign"
        info = replace(recording.info, T_imu_lidar=declared, T_imu_lidar_source=source)
        # What the reader says of the mounting is not what is declared here.
        info.evidence[:] = [entry for entry in info.evidence if entry.key != "T_imu_lidar"]

        def read(tally: Tally) -> Iterator[Event]:
            for event in made.spoiled.events(recording.events()):
                tally.done = round(recording.progress * info.message_count)
                yield event

        yield Recording(info, read, lambda: None)


def _other_imu(path: Path) -> Callable[[int, int, int], ImuSamples]:
    """The samples of another flight, from its tenth second on, at the times of this one."""
    rows = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=range(1, 7))[2000:]
    step_ns = 5_000_000
    first: list[int] = []

    def measured(begin_ns: int, end_ns: int, block: int) -> ImuSamples:
        del block
        origin = first[0] if first and begin_ns >= first[0] else begin_ns
        first[:] = [origin]
        index = np.arange((begin_ns - origin) // step_ns + 1, (end_ns - origin) // step_ns + 1)
        index = index[index < len(rows)]
        return ImuSamples.from_arrays(origin + index * step_ns, rows[index, :3], rows[index, 3:])

    return measured


def _csv(shared: Path, flight: str, kind: str) -> Path:
    return shared / "data" / "imu" / f"{flight}.{kind}.csv"


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.stem + ending)
