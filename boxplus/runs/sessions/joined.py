"""What is said of sessions that were joined: facts of each, and its trajectory in the joint world."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory import read_trajectory
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import se3
from boxplus.runs.run_loop import versions
from boxplus.runs.sessions.session_run import SessionRun
from boxplus.runs.sessions.summary import MergeSummary, SessionFacts
from boxplus.runs.slam.corrected import append_moved, turned_covariances
from boxplus.systems.localization.map_lengths import OTHER_LENGTHS
from boxplus.systems.sessions.sessions import SessionAlignment
from boxplus.systems.slam.correction import Correction

Floats = NDArray[np.float64]

_SCALE_SIGMAS = 3.5
_LEAST_SCALE = 0.002  # of a length: LiDARs are no better than that, and a map bent by less than `OTHER_LENGTHS` is of use


def merge_facts(alignment: SessionAlignment, runs: Sequence[str], doubts: Sequence[str | None]) -> MergeSummary:
    """Where the sessions are, and what keeps those apart that are in no joint map.

    Args:
        runs: where each session's run is.
        doubts: why that run itself is not to be trusted; None where nothing speaks against it.
    """
    world, apart = alignment.worlds[0], _refusals(alignment)
    is_joined = len(world.members) > 1
    row_of = {number: row for row, number in enumerate(world.members)} if is_joined else {}
    sessions, warnings = [], []
    doubted = doubts_of_joining(alignment, doubts)
    for number, (session, run, doubt) in enumerate(zip(alignment.sessions, runs, doubts, strict=True)):
        row = row_of.get(number)
        facts = SessionFacts(
            name=session.name,
            run=run,
            local_maps=len(session.maps),
            joined=row is not None,
            apart_because=[] if row is not None else apart.get(number, []),
            doubt=doubt,
        )
        if row is not None:
            T = world.T_world_session[row]
            rigid = se3.compose(np.broadcast_to(T, session.T_session_map.shape), session.T_session_map)
            bend = np.linalg.norm(world.T_world_map[row][:, 4:] - rigid[:, 4:], axis=1).max()
            sigma = np.sqrt(np.diag(world.covariance[row]))
            facts = facts.model_copy(
                update={"T_world_session": T.tolist(), "sigma": sigma.tolist(), "largest_bend_m": float(bend)}
            )
        sessions.append(facts)
        if doubt is not None and row is None:
            warnings.append(_untrusted(session.name, doubt))
    warnings += [text for text, is_small in _other_scales(alignment).values() if is_small]
    for other in alignment.worlds[1:]:
        if is_joined and len(other.members) > 1:
            them = " and ".join(alignment.sessions[k].name for k in other.members)
            warnings.append(f"{them} met each other but none of the others: merge them by themselves")
    return MergeSummary(
        versions=versions("opencv-python-headless"),
        created=datetime.now(UTC),
        sessions=sessions,
        encounters_looked_at=sum(len(meeting.encounters) for meeting in alignment.meetings),
        encounters_accepted=sum(len(meeting.accepted) for meeting in alignment.meetings),
        doubts=doubted,
        warnings=warnings,
    )


def doubts_of_joining(alignment: SessionAlignment, doubts: Sequence[str | None], held: int = 0) -> list[str]:
    """Why the joint map of sessions is not to be trusted, in sentences; none where nothing speaks against it, or there is none.

    Args:
        doubts: of each session's own run. held: so many of the first are in a joint map already: not asked about again.
    """
    world = alignment.worlds[0]
    if len(world.members) == 1:
        return []
    found = list[str]()
    joins, scales = alignment.doubtful_joins(held), _other_scales(alignment)
    for number in world.members:
        if number < held:
            continue
        name, doubt = alignment.sessions[number].name, doubts[number]
        if doubt is not None:
            found.append(_untrusted(name, doubt))
        if number in scales and not scales[number][1]:
            found.append(scales[number][0])
    return found + list(dict.fromkeys(text for texts in joins.values() for text in texts)) + alignment.slips(held)


def _other_scales(alignment: SessionAlignment) -> dict[int, tuple[str, bool]]:
    """Sessions of the joint world with another scale than the others, in sentences, and whether it is too small for a doubt."""
    world, found = alignment.worlds[0], dict[int, tuple[str, bool]]()
    for number, (ratio, deviation) in zip(world.members, world.scale.tolist(), strict=True):
        if abs(ratio - 1.0) > max(_SCALE_SIGMAS * deviation, _LEAST_SCALE):
            name = alignment.sessions[number].name
            text = (
                f"{name} has another scale: it fits the others best with its lengths times {ratio:.4f} "
                f"(± {deviation:.4f}); the ranges of one of the LiDARs are wrong, and the joint map is bent between them"
            )
            found[number] = text, abs(ratio - 1.0) <= OTHER_LENGTHS
    return found


def _untrusted(name: str, doubt: str) -> str:
    return f"{name} is not to be trusted itself: {doubt}"


def write_session_trajectory(folder: Path, run: SessionRun, T_world_map: Floats) -> None:
    """A session's trajectory in the joint world; its covariance is that of the session, against its own first pose.

    Raises:
        OutputError: the folder cannot be written.
    """
    before = read_trajectory(run.folder.trajectory)
    poses = Correction(run.correction.time_ns, run.correction.T_map, T_world_map).apply(
        before.times, np.hstack([before.q_wxyz, before.p])
    )
    with TrajectoryWriter(folder, run.session.name) as writer:
        append_moved(writer, before, poses, turned_covariances(before, poses))


def _refusals(alignment: SessionAlignment) -> dict[int, list[str]]:
    """What spoke against joining each session with each other one, as `SessionAlignment.why_apart` says it."""
    names, found = [own.name for own in alignment.sessions], dict[int, list[str]]()
    for m in alignment.meetings:
        if m.refusal is not None:
            text = f"{names[m.query_session]} and {names[m.place_session]}: {m.refusal}"
            for session in (m.place_session, m.query_session):
                found.setdefault(session, []).append(text)
    return found
