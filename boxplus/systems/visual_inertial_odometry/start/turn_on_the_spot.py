"""Why one camera finds no start while it only turns, or sees only what is far away: no depth is seen without parallax."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks, shared_rows
from boxplus.systems.visual_inertial_odometry.corners.turning import distances, turn_between

_APART_NS = 500_000_000
_FEWEST = 12
_MOVED = 0.03  # rad: half a second that turns
# Rendered rooms, halls, aisles and stairs: turns on the spot left up to 0.0034, motions up to 0.015 and more (even seeds).
_PARALLAX = 0.0075  # rad


def turn_on_the_spot(seen: Sequence[Tracks], focal_px: float) -> str | None:
    """What the corners of one camera say where it turned and they moved as a turn moves them; None where they did otherwise.

    Args:
        seen: frames in order of time.
        focal_px: of the camera; numbers are told in its pixels.
    """
    pairs = list(_pairs(seen))
    turning = [pair for pair in pairs if pair[0] >= _MOVED]
    if not turning or max(left for _, left in pairs) > _PARALLAX:
        return None
    moved, left = max(turning, key=lambda pair: pair[1])
    return (
        f"in half a second corners move by {focal_px * moved:.1f} px, of which a rotation leaves {focal_px * left:.1f} px of "
        f"parallax ({focal_px * _PARALLAX:.1f} are needed): the camera turns on the spot, or all that it sees is far away; it "
        "has to move sideways near something"
    )


def _pairs(seen: Sequence[Tracks]) -> Iterator[tuple[float, float]]:
    """By how much corners move in half a second in the median, and what a rotation leaves of it, in units of the rays."""
    before = seen[0]
    for tracks in seen[1:]:
        if tracks.time_ns - before.time_ns < _APART_NS:
            continue
        i, j = shared_rows(before.ids, tracks.ids)
        m1, m2 = before.rays[i, 0], tracks.rays[j, 0]
        before = tracks
        ahead = (m1[:, 2] > 0.0) & (m2[:, 2] > 0.0)  # not so of what the first camera does not see, or behind a wide lens
        m1, m2 = m1[ahead], m2[ahead]
        if len(m1) >= _FEWEST:
            moved = float(np.median(np.linalg.norm(m2 - m1, axis=1)))
            yield moved, float(np.median(distances(turn_between(m1, m2), m1, m2)))
