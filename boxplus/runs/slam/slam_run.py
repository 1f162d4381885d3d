"""LiDAR-inertial odometry over a recording with loops closed beside it: the odometry's results, and the corrected ones."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from boxplus._arguments import as_settings
from boxplus.errors import BoxplusError, InputError, OutputError, printable
from boxplus.formats.output import atomic_file, make_folder
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.earlier_run import refuse_other_recording
from boxplus.runs.lidar_inertial.extrinsic import Extrinsic
from boxplus.runs.lidar_inertial.odometry_run import View, run_odometry
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.run_facts import State
from boxplus.runs.run_loop import Progress, versions
from boxplus.runs.slam.beside import Beside, LoopView
from boxplus.runs.slam.config import SlamRunConfig, dump_slam_config
from boxplus.runs.slam.corrected import write_corrected_map, write_corrected_trajectory
from boxplus.runs.slam.folder import SlamFolder, claim_slam_folder
from boxplus.runs.slam.gnss_output import gnss_facts, gnss_warnings, lay_onto_earth, write_georeference
from boxplus.runs.slam.graph_file import write_graph
from boxplus.runs.slam.loop_file import Pairs, objections_to_forced, pairs_without_maps, write_loops
from boxplus.runs.slam.loop_search import LoopSearch
from boxplus.runs.slam.result import SlamResult
from boxplus.runs.slam.spool import ScanSpool
from boxplus.runs.slam.summary import LEFT_IN_PLACE, SlamSummary, read_slam_summary
from boxplus.sensors.satellites.geodesy import require_utm
from boxplus.systems.georeference.georeference import Georeference
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.outcome import SlamOutcome
from boxplus.systems.slam.slam import Slam
from boxplus.systems.slam.upright_path import climb_within_upright_plane

_KINDS = {  # beginnings of the sentences that refuse a loop
    "looks alike": "looks alike, but the odometry excludes it",
    "too few": "too few points on planes",
    "the surfaces determine": "too few directions measured",
    "the maps overlap": "too little overlap",
    "surfaces lie": "surfaces do not fit",
    "the maps fit": "fits as well elsewhere",
    "contradicts": "contradicts other loops",
}


def run_slam(
    recording: Recording,
    folder: str | Path | SlamFolder,
    config: SlamRunConfig | None = None,
    *,
    forbidden: Pairs | None = None,
    forced: Pairs | None = None,
    extrinsic: Extrinsic | None = None,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    view: View | None = None,
    loop_view: LoopView | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> SlamResult:
    """Run the odometry and close loops while it runs; write the corrected trajectory and map beside its own.

    Loops are looked for by a process of its own, whose result depends on the local maps alone. A run that was killed or
    interrupted goes on from the odometry's checkpoint, or, where that is finished, from what it left; the loops are looked for
    again among the local maps on disk. Its results are those of a run without an interruption, to the bit. Where it was killed
    before its first checkpoint, it begins anew.

    Args:
        recording: opened.
        folder: created; see docs/output_folder.md for what it holds. Or what `claim_slam_folder` yields.
        config: settings; each has a default.
        forbidden, forced: pairs (query, place) of local maps, see `read_loop_decisions`.
        loop_view: shown loops when they are closed.
        extrinsic, overwrite, resume, progress, view, should_stop: as for `run_odometry`.

    Raises:
        InputError: OpenCV, the extra `vision`, is not installed and density images are wanted; what `run_odometry` and `Slam`
            refuse; nothing to resume.
        OutputError: the folder cannot be written or the disk is full.
        RecordingError: nothing could be read.
        BoxplusError: the process that looks for loops came to an end.
    """
    config = as_settings(SlamRunConfig, config)
    if config.gnss.utm:
        require_utm()
    Slam(config.slam, forbidden=forbidden or (), forced=forced or ())  # refuses what it refuses before the odometry has run
    if not recording.info.imu_topic:
        config.odometry.of_lidar_alone()  # as does this
    if isinstance(folder, SlamFolder):
        claimed = nullcontext(folder)
    else:
        claimed = claim_slam_folder(folder, overwrite=overwrite, resume=resume)  # type: ignore[assignment]
    with claimed as own:
        run = _Run(recording, own, config, resume and own.can_go_on(), (forbidden or [], forced or []))
        own_slam = config.slam if recording.info.imu_topic else config.slam.without_gravity()
        search = LoopSearch(own_slam, forbidden or [], forced or [], make_folder(own.local_maps), own.graph)
        return run.execute(search, extrinsic, progress or (lambda _: None), view, loop_view, should_stop or (lambda: False))


class _Run:
    """One run: the odometry, then what closing the loops makes of its results."""

    def __init__(
        self, recording: Recording, folder: SlamFolder, config: SlamRunConfig, resume: bool, decided: tuple[Pairs, Pairs]
    ) -> None:
        self._recording, self._folder, self._config, self._resume = recording, folder, config, resume
        self._decided = decided  # forbidden and forced
        self._has_imu = bool(recording.info.imu_topic)
        self._started, self._resumed = datetime.now(UTC), 0
        text = dump_slam_config(config)
        if resume:
            self._resumed = _checked_to_go_on(folder, text)
            if folder.odometry_standing() == "finished":  # else its checkpoint says of which recording it is
                refuse_other_recording(folder.odometry, recording)
        with atomic_file(folder.config) as file:
            file.write(text.encode())

    def execute(
        self,
        search: LoopSearch,
        extrinsic: Extrinsic | None,
        progress: Callable[[Progress], None],
        view: View | None,
        loop_view: LoopView | None,
        should_stop: Callable[[], bool],
    ) -> SlamResult:
        """Everything; `run.json` says how it ended."""
        own, config = self._folder, self._config
        own.graph.unlink(missing_ok=True)  # of a run that was interrupted: what is there belongs together, or is not there
        self._facts("running").write(own.summary)
        spool = ScanSpool(own.spool, config.map.voxel, go_on=self._resume) if config.map.save else None
        try:
            with (
                search,
                closing(
                    Beside(config.local_maps, LocalMapFolder(own.local_maps), spool, search, loop_view, has_gravity=self._has_imu)
                ) as beside,
            ):
                if self._resume and own.odometry_standing() == "finished":
                    odometry = self._finished_odometry(beside)
                else:
                    odometry = run_odometry(
                        self._recording, own.odometry.path, config.of_odometry(), extrinsic=extrinsic, resume=self._resume,
                        progress=progress, view=view, companion=beside, should_stop=should_stop,
                    )  # fmt: skip
                if not search.given:  # it was interrupted before its first pose: nothing is to be closed or moved
                    return self._without_poses(odometry)
                outcome = search.finish(lambda: progress(_waiting(search)))
            return self._write(odometry, outcome, spool, search.seconds)
        except BaseException as problem:
            named = str(problem) if isinstance(problem, BoxplusError) else f"{type(problem).__name__}: {problem}"
            stopped = isinstance(problem, KeyboardInterrupt)
            with suppress(OutputError):  # the disk may be full
                self._facts("running" if stopped else "failed", None if stopped else named).write(own.summary)
            raise
        finally:
            if spool is not None:
                spool.close()

    def _finished_odometry(self, beside: Beside) -> RunSummary:
        """The odometry had come to its end; its local maps reach up to there."""
        odometry, maps = read_summary(self._folder.odometry.summary), LocalMapFolder(self._folder.local_maps)
        count = len(maps)
        if not count or maps[count - 1].end_ns != odometry.last_time_ns:
            raise InputError(
                "local maps up to the end of the odometry", f"{count} in {maps.path}, the last of them older",
                "start the run anew",
            )  # fmt: skip
        beside.give_again(count)
        return odometry

    def _without_poses(self, odometry: RunSummary) -> SlamResult:
        """No trajectory and no map; `--resume` goes on from the odometry's checkpoint."""
        summary = self._facts(odometry.state).model_copy(update={"contradiction": odometry.contradiction})
        summary.write(self._folder.summary)
        none = Correction(np.zeros(0, dtype=np.int64), np.zeros((0, 7)), np.zeros((0, 7)))
        maps = LocalMapFolder(self._folder.local_maps)
        return SlamResult(self._folder, summary, odometry, SlamOutcome(none, [], None), maps)

    def _write(self, odometry: RunSummary, outcome: SlamOutcome, spool: ScanSpool | None, slam_s: float) -> SlamResult:
        own, config, told = self._folder, self._config, list[str]()
        began = time.perf_counter()
        if self._has_imu:
            outcome, earth = lay_onto_earth(self._recording, own, outcome, config)
        else:
            maps = LocalMapFolder(own.local_maps)
            level = next((number for number in range(len(outcome.correction.time_ns)) if maps[number].is_level), None)
            outcome, earth = outcome if level is None else outcome.upright(level), None
            told.append(_told_of_up(outcome, level))
            write_graph(own.graph, outcome)
            if self._recording.info.gnss_topic:
                told.append("the positions by satellite are not used: that takes an IMU, which tells where down is")
        correction, gnss = outcome.correction, None
        if not outcome.accepted:
            told.insert(0, LEFT_IN_PLACE)
        told += pairs_without_maps(*self._decided, len(correction.time_ns))
        told += objections_to_forced(outcome.loops)
        write_corrected_trajectory(own, outcome.placed, is_closed=bool(outcome.accepted))
        if earth is not None:
            write_graph(own.graph, outcome)
            write_georeference(own, earth, config.gnss)
            gnss = gnss_facts(self._recording.info.gnss_topic, earth, correction)
            told += gnss_warnings(earth, config.gnss)
        stored = write_corrected_map(own, config.map, spool, outcome.placed) if spool is not None else 0
        write_loops(own.loops, outcome.loops, np.asarray((correction.time_ns - (odometry.first_time_ns or 0)) * 1e-9))
        shift = np.linalg.norm(correction.T_map[:, 4:] - correction.T_odo[:, 4:], axis=1)
        refused = Counter(_kind(loop.refusal) for loop in outcome.loops if not loop.is_accepted)
        summary = self._facts(odometry.state).model_copy(
            update={
                "contradiction": doubt_of_run(odometry, outcome, earth),
                "scans": odometry.scans,
                "path_length_m": odometry.path_length_m,
                "local_maps": len(correction.time_ns),
                "loops_looked_at": len(outcome.loops),
                "loops_accepted": len(outcome.accepted),
                "loops_forced": sum(loop.source == "forced" for loop in outcome.accepted),
                "loops_refused": dict(refused),
                "largest_shift_m": float(shift.max()),
                "last_shift_m": float(shift[-1]),
                "map_points": stored,
                "spool_bytes": None if spool is None else spool.mark().size,
                "slam_s": slam_s,
                "writing_s": time.perf_counter() - began,
                "gnss": gnss,
                "warnings": told,
            }
        )
        summary.write(own.summary)
        return SlamResult(own, summary, odometry, outcome, LocalMapFolder(own.local_maps))

    def _facts(self, state: State, error: str | None = None) -> SlamSummary:
        return SlamSummary(
            versions=versions("rosbags", "opencv-python-headless"),
            state=state,
            error=error,
            resumed=self._resumed,
            started=self._started,
            updated=datetime.now(UTC),
            recording=printable(str(self._recording.info.path.resolve())),
        )


def _checked_to_go_on(folder: SlamFolder, config: str) -> int:
    """How often the run will have been resumed; settings are those that it began with."""
    before = folder.config.read_text(encoding="utf-8") if folder.config.is_file() else ""
    if before != config:
        pairs = zip(before.splitlines(), config.splitlines(), strict=False)
        began, now = next(((a, b) for a, b in pairs if a != b), ("more settings", "fewer"))
        raise InputError(
            f"the settings that the run began with ({began.strip()})", now.strip(),
            f"give --config {folder.config}, or start a new run in another folder",
        )  # fmt: skip
    return 1 + (read_slam_summary(folder.summary).resumed if folder.summary.is_file() else 0)


def _told_of_up(outcome: SlamOutcome, level: int | None) -> str:
    """Without an IMU; `level` is the first local map that shows it."""
    if level is None:
        return "no IMU tells where down is, and nothing shows where up is: the map stands as the LiDAR did"
    maps = "the first local map do" if level == 0 else f"local map {level} do, those of earlier ones do not"
    tilt = np.degrees(2.0 * np.arccos(np.clip(outcome.T_world_map[0], -1.0, 1.0)))
    text = (
        f"no IMU tells where down is: surfaces of {maps}; trajectory and map are turned upright, by {tilt:.1f}° from where the "
        "LiDAR began"
    )
    climb = climb_within_upright_plane(outcome.placed.T_map[:, 4:])
    if climb is None:
        return text
    return (
        f"{text}; its path then lies in an upright plane and goes {climb:.1f} m up and down in it: if it stayed on the ground, "
        "the LiDAR is mounted more than 45° from upright (on its side), and z of trajectory and map is not up"
    )


def doubt_of_run(odometry: RunSummary, outcome: SlamOutcome, earth: Georeference | None) -> str | None:
    """All that makes a run not to be trusted: odometry, local maps and loops, satellites; None where nothing does.

    Odometry that did not know where it ended may know it by satellites.
    """
    is_located = earth is not None and earth.fit is not None
    by_odometry = odometry.contradiction_of_sensors if is_located else odometry.contradiction
    by_satellite = None if earth is None or earth.contradiction is None else f"positions by satellite: {earth.contradiction}"
    return "; ".join(text for text in (by_odometry, outcome.doubt, by_satellite) if text) or None


def _waiting(search: LoopSearch) -> Progress:
    """The odometry is at its end; the loop search comes after it."""
    return Progress(search.done / max(search.given, 1), search.done, "local maps", "ok", stage="closing loops")


def _kind(refusal: str | None) -> str:
    """What a sentence is about; a loop without one was refused by the graph."""
    if refusal is None:
        return "contradicts other loops"
    return next((kind for begin, kind in _KINDS.items() if refusal.startswith(begin)), "too far from the odometry")
