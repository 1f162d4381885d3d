"""Tables of a run in a saved map: one row a scan, and one a candidate of every search."""

from __future__ import annotations

import math
from pathlib import Path
from typing import get_args

from boxplus.runs.storage.row_log import Columns, RowLogWriter
from boxplus.runs.vague_pose import largest_sigmas
from boxplus.systems.localization.localizer import Localization, Search, Status

LOG_COLUMNS = Columns(
    numbers=("matched_share", "innovation", "innovation_limit", "measured", "sigma_position", "sigma_rotation"),
    texts=(),
    statuses=get_args(Status),
    program="boxplus localize",
)
"""Columns of `localization.csv`; NaN where a scan was not compared. Sigmas are the largest of any direction [m, rad]."""

SEARCH_COLUMNS = Columns(
    numbers=(
        *("place", "qw", "qx", "qy", "qz", "x", "y", "z"),
        *("agreement", "fit", "distance", "overlap", "rms", "measured", "seen_through"),
    ),
    texts=("refusal", "verdict"),
    statuses=("passes", "refused"),
    program="boxplus localize",
)
"""Columns of `searches.csv`: T_map_query and what was asked of it (`Candidate`); `verdict` is that of the whole search."""


class LocalizationLog(RowLogWriter):
    """Appends one row a scan to `localization.csv`; see `RowLogWriter`."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, LOG_COLUMNS)

    def append(self, found: Localization) -> None:
        """Write one row.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        nan, matched = math.nan, found.matched
        compared = [nan] * 4 if matched is None else [matched.share, matched.innovation, matched.limit, matched.measured]
        sigmas = [nan, nan]
        if found.covariance is not None:
            sigmas = list(reversed(largest_sigmas(found.covariance)))
        self.append_row(found.time_ns, found.status, [*compared, *sigmas], [])


class SearchLog(RowLogWriter):
    """Appends the candidates of a search to `searches.csv`; see `RowLogWriter`."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, SEARCH_COLUMNS)

    def append(self, search: Search) -> None:
        """Write a row for each candidate.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        for c in search.candidates:
            numbers = [c.place, *c.T_map_query, c.agreement, c.fit, c.distance, c.overlap, c.rms, c.measured, c.seen_through]
            status = "passes" if c.refusal is None else "refused"
            self.append_row(search.time_ns, status, numbers, [c.refusal or "", search.verdict])


def candidate_texts(search: Search, count: int = 5) -> list[str]:
    """A sentence for each of the best candidates of a search."""
    found = []
    for c in search.candidates[:count]:
        x, y, z = c.T_map_query[4:]
        why = c.refusal or search.verdict or "believed"
        share = f"{100 * c.fit:.0f} % of what stands"
        text = why if why.startswith(share) else f"{share} fits; {why}"
        found.append(f"({x:.1f}, {y:.1f}, {z:.1f}) m, near local map {c.place}: {text}")
    return found
