"""The tasks of a fleet: functions of the store, names and settings, which may be run anywhere, again, and in any order."""

from __future__ import annotations

import hashlib
import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from boxplus.errors import BoxplusError, InputError, printable
from boxplus.maps.descriptors.features import Features
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.recordings import open_recording
from boxplus.runs.fleet.status import RecordingStatus
from boxplus.runs.fleet.store import Store, open_store
from boxplus.runs.lidar_inertial.earlier_run import refuse_other_recording
from boxplus.runs.sessions.repeated import RecordingIdentity
from boxplus.runs.sessions.session_run import open_session_run
from boxplus.runs.slam.config import SlamRunConfig, dump_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.slam_run import run_slam
from boxplus.runs.slam.summary import SlamSummary
from boxplus.runs.storage.output_folder import SUMMARY
from boxplus.runs.storage.state_codec import read_state, write_state
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.meeting import meet
from boxplus.systems.sessions.places import Places
from boxplus.systems.sessions.session import Session
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.proposals import described

OF_A_SESSION = (SUMMARY, "config.yaml", "local_maps", f"odometry/{SUMMARY}")
"""What of a run says where its local maps are."""


@dataclass(frozen=True, slots=True, eq=False)
class RunOutline:
    """A run without its points: small enough for one process to hold those of a whole fleet.

    Attributes:
        session: its local maps, of no point each.
        features: what they look like; empty where density images are not asked for.
        identity: of its recording.
    """

    session: Session
    features: list[Features]
    identity: RecordingIdentity


def run_of(name: str) -> str:
    """Where in a store the run of a recording lies."""
    return f"runs/{name}"


def run_recording(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
    """One run of 'boxplus slam', unless it is there already; one that was killed goes on where it can.

    What the recording or its run has against it is in the status, not raised: another attempt would find the same.
    """
    began, place = time.perf_counter(), open_store(store)
    if (done := _finished(place, name, recording, config)) is not None:
        return _status(name, recording, done, 0.0)
    with place.writing(run_of(name)) as folder:
        try:
            summary = _run(folder, recording, config)
        except BoxplusError as error:
            return RecordingStatus(name=name, recording=recording, state="failed", error=str(error), seconds=_since(began))
    return _status(name, recording, summary, _since(began))


def outline_run(store: str, name: str, config: SlamConfig) -> RunOutline:
    """Where the local maps of a run are, and what they look like."""
    with open_store(store).reading(run_of(name), OF_A_SESSION) as folder:
        run = open_session_run(folder, name, needs_scans=False)
        session = run.session
        maps, features = LocalMapFolder(SlamFolder(folder).local_maps), list[Features]()
        if config.appearance == "density":
            features = [described(maps[number], config) for number in range(len(session.maps))]
    none = np.zeros((0, 3), dtype=np.float32)
    return RunOutline(replace(session, maps=[replace(own, points=none) for own in session.maps]), features, run.identity)


def meet_runs(store: str, names: tuple[str, str], numbers: tuple[int, int], config: SessionsConfig) -> Meeting:
    """Whether two runs met, and where; what was found of the same runs before is taken from the store."""
    place = open_store(store)
    file, key = f"pairs/{names[0]}/{names[1]}.npz", _key_of_pair(place, names, config)
    with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
        kept = Path(scratch) / "meeting.npz"
        if (before := place.read(file)) is not None:
            kept.write_bytes(before)
            try:
                state = read_state(kept)
            except InputError:  # cut, or by other code, which may find something else
                state = {}
            if state.get("key") == key:
                found: Meeting = state["meeting"]
                return replace(found, place_session=numbers[0], query_session=numbers[1])
        places = []
        for name in names:
            with place.reading(run_of(name), OF_A_SESSION) as folder:
                places.append(Places(open_session_run(folder, name, needs_scans=False).session, config.slam))
        meeting = meet(places[0], places[1], config, numbers)
        write_state(kept, {"key": key, "meeting": meeting})
        place.write(file, kept.read_bytes())
    return meeting


def _run(folder: Path, recording: str, config: SlamRunConfig) -> SlamSummary:
    own = SlamFolder(folder)
    with open_recording(recording, config.recording) as opened:
        if not opened.info.imu_topic:
            raise InputError(
                "a recording with an IMU, which tells where down is", f"a LiDAR alone in {opened.info.path.name}",
                "leave it out of the fleet; 'boxplus slam' takes it by itself",
            )  # fmt: skip
        try:
            return run_slam(opened, own.path, config, resume=_is_begun(own, config)).summary
        except InputError:  # a checkpoint that cannot be taken up, or another run's results
            return run_slam(opened, own.path, config, overwrite=True).summary


def _finished(place: Store, name: str, recording: str, config: SlamRunConfig) -> SlamSummary | None:
    """The facts of a run of this recording with these settings that came to its end."""
    facts, settings = (place.read(f"{run_of(name)}/{file}") for file in (SUMMARY, "config.yaml"))
    if facts is None or settings is None or settings.decode() != dump_slam_config(config):
        return None
    try:
        summary = SlamSummary.model_validate_json(facts)
    except ValidationError:
        return None
    return summary if summary.state == "finished" and _is_of(place, name, Path(recording), summary, config) else None


def _is_of(place: Store, name: str, recording: Path, summary: SlamSummary, config: SlamRunConfig) -> bool:
    """Whether a run is of this recording: a name may have been given to another, and a file may have been replaced."""
    if summary.recording == printable(str(recording.resolve())) and _changed_at(recording) < summary.started.timestamp():
        return True
    try:
        with (
            place.reading(run_of(name), (f"odometry/{SUMMARY}",)) as folder,
            open_recording(recording, config.recording) as opened,
        ):
            refuse_other_recording(SlamFolder(folder).odometry, opened)
    except BoxplusError:  # another one; or none that can be read, which the run says
        return False
    return True


def _changed_at(recording: Path) -> float:
    """When a file of a recording was last written or put there [s since 1970]; infinity where there is none.

    A file that is moved or unpacked over another keeps the time at which it was written.
    """
    files = [recording] if recording.is_file() else [file for file in recording.rglob("*") if file.is_file()]
    times = (time_s for file in files for time_s in (file.stat().st_mtime, file.stat().st_ctime))
    return max(times, default=math.inf)


def _is_begun(folder: SlamFolder, config: SlamRunConfig) -> bool:
    if not folder.config.is_file() or folder.config.read_text(encoding="utf-8") != dump_slam_config(config):
        return False
    return folder.can_go_on()


def _key_of_pair(place: Store, names: tuple[str, str], config: SessionsConfig) -> str:
    """Changes with the settings, and with every new run of one of the two."""
    digest = hashlib.sha256(config.model_dump_json().encode())
    for name in names:
        digest.update(b"\0" + (place.read(f"{run_of(name)}/local_maps/graph.npz") or b""))
        digest.update(b"\0" + (place.read(f"{run_of(name)}/{SUMMARY}") or b""))
    return digest.hexdigest()


def _status(name: str, recording: str, summary: SlamSummary, seconds: float) -> RecordingStatus:
    return RecordingStatus(
        name=name,
        recording=recording,
        state="finished" if summary.state == "finished" else "failed",
        error=None if summary.state == "finished" else summary.describe_state(),
        doubt=summary.contradiction,
        seconds=seconds,
        scans=summary.scans,
        path_length_m=summary.path_length_m,
        loops=summary.loops_accepted,
    )


def _since(began: float) -> float:
    return time.perf_counter() - began
