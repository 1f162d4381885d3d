"""The tasks of a fleet: functions of paths and settings, which may be run anywhere, again, and in any order."""

from __future__ import annotations

import time
from pathlib import Path

from boxplus.errors import BoxplusError, InputError
from boxplus.maps.descriptors.features import Features
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.recordings import open_recording
from boxplus.runs.fleet.status import RecordingStatus
from boxplus.runs.sessions.session_run import open_session_run
from boxplus.runs.slam.config import SlamRunConfig, dump_slam_config
from boxplus.runs.slam.folder import PROGRAM, SlamFolder
from boxplus.runs.slam.slam_run import run_slam
from boxplus.runs.slam.summary import SlamSummary, read_slam_summary
from boxplus.runs.storage.output_folder import program_of
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.meeting import meet
from boxplus.systems.sessions.places import Places
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.proposals import described


def run_recording(name: str, recording: str, folder: str, config: SlamRunConfig) -> RecordingStatus:
    """One run of 'boxplus slam', unless it is there already; one that was killed goes on where it can.

    What the recording or its run has against it is in the status, not raised: another attempt would find the same.
    """
    began, own = time.perf_counter(), SlamFolder(Path(folder))
    if (done := _finished(own, config)) is not None:
        return _status(name, recording, done, 0.0)
    try:
        with open_recording(recording, config.recording) as opened:
            try:
                result = run_slam(opened, own.path, config, resume=_is_begun(own, config))
            except InputError:  # a checkpoint that cannot be taken up, or another run's results
                result = run_slam(opened, own.path, config, overwrite=True)
    except BoxplusError as error:
        return RecordingStatus(name=name, recording=recording, state="failed", error=str(error), seconds=_since(began))
    return _status(name, recording, result.summary, _since(began))


def describe_run(folder: str, config: SlamConfig) -> list[Features]:
    """What the local maps of a run look like."""
    maps = LocalMapFolder(SlamFolder(Path(folder)).local_maps)
    return [described(maps[number], config) for number in range(len(maps))]


def meet_runs(folders: tuple[str, str], names: tuple[str, str], numbers: tuple[int, int], config: SessionsConfig) -> Meeting:
    """Whether two runs met, and where."""
    place, query = (
        Places(open_session_run(folder, name).session, config.slam) for folder, name in zip(folders, names, strict=True)
    )
    return meet(place, query, config, numbers)


def _finished(folder: SlamFolder, config: SlamRunConfig) -> SlamSummary | None:
    """The facts of a run with these settings that came to its end."""
    if not folder.summary.is_file() or program_of(folder.summary) != PROGRAM or not _has_settings(folder, config):
        return None
    summary = read_slam_summary(folder.summary)
    return summary if summary.state == "finished" else None


def _is_begun(folder: SlamFolder, config: SlamRunConfig) -> bool:
    return _has_settings(folder, config) and (folder.odometry.checkpoint.is_file() or folder.odometry_is_finished())


def _has_settings(folder: SlamFolder, config: SlamRunConfig) -> bool:
    return folder.config.is_file() and folder.config.read_text(encoding="utf-8") == dump_slam_config(config)


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
