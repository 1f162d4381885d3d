"""From where a killed run can go on: its state every few seconds, and the rows that were written since."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from boxplus.errors import InputError
from boxplus.formats.output import output_error
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.recordings.info import RecordingInfo
from boxplus.runs.estimate_statistics import EstimateStatistics
from boxplus.runs.run_folder import OdometryFolder
from boxplus.runs.storage.state_codec import read_state, write_state

_EVERY_S = 5.0
_LARGEST_SHARE = 0.05  # of the time of the run: with a large map, checkpoints come less often


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A run between two events of its recording.

    Attributes:
        identity: of the recording and the settings, see `run_identity`.
        events: of the recording that were taken.
        resumed: how often the run had been resumed.
        statistics: what was counted.
        odometry: what the estimator's `snapshot` gives.
        run: what this kind of run holds beside it.
    """

    identity: dict[str, str]
    events: int
    resumed: int
    statistics: EstimateStatistics
    odometry: dict[str, object]
    run: dict[str, object]


class CheckpointWriter:
    """Writes a checkpoint every few seconds, and spends at most a twentieth of the time on it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._due = time.perf_counter() + _EVERY_S

    @property
    def is_due(self) -> bool:
        """Whether it is time for the next one."""
        return time.perf_counter() > self._due

    def write(self, checkpoint: Checkpoint) -> None:
        """Replace the one before in one step.

        Raises:
            OutputError: the disk is full; the one before stays.
        """
        began = time.perf_counter()
        write_state(self._path, {name: getattr(checkpoint, name) for name in Checkpoint.__slots__})
        now = time.perf_counter()
        self._due = now + max(_EVERY_S, (now - began) / _LARGEST_SHARE)


def run_identity(info: RecordingInfo | CameraRecordingInfo, config: str, streams: str) -> dict[str, str]:
    """What has to be the same for a run to go on: the recording, wherever it lies, and the text of `config.yaml`.

    Args:
        streams: of the recording that are read.
    """
    files = [info.path] if info.path.is_file() else sorted(file for file in info.path.rglob("*") if file.is_file())
    size = sum(file.stat().st_size for file in files)
    recording = f"{info.format}, {size} bytes, {info.message_count} messages in {info.duration_s:.9f} s"
    return {"recording": f"{recording}, {streams}", "config": config}


def read_checkpoint(folder: OdometryFolder, identity: dict[str, str]) -> Checkpoint:
    """The checkpoint of a run over the same recording with the same settings.

    Raises:
        InputError: there is none, it is damaged, or the recording or a setting is another.
    """
    state: dict[str, Any] = read_state(folder.checkpoint)
    if set(state) != set(Checkpoint.__slots__) or set(state["identity"]) != set(identity):
        raise InputError(
            "the checkpoint of a run, of this version of boxplus", f"another ({folder.checkpoint})", "start the run anew"
        )
    saved: dict[str, str] = state["identity"]
    if saved["recording"] != identity["recording"]:
        raise InputError(
            f"the recording that the run began with ({saved['recording']})",
            identity["recording"],
            "give that recording, or start a new run in another folder",
        )
    refuse_other_settings(folder, saved["config"], identity["config"])
    return Checkpoint(**state)


def refuse_other_settings(folder: OdometryFolder, before: str, now: str) -> None:
    """Compare two texts of `config.yaml`: of the run in a folder, and as they would be now.

    Raises:
        InputError: they differ; the message has the first line that does.
    """
    if before == now:
        return
    pairs = zip(before.splitlines(), now.splitlines(), strict=False)
    then, asked = next(((a, b) for a, b in pairs if a != b), ("more settings", "fewer"))
    raise InputError(
        f"the settings that the run began with ({then.strip()})",
        asked.strip(),
        f"give --config {folder.config}, or start a new run in another folder",
    )


def cut_to_whole_rows(folder: OdometryFolder, log: Path, fewest: int) -> int | None:
    """Cut trajectory and log to the rows that all of them hold whole; returns the time of the last one [ns].

    Args:
        log: with one row for each pose, such as `scans.csv`.
        fewest: rows that have to be there, those of the checkpoint.

    Raises:
        InputError: there are fewer.
        OutputError: a file cannot be changed.
    """
    trajectory = folder.trajectory
    headers = {trajectory: 1, trajectory.with_suffix(".tum"): 0, trajectory.with_suffix(".kitti.txt"): 0, log: 1}
    try:
        lines = {path: [line for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")] for path in headers}
        rows = min(len(lines[path]) - header for path, header in headers.items())
        if rows < fewest:
            raise InputError(
                f"the {fewest} rows of the checkpoint in trajectory and {log.name}",
                f"{max(rows, 0)} ({folder.path})",
                "start the run anew",
            )
        for path, header in headers.items():
            with path.open("r+b") as file:
                file.truncate(sum(map(len, lines[path][: rows + header])))
    except OSError as error:
        raise output_error(folder.path, error) from error
    return int(lines[trajectory][rows].split(b",")[0]) if rows else None
