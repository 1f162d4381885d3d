"""A finished run of `boxplus slam`: where it puts the odometry, its loops, and the fixes that it rests on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3
from boxplus.recordings.recording import Recording
from boxplus.runs.slam.config import SlamRunConfig, load_slam_config
from boxplus.runs.slam.folder import PROGRAM, SlamFolder
from boxplus.runs.slam.gnss_output import located, read_origin
from boxplus.runs.slam.graph_file import read_graph
from boxplus.runs.slam.summary import SlamSummary, read_slam_summary
from boxplus.runs.storage.output_folder import SUMMARY, program_of
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.systems.georeference.georeference import Georeference
from boxplus.systems.refinement.outside.evidence import Receiver, RunFixes, RunLoops
from boxplus.systems.slam.outcome import SlamOutcome

Floats = NDArray[np.float64]

_SAME_MIDDLE_M = 1e-3  # of fixes as georeference.yaml has it, which keeps every digit


@dataclass(frozen=True, slots=True, eq=False)
class ClosedRun:
    """The folder of a run of `boxplus slam`, read.

    Attributes:
        folder, summary, config, outcome: of it.
        trajectory: of the run; odometry: before loops were closed.
    """

    folder: SlamFolder
    summary: SlamSummary
    config: SlamRunConfig
    outcome: SlamOutcome
    trajectory: Trajectory
    odometry: Trajectory

    @property
    def is_located(self) -> bool:
        """Whether positions by satellite say where it is."""
        return self.folder.georeference.is_file()

    def loops(self) -> RunLoops | None:
        """The loops that the run rests on; None without."""
        accepted, own = self.outcome.accepted, self.outcome.correction
        if not accepted:
            return None
        rows = np.searchsorted(self.odometry.times, own.time_ns)
        if rows.max() >= len(self.odometry) or not np.array_equal(self.odometry.times[rows], own.time_ns):
            raise InputError("local maps at scans of the odometry", f"others in {self.folder.path}", "run 'boxplus slam' again")
        T_odo_imu = np.hstack([self.odometry.q_wxyz, self.odometry.p])[rows]
        return RunLoops(
            time_ns=own.time_ns,
            T_imu_map=se3.compose(se3.inverse(T_odo_imu), own.T_odo),
            place=np.array([loop.place for loop in accepted]),
            query=np.array([loop.query for loop in accepted]),
            T_place_query=np.stack([loop.T_place_query for loop in accepted]),
            information=np.stack([loop.information for loop in accepted]),
        )

    def fixes(self, recording: Recording) -> RunFixes | None:
        """The fixes that the run was laid onto the Earth by; None where it was not.

        Raises:
            InputError: the recording does not have them any more, or they do not agree with the run.
        """
        origin = read_origin(self.folder.path)
        if origin is None:
            return None
        found = located(recording, self.folder, self.outcome, self.config)
        said = _objection(found, origin)
        if said is not None or found is None or found.fit is None:
            raise InputError(
                "the positions by satellite that the run was laid onto the Earth by",
                f"{said}",
                f"give the same recording, or refine {self.folder.odometry.path}, without loops and fixes",
            )
        fit, gnss = found.fit, self.config.gnss
        used = np.flatnonzero(fit.is_used)
        is_given = not fit.lever_sigma.any()
        return RunFixes(
            time_ns=found.attached.time_ns[used],
            p_enu=origin.to_enu(found.attached.lat_lon_alt[used]),
            covariance=fit.fix_covariance[used],
            start=Receiver(SE3.identity(), fit.lever, fit.delay, np.full(10, np.nan)),
            lever_sigma=None if is_given else gnss.lever_sigma,
            delay_sigma=gnss.delay_sigma,
            vertical_sigma=self.config.slam.gravity_sigma,
        )


def _objection(found: Georeference | None, origin: EnuFrame) -> str | None:
    """Why these are not the fixes that a run with that origin rests on; None where nothing says so."""
    if found is None:
        return "a recording without fixes"
    if found.frame is None or found.fit is None or found.contradiction is not None:
        return f"{found.refusal or found.contradiction}"
    # The origin is the middle of the fixes: those of another receiver, or reckoned anew, have another one.
    away = np.linalg.norm(origin.to_enu([[found.frame.latitude, found.frame.longitude, found.frame.altitude]]))
    return f"others, whose middle lies {away:.3g} m away from that of these" if away > _SAME_MIDDLE_M else None


def is_closed_run(folder: Path) -> bool:
    """Whether it is the output folder of 'boxplus slam'.

    Raises:
        InputError: it is that of a command whose results cannot be refined.
    """
    summary = folder / SUMMARY
    program = program_of(summary) if summary.is_file() else None
    if program in (None, "boxplus lio"):
        return False
    if program != PROGRAM:
        raise InputError(
            "the output folder of 'boxplus lio' or 'boxplus slam'", f"one of {program!r} ({folder})",
            "give the folder of a run that came before it, or run one of these on the recording",
        )  # fmt: skip
    return True


def read_closed_run(folder: str | Path) -> ClosedRun:
    """Read the folder of `boxplus slam`.

    Raises:
        InputError: a run that did not come to its end, or that says itself that it is not to be trusted.
    """
    own = SlamFolder(Path(folder))
    summary = read_slam_summary(own.summary)
    if summary.state != "finished":
        raise InputError("a run that has come to its end", summary.describe_state(), "go on with it: --resume")
    if summary.contradiction is not None:
        raise InputError(
            "a run that can be trusted",
            summary.contradiction,
            f"repair that and run 'boxplus slam' again; {own.odometry.path} is the odometry without loops",
        )
    trajectory, odometry = read_trajectory(own.trajectory), read_trajectory(own.odometry.trajectory)
    if not np.array_equal(trajectory.times, odometry.times):
        raise InputError(
            "the same scans in trajectory.csv and odometry/trajectory.csv", f"others in {own.path}", "run 'boxplus slam' again"
        )
    return ClosedRun(own, summary, load_slam_config(own.config), read_graph(own.graph), trajectory, odometry)
