"""`encounters.csv` and `changes.csv` of a joint map."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from boxplus.formats.output import atomic_file
from boxplus.maps.seen_through import SeenThrough
from boxplus.systems.sessions.encounter import Meeting

_ENCOUNTERS = (
    *("place_session", "query_session", "place", "query", "accepted", "source", "inliers", "overlap_query", "overlap_place"),
    *("rms_m", "innovation", "measured", "qw", "qx", "qy", "qz", "x", "y", "z", "refusal"),
)
_CHANGES = ("before", "after", "what", "x", "y", "z", "size_x", "size_y", "size_z", "voxels")


def write_encounters(path: Path, meetings: Iterable[Meeting], names: Sequence[str]) -> None:
    """Every pair of local maps of two sessions that was looked at, with T_place_query and what spoke against it.

    Raises:
        OutputError: it cannot be written.
    """
    rows = []
    for meeting in meetings:
        for loop in meeting.encounters:
            is_accepted = meeting.refusal is None and loop.refusal is None
            numbers = [*loop.overlap, loop.rms, loop.innovation]
            rows.append(
                [
                    *(names[meeting.place_session], names[meeting.query_session], loop.place, loop.query, int(is_accepted)),
                    *(loop.source, loop.inliers, *(f"{value:.5g}" for value in numbers), loop.measured),
                    *(f"{value:.9g}" for value in loop.T_place_query),
                    "" if is_accepted else loop.refusal or f"the sessions are apart: {meeting.refusal}",
                ]
            )
    _write(path, _ENCOUNTERS, rows)


def write_changes(path: Path, seen: SeenThrough, names: Sequence[str], least: int) -> int:
    """What vanished and appeared between one session and the next, as clusters of voxels; returns how many.

    Args:
        names: of the sessions, in the order in which they were counted.
        least: voxels of a change.

    Raises:
        OutputError: it cannot be written.
    """
    rows = []
    for before in range(len(names) - 1):
        after = before + 1
        for what, chosen in zip(("vanished", "appeared"), seen.changes(before, after), strict=True):
            for voxels in seen.clusters(chosen, least):
                low, high = seen.middle[voxels].min(axis=0), seen.middle[voxels].max(axis=0)
                size = high - low + seen.config.voxel
                numbers = (f"{value:.2f}" for value in (*(0.5 * (low + high)), *size))
                rows.append([names[before], names[after], what, *numbers, len(voxels)])
    _write(path, _CHANGES, rows)
    return len(rows)


def _write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    with atomic_file(path) as file:
        file.write(text.getvalue().encode())
