"""Files of loops: what was found, one row a loop, and what a user says about them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file
from boxplus.systems.slam.loop import Loop

Pairs = list[tuple[int, int]]

_KEYS = ("forbid", "force")
_NAMED = 5  # pairs in a sentence
_COLUMNS = (
    *("query", "place", "query_s", "place_s", "accepted", "weight", "source", "inliers", "overlap_query", "overlap_place"),
    *("rms_m", "rms_odometry_m", "innovation", "innovation_limit", "measured", "qw", "qx", "qy", "qz", "x", "y", "z", "refusal"),
)


def write_loops(path: Path, loops: Sequence[Loop], seconds: NDArray[np.float64]) -> None:
    """`loops.csv`: every loop that was looked at; `seconds` (n,) of the local maps since the first scan.

    Raises:
        OutputError: it cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for loop in loops:
        numbers = [*loop.overlap, loop.rms, loop.rms_odometry, loop.innovation, loop.innovation_limit]
        writer.writerow(
            [
                loop.query,
                loop.place,
                *(f"{seconds[k]:.3f}" for k in (loop.query, loop.place)),
                int(loop.is_accepted),
                f"{loop.weight:g}",
                loop.source,
                loop.inliers,
                *(f"{value:.5g}" for value in numbers),
                loop.measured,
                *(f"{value:.9g}" for value in loop.T_place_query),
                why_refused(loop),
            ]
        )
    with atomic_file(path) as file:
        file.write(text.getvalue().encode())


def why_refused(loop: Loop) -> str:
    """The sentence of a loop that is not believed; empty for one that is."""
    if loop.is_accepted:
        return ""
    return loop.refusal or "contradicts the loops that agree with each other and with the odometry"


def read_loop_decisions(path: str | Path) -> tuple[Pairs, Pairs]:
    """What a user decided: pairs (query, place) of local maps that are forbidden, and that are forced, from a YAML file.

    Two keys, each optional, with lists of pairs as they stand in `loops.csv`:

        forbid: [[41, 3], [42, 3]]
        force: [[57, 12]]

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    advice = "write 'forbid: [[41, 3]]' and 'force: [[57, 12]]', pairs of query and place from loops.csv"
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError("a readable YAML file of loops", f"{path}: {error}", advice) from error
    content = {} if content is None else content
    if not isinstance(content, dict) or not set(content) <= set(_KEYS):
        raise InputError(f"the keys {' and '.join(_KEYS)} in {path}", f"{content!r}"[:200], advice)
    return _pairs(content, "forbid", path, advice), _pairs(content, "force", path, advice)


def pairs_without_maps(forbidden: Pairs, forced: Pairs, count: int) -> list[str]:
    """What a user decided about local maps that there are not, in sentences; `count` is how many there are."""
    sentences = []
    for verb, pairs in (("forbidden", forbidden), ("forced", forced)):
        if unknown := [f"[{query}, {place}]" for query, place in pairs if query >= count]:
            named = ", ".join(unknown[:_NAMED]) + (" …" if len(unknown) > _NAMED else "")
            sentences.append(
                f"{verb} pairs that do not exist, as there are local maps 0 to {count - 1} only: {named}; "
                "take pairs from loops.csv"
            )
    return sentences


def objections_to_forced(loops: Sequence[Loop]) -> list[str]:
    """What speaks against loops that a user forced, in sentences; whether they are believed all the same."""
    sentences = []
    for loop in loops:
        pair = f"[{loop.query}, {loop.place}]"
        if loop.source == "forced" and not loop.is_accepted:
            sentences.append(f"the forced loop {pair} is not closed: {why_refused(loop)}")
        elif loop.objection is not None:
            sentences.append(
                f"the forced loop {pair} is closed, although {loop.objection}; look in the report how the two lie over each other"
            )
    return sentences


def _pairs(content: dict[str, object], key: str, path: str | Path, advice: str) -> Pairs:
    rows = content.get(key) or []
    found = []
    for row in rows if isinstance(rows, list) else [rows]:
        if not (isinstance(row, list) and len(row) == 2 and all(isinstance(n, int) and not isinstance(n, bool) for n in row)):
            raise InputError(f"pairs of local maps under {key} in {path}", f"{row!r}", advice)
        found.append((row[0], row[1]))
    return found
