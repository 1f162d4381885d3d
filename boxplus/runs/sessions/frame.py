"""What gives a joint map its frame: where the first of its sessions begins, in the run as it was when the map was made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from boxplus.errors import InputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import se3
from boxplus.runs.sessions.session_run import SessionRun
from boxplus.runs.sessions.summary import FrameFacts

_SAME_M, _SAME_RAD = 0.01, 1e-3  # a run that was made again with other settings begins as near to where it did


def frame_of(run: SessionRun) -> FrameFacts:
    """Of a map whose first session is that run."""
    trajectory = read_trajectory(run.folder.trajectory)
    pose = np.concatenate([trajectory.q_wxyz[0], trajectory.p[0]])
    points = run.identity.first_points
    return FrameFacts(
        session=run.session.name,
        time_ns=int(trajectory.times[0]),
        T_frame_imu=pose.tolist(),
        first_points=None if points is None else list(points),
    )


def refuse_another_frame(folder: Path, before: FrameFacts | None, run: SessionRun) -> None:
    """Refuse to go on with a map whose first session was replaced by a run in another frame: everything in it would be elsewhere.

    Args:
        folder: of the map. before: as it was when the map was made; None: nobody knows. run: as it is now.

    Raises:
        InputError: it begins at another time, with other points, or elsewhere in its frame.
    """
    if before is None:
        return
    now = frame_of(run)
    turn, shift = np.split(se3.log(se3.compose(se3.inverse(before.T_frame_imu), now.T_frame_imu)), 2)
    angle, metres, later = float(np.linalg.norm(turn)), float(np.linalg.norm(shift)), (now.time_ns - before.time_ns) * 1e-9
    points = None if before.first_points is None else tuple(before.first_points)
    is_same = replace(run.identity, first_points=points).begins_like(run.identity)  # clocks of simulations begin alike
    if later == 0.0 and metres <= _SAME_M and angle <= _SAME_RAD and is_same:
        return
    if later:
        begins = f"begins {later:+.1f} s later"
    elif not is_same:
        begins = "begins with other points"
    else:
        begins = f"begins {metres:.3g} m and {np.degrees(angle):.2g}° away in its frame"
    raise InputError(
        f"the run that gives {folder} its frame, as it was when that map was made",
        f"another one in {run.folder.path}, which {begins}",
        "put the earlier one back, or make the map anew by 'boxplus map merge': it will have the frame of this one",
    )
