"""`boxplus fleet run`: recordings, then which of them may have met, then whether they did, then one map.

The results lie in a folder that all workers share, or in an object store. Whatever was finished is not done again, so that a
fleet that was stopped goes on by the same command.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from boxplus.errors import InputError, OutputError
from boxplus.maps.tiles.layout import MANIFEST, Manifest, write_manifest
from boxplus.maps.tiles.store import merge
from boxplus.runs.fleet.executor import Executor
from boxplus.runs.fleet.joint_map import PARTS, Region, cut_run, join_region
from boxplus.runs.fleet.status import FleetStatus, RecordingStatus
from boxplus.runs.fleet.store import MERGED, SharedFolder, Store, open_store
from boxplus.runs.fleet.tasks import RunOutline, meet_runs, outline_run, run_of, run_recording
from boxplus.runs.sessions.config import MergeConfig, dump_merge_config
from boxplus.runs.sessions.folder import claim_merge_folder
from boxplus.runs.sessions.joined import doubts_of_joining, merge_facts
from boxplus.runs.sessions.merge_run import merge_runs
from boxplus.runs.sessions.repeated import repeated
from boxplus.runs.sessions.summary import MergeSummary
from boxplus.runs.sessions.tables import write_encounters
from boxplus.runs.slam.config import SlamRunConfig
from boxplus.runs.storage.output_folder import SUMMARY
from boxplus.systems.sessions.candidates import Looks, Pair
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.sessions import IN_DOUBT, SessionAlignment, place_surely, worlds_of
from boxplus.systems.slam.slam import Slam

Report = Callable[[FleetStatus, RecordingStatus | None], None]

_WRITTEN_EVERY_S = 1.0  # of a large fleet `fleet.json` is large, too


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
        output: folder or URL that every worker can write to; what is finished in it is kept.
        executor: where tasks run.
        slam, merging: settings; each has a default.
        remove_dynamic: as for `merge_runs`; for a folder only, and by this process alone.
        neighbours: other recordings that each one is laid over at least, the most alike first.
        report: called with the status after every task, and with the recording whose run has ended.

    Raises:
        InputError: no recording; another process runs a fleet there; `remove_dynamic` with a URL; a URL without a driver; workers
            that write to a place of their own; OpenCV, the extra `vision`, is not installed and density images are wanted.
        OutputError: the place cannot be written or the disk is full; a task of the joint map was lost for good.
    """
    if not recordings:
        raise InputError("a recording at least", "none", "see find_recordings")
    slam, merging = slam or SlamRunConfig(), merging or MergeConfig()
    Slam(slam.slam)  # what it refuses, a library that is missing, every recording would fail with
    store = open_store(output)
    if remove_dynamic and not isinstance(store, SharedFolder):
        raise InputError(
            "a folder, to remove what was seen through", f"{store.text}", "give a folder, or leave --remove-dynamic out"
        )
    with store.locked():
        fleet = _Fleet(recordings, store, executor, slam, merging, neighbours, report)
        return fleet.execute(remove_dynamic)


class _Fleet:
    def __init__(
        self,
        recordings: Mapping[str, Path],
        store: Store,
        executor: Executor,
        slam: SlamRunConfig,
        merging: MergeConfig,
        neighbours: int,
        report: Report | None,
    ) -> None:
        self._recordings, self._store, self._executor = recordings, store, executor
        self._slam, self._merging, self._neighbours, self._report = slam, merging, neighbours, report
        self._began = time.perf_counter()
        self._written = -_WRITTEN_EVERY_S
        self.status = FleetStatus(
            recordings=[RecordingStatus(name=name, recording=str(path)) for name, path in recordings.items()]
        )
        self._rows = self.status.recordings  # changed in place: a large fleet has many, and every task ends in a change

    def execute(self, remove_dynamic: bool) -> FleetStatus:
        self._note(stage="recordings")
        self._run_recordings()
        if len(self._sound()) > 1:
            self._note(stage="pairs")
            outlines = self._without_repeated(self._outlines(self._sound()))
            meetings = self._meetings(outlines)
            self._note(stage="map", pairs_looked_at=len(meetings))
            sessions = [outline.session for outline in outlines.values()]
            if len(sessions) > 1:
                alignment = place_surely(sessions, meetings, self._merging.sessions)
                earlier = self._better_map(alignment)
                if earlier is None:
                    self._write_map(alignment, remove_dynamic)
                self._note_alignment(meetings, alignment, earlier)
        elif self._store.read(f"{MERGED}/{SUMMARY}") is not None:
            self._note(warnings=[f"{self._store / MERGED} is of an earlier fleet: nothing was joined this time"])
        self._note(stage="finished")
        return self.status

    def _sound(self) -> list[str]:
        """Names of the recordings that came to their end and are to be trusted: one that is not would bend the others."""
        return [own.name for own in self._rows if own.state == "finished" and own.doubt is None]

    def _note(self, own: RecordingStatus | None = None, **facts: object) -> None:
        now = time.perf_counter()
        self.status = self.status.model_copy(update={**facts, "seconds": now - self._began})
        if "stage" in facts or now - self._written >= _WRITTEN_EVERY_S:
            self.status.write(self._store)
            self._written = time.perf_counter()
        if self._report is not None:
            self._report(self.status, own)

    def _note_recording(self, number: int, **facts: object) -> None:
        self._rows[number] = self._rows[number].model_copy(update=facts)
        self._note(self._rows[number])

    def _run_recordings(self) -> None:
        arguments = [(self._store.text, name, str(path), self._slam) for name, path in self._recordings.items()]
        for end in self._executor.run(run_recording, arguments):
            if end.error is not None:
                self._note_recording(end.number, state="failed", error=end.error)
                continue
            own: RecordingStatus = end.value
            if own.state == "finished" and self._store.read(f"{run_of(own.name)}/{SUMMARY}") is None:
                raise InputError(
                    "a place for the results that all workers share",
                    f"{self._store.text}, where this process does not find what a worker wrote",
                    "give a shared folder or the URL of an object store with --output",
                )
            self._note_recording(end.number, **own.model_dump())

    def _outlines(self, names: Sequence[str]) -> dict[str, RunOutline]:
        """Where the local maps of every run are; one that cannot be read is named, and the others go on."""
        config = self._merging.sessions.slam
        numbers = {own.name: number for number, own in enumerate(self._rows)}
        found: dict[str, RunOutline] = {}
        for end in self._executor.run(outline_run, [(self._store.text, name, config) for name in names]):
            if end.error is None:
                found[names[end.number]] = end.value
            else:
                self._note_recording(numbers[names[end.number]], state="failed", error=f"its local maps: {end.error}")
        return {name: found[name] for name in names if name in found}

    def _without_repeated(self, outlines: Mapping[str, RunOutline]) -> dict[str, RunOutline]:
        """A recording that is in the fleet twice would bear witness for itself: the second one is named and left out."""
        again = repeated({name: own.identity for name, own in outlines.items()})
        for number, row in enumerate(self._rows):
            if (first := again.get(row.name)) is not None:
                self._note_recording(number, doubt=f"it is the recording of {first} again")
        return {name: own for name, own in outlines.items() if name not in again}

    def _meetings(self, outlines: Mapping[str, RunOutline]) -> list[Meeting]:
        """Of sessions that look alike; of all pairs where there are few, or where nothing is described.

        Sessions that met leave worlds. As long as a round of pairs joins some of these, another one is looked at.
        """
        names, config = list(outlines), self._merging.sessions.slam
        if len(names) <= self._neighbours + 1 or config.appearance != "density":
            return self._meet(names, list(combinations(range(len(names)), 2)))
        looks = Looks([own.features for own in outlines.values()], config.descriptor)
        found: dict[Pair, Meeting] = {}
        pairs, count = looks.pairs(self._neighbours), len(names)
        while pairs:
            found.update(zip(pairs, self._meet(names, pairs), strict=True))
            worlds = worlds_of(len(names), found.values())
            if not 1 < len(worlds) < count:
                break
            pairs, count = looks.pairs_between(worlds, found, 2 * self._neighbours), len(worlds)
        return [found[pair] for pair in sorted(found)]

    def _meet(self, names: Sequence[str], pairs: Sequence[Pair]) -> list[Meeting]:
        arguments = [(self._store.text, (names[a], names[b]), (a, b), self._merging.sessions) for a, b in pairs]
        found: dict[int, Meeting] = {}
        for end in self._executor.run(meet_runs, arguments):
            a, b = pairs[end.number]
            if end.error is None:
                found[end.number] = end.value
            else:
                found[end.number] = Meeting(a, b, [], refusal=f"its task failed: {end.error}")
                self._note(pairs_failed=[*self.status.pairs_failed, f"{names[a]} and {names[b]}: {end.error}"])
        return [found[number] for number in sorted(found)]

    def _better_map(self, alignment: SessionAlignment) -> MergeSummary | None:
        """An earlier joint map that nothing speaks against, where something does against the new one: it stays."""
        against = doubts_of_joining(alignment, [None] * len(alignment.sessions))
        if len(alignment.worlds[0].members) == 1:
            against = ["no two of the recordings met"]
        facts = self._store.read(f"{MERGED}/{SUMMARY}")
        if not against or facts is None:
            return None
        try:
            earlier = MergeSummary.model_validate_json(facts)
        except ValidationError:  # nobody knows what it is
            return None
        if not earlier.joined or earlier.unaccepted:
            return None
        self._note(map_points=earlier.map_points, earlier_map_kept=against)
        return earlier

    def _write_map(self, alignment: SessionAlignment, remove_dynamic: bool) -> None:
        """The folder of `boxplus map merge`; an earlier one stays whole until this one is, where the store can do that."""
        names = [session.name for session in alignment.sessions]
        if remove_dynamic and isinstance(self._store, SharedFolder):
            folders = [self._store.path / run_of(name) for name in names]
            with claim_merge_folder(self._store.path / MERGED, overwrite=True) as claimed:
                merged = merge_runs(folders, claimed, self._merging, remove_dynamic=True, align=lambda _: alignment)
            self._note(map_points=merged.summary.map_points, warnings=merged.summary.warnings, map_doubts=merged.summary.doubts)
            return
        began, world = time.perf_counter(), alignment.worlds[0]
        summary = merge_facts(alignment, [self._store / run_of(name) for name in names], [None] * len(names))
        with self._store.joint_map() as into:
            self._store.write(f"{into}/config.yaml", dump_merge_config(self._merging).encode())
            with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
                table = Path(scratch) / "encounters.csv"
                write_encounters(table, alignment.meetings, names)
                self._store.write(f"{into}/{table.name}", table.read_bytes())
            points = 0
            if len(world.members) > 1:
                self._store.remove(PARTS)
                points = self._write_tiles(into, alignment)
                self._store.remove(PARTS)
            seconds = time.perf_counter() - began
            summary = summary.model_copy(update={"map_points": points, "seconds": seconds})
            self._store.write(f"{into}/{SUMMARY}", summary.model_dump_json(indent=2).encode())
        self._note(map_points=points, warnings=summary.warnings, map_doubts=summary.doubts)

    def _write_tiles(self, into: str, alignment: SessionAlignment) -> int:
        """Returns how many points there are."""
        text, config, world = self._store.text, self._merging.map, alignment.worlds[0]
        cuts = self._all(
            cut_run,
            [
                (text, alignment.sessions[number].name, number, T, into, config)
                for number, T in zip(world.members, world.T_world_map, strict=True)
            ],
        )
        intensity = all(cut.intensity for cut in cuts)
        regions: dict[Region, list[int]] = {}
        for number, cut in zip(world.members, cuts, strict=True):
            for region in cut.points:
                regions.setdefault(region, []).append(number)
        joined = self._all(
            join_region, [(text, region, numbers, into, config, intensity) for region, numbers in sorted(regions.items())]
        )
        with tempfile.TemporaryDirectory(prefix="boxplus-fleet-") as scratch:
            segments = sum(region.segments for region in joined)  # a half-lost map is to be noticed
            write_manifest(Path(scratch), Manifest(config.tile_size, config.voxel, intensity, closed=True, segments=segments))
            self._store.write(f"{into}/map/{MANIFEST}", (Path(scratch) / MANIFEST).read_bytes())
        if config.ply and isinstance(self._store, SharedFolder):
            merge(self._store.path / into / "map", [self._store.path / into / "map.ply"])
        return sum(region.points for region in joined)

    def _all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """The values of tasks none of which may be missing."""
        found: dict[int, Any] = {}
        for end in self._executor.run(function, arguments):
            if end.error is not None:
                raise OutputError(
                    f"expected every part of the joint map – got {end.error} ({arguments[end.number][1]}) – "
                    "the runs are kept: give the same command again, where files of a run are damaged without its folder"
                )
            found[end.number] = end.value
        return [found[number] for number in range(len(arguments))]

    def _note_alignment(self, meetings: Sequence[Meeting], alignment: SessionAlignment, earlier: MergeSummary | None) -> None:
        """Who is where, and which pairs met by themselves but not in the light of the others.

        Args:
            earlier: the joint map that is there, if it is not the one of this alignment.
        """
        names = [session.name for session in alignment.sessions]
        facts = {own.name: own for own in merge_facts(alignment, names, [None] * len(names)).sessions}
        lost = [
            (
                f"{names[after.query_session]} and {names[after.place_session]}: {after.refusal}",
                after.refusal.startswith(IN_DOUBT),
            )
            for before, after in zip(meetings, alignment.meetings, strict=True)
            if before.refusal is None and after.refusal is not None
        ]
        in_earlier = None if earlier is None else {own.name for own in earlier.joined}
        for number, own in enumerate(self._rows):
            if (found := facts.get(own.name)) is not None:
                joined = found.joined if in_earlier is None else own.name in in_earlier
                known = {"joined": joined, "apart_because": found.apart_because}
                self._rows[number] = own.model_copy(update=known)
        against, in_doubt = ([text for text, is_in_doubt in lost if is_in_doubt == which] for which in (False, True))
        count = sum(meeting.refusal is None for meeting in alignment.meetings)
        self._note(contradictions=against, pairs_in_doubt=in_doubt, pairs_joined=count)
