"""`boxplus fleet run`: recordings, then which of them may have met, then whether they did, then one map.

The results of every recording lie in a folder that all workers share. Whatever was finished is not done again, so that a fleet
that was stopped goes on by the same command.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from boxplus.errors import InputError
from boxplus.formats.output import make_folder
from boxplus.maps.descriptors.features import Features
from boxplus.runs.fleet.executor import Executor
from boxplus.runs.fleet.status import FleetStatus, RecordingStatus
from boxplus.runs.fleet.tasks import describe_run, meet_runs, run_recording
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.merge_run import MergeResult, merge_runs
from boxplus.runs.slam.config import SlamRunConfig
from boxplus.runs.storage.folder_lock import locked_folder
from boxplus.systems.sessions.candidates import candidate_pairs
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.session import Session
from boxplus.systems.sessions.sessions import SessionAlignment, place_sessions

Report = Callable[[FleetStatus], None]


@dataclass(frozen=True, slots=True)
class FleetFolder:
    """The paths of the results."""

    path: Path

    @property
    def status(self) -> Path:
        """Where the fleet stands."""
        return self.path / "fleet.json"

    @property
    def merged(self) -> Path:
        """The joint map, as `boxplus map merge` leaves it."""
        return self.path / "merged"

    def run(self, name: str) -> Path:
        """The run of one recording."""
        return self.path / "runs" / name


def run_fleet(
    recordings: Mapping[str, Path],
    output: str | Path,
    executor: Executor,
    slam: SlamRunConfig | None = None,
    merging: MergeConfig | None = None,
    *,
    remove_dynamic: bool = False,
    neighbours: int = 6,
    report: Report | None = None,
) -> FleetStatus:
    """Run every recording, find out which of them met, and write one map of these.

    Args:
        recordings: paths by name, as `find_recordings` finds them; every worker can read them under these paths.
        output: folder that every worker can write to; what is finished in it is kept.
        executor: where tasks run.
        slam, merging: settings; each has a default.
        remove_dynamic: as for `merge_runs`.
        neighbours: other recordings that each one is laid over at least, the most alike first.
        report: called with the status after every task.

    Raises:
        InputError: no recording; another process runs a fleet there.
        OutputError: the folder cannot be written or the disk is full.
    """
    if not recordings:
        raise InputError("a recording at least", "none", "see find_recordings")
    folder = FleetFolder(make_folder(output))
    with locked_folder(folder.path, "boxplus fleet run"):
        fleet = _Fleet(recordings, folder, executor, slam or SlamRunConfig(), merging or MergeConfig(), neighbours, report)
        return fleet.execute(remove_dynamic)


class _Fleet:
    def __init__(
        self,
        recordings: Mapping[str, Path],
        folder: FleetFolder,
        executor: Executor,
        slam: SlamRunConfig,
        merging: MergeConfig,
        neighbours: int,
        report: Report | None,
    ) -> None:
        self._recordings, self._folder, self._executor = recordings, folder, executor
        self._slam, self._merging, self._neighbours, self._report = slam, merging, neighbours, report
        self._began = time.perf_counter()
        waiting = [RecordingStatus(name=name, recording=str(path)) for name, path in recordings.items()]
        self.status = FleetStatus(recordings=waiting)

    def execute(self, remove_dynamic: bool) -> FleetStatus:
        self._note()
        self._run_recordings()
        names = [own.name for own in self.status.recordings if own.state == "finished"]
        if len(names) > 1:
            self._note(stage="pairs")
            pairs = self._pairs(names)
            meetings = self._meet(names, pairs)
            self._note(stage="map", pairs_looked_at=len(pairs))
            merged = self._merge(names, meetings, remove_dynamic)
            self._note(
                joined=[session.name for session in merged.summary.joined],
                pairs_joined=sum(meeting.refusal is None for meeting in merged.alignment.meetings),
            )
        self._note(stage="finished")
        return self.status

    def _note(self, **facts: object) -> None:
        self.status = self.status.model_copy(update={**facts, "seconds": time.perf_counter() - self._began})
        self.status.write(self._folder.status)
        if self._report is not None:
            self._report(self.status)

    def _run_recordings(self) -> None:
        names = list(self._recordings)
        arguments = [(name, str(path), str(self._folder.run(name)), self._slam) for name, path in self._recordings.items()]
        for end in self._executor.run(run_recording, arguments):
            rows = list(self.status.recordings)
            rows[end.number] = (
                end.value
                if end.error is None
                else RecordingStatus(
                    name=names[end.number], recording=rows[end.number].recording, state="failed", error=end.error
                )
            )
            self._note(recordings=rows)

    def _pairs(self, names: Sequence[str]) -> list[tuple[int, int]]:
        """Sessions that look alike; all pairs where there are few, or where nothing is described."""
        count = len(names)
        if count <= self._neighbours + 1 or self._merging.sessions.slam.appearance != "density":
            return [(a, b) for a in range(count) for b in range(a + 1, count)]
        described: list[list[Features]] = [[] for _ in names]
        arguments = [(str(self._folder.run(name)), self._merging.sessions.slam) for name in names]
        for end in self._executor.run(describe_run, arguments):
            if end.error is None:
                described[end.number] = end.value
        return candidate_pairs(described, self._merging.sessions.slam.descriptor, per_session=self._neighbours)

    def _meet(self, names: Sequence[str], pairs: Sequence[tuple[int, int]]) -> list[Meeting]:
        folders = [str(self._folder.run(name)) for name in names]
        arguments = [((folders[a], folders[b]), (names[a], names[b]), (a, b), self._merging.sessions) for a, b in pairs]
        found: dict[int, Meeting] = {}
        for end in self._executor.run(meet_runs, arguments):
            a, b = pairs[end.number]
            if end.error is None:
                found[end.number] = end.value
            else:
                found[end.number] = Meeting(a, b, [], refusal=f"its task failed: {end.error}")
                self._note(pairs_failed=[*self.status.pairs_failed, f"{names[a]} and {names[b]}: {end.error}"])
        return [found[number] for number in sorted(found)]

    def _merge(self, names: Sequence[str], meetings: Sequence[Meeting], remove_dynamic: bool) -> MergeResult:
        def align(sessions: Sequence[Session]) -> SessionAlignment:
            return place_sessions(sessions, meetings, self._merging.sessions)

        folders = [self._folder.run(name) for name in names]
        return merge_runs(folders, self._folder.merged, self._merging, remove_dynamic=remove_dynamic, overwrite=True, align=align)
