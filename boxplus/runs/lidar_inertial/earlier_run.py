"""What an earlier run left in a folder, for one that is to go on with it."""

from __future__ import annotations

from typing import Literal

from boxplus.errors import InputError, printable
from boxplus.recordings.recording import Recording
from boxplus.runs.checkpoint import refuse_other_settings
from boxplus.runs.lidar_inertial.config import RunConfig, dump_run_config, redump_run_config
from boxplus.runs.lidar_inertial.extrinsic import Extrinsic
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.storage.output_folder import program_of
from boxplus.runs.storage.state_codec import is_of_this_program

Standing = Literal["not begun", "stopped", "stopped before its first checkpoint", "stopped under another boxplus", "finished"]

_PROGRAM = RunSummary.model_fields["program"].default


def standing(folder: RunFolder) -> Standing:
    """How far a run of `boxplus lio` came in a folder, which may not be there.

    Raises:
        InputError: a `run.json` that cannot be read, unless it names another command.
    """
    if folder.checkpoint.is_file():
        return "stopped" if is_of_this_program(folder.checkpoint) else "stopped under another boxplus"
    if not folder.summary.is_file() or program_of(folder.summary) not in (_PROGRAM, None):
        return "not begun"
    return "finished" if read_summary(folder.summary).state == "finished" else "stopped before its first checkpoint"


def finished_run(folder: RunFolder, recording: Recording, config: RunConfig, extrinsic: Extrinsic) -> RunSummary:
    """The facts of a finished run, which has to be what this recording and these settings would give.

    Args:
        folder: of a run that is finished.
        recording: opened.
        config: settings that are asked for now.
        extrinsic: as for a new run.

    Raises:
        InputError: it is of another recording, or was made with other settings.
    """
    summary = refuse_other_recording(folder, recording)
    used = config.model_copy(update={"odometry": extrinsic.applied_to(config.odometry)})
    refuse_other_settings(folder, redump_run_config(folder.config), dump_run_config(used, recording.info))
    return summary


def refuse_other_recording(folder: RunFolder, recording: Recording) -> RunSummary:
    """The facts of the run in a folder, which has to be of this recording, wherever that lies.

    Raises:
        InputError: it is of another recording.
    """
    summary, info = read_summary(folder.summary), recording.info
    made = summary.recording
    before = (made.format, made.lidar_topic, made.imu_topic, made.messages, made.duration_s)
    now = (info.format, printable(info.lidar_topic), printable(info.imu_topic), info.message_count, info.duration_s)
    if before != now:
        texts = (
            f"{form}, {count} messages in {duration:.9f} s, {lidar} and {imu}"
            for form, lidar, imu, count, duration in (before, now)
        )
        raise InputError(
            f"the recording that the run in {folder.path} is of ({next(texts)})",
            next(texts),
            "choose another folder with --output, or replace it with --overwrite",
        )
    return summary
