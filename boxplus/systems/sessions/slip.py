"""Did the odometry of a session slip on its way? Encounters up to there agree on one alignment, those from there on on another.

The larger set is what two sessions are joined by; the smaller one is left out as what outliers are, and all that the session saw
from there on lies at the wrong place in the joint map, over what the other one saw there. Encounters that are false for another
reason, as two places look alike, are mostly single, or lie among true ones along the way. So those are asked for that agree with
each other, come from two local maps of a session at least, and come all before or all after those that it is joined by. Where a
way ends in a place like another one that may be so as well, and both are said.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus._words import counted
from boxplus.manifolds import se3
from boxplus.systems.slam.loop import Floats, Loop

_LEAST_M, _LEAST_RAD = 0.5, np.deg2rad(2.0)  # by which both alignments differ: an odometry that drifts a little more is none
_NUMBERS = "place", "query"  # of local maps in an encounter
_FEWEST = 2  # local maps of the session that slipped, and encounters of them


def slip_of(kept: Sequence[Loop], others: Sequence[Loop], names: tuple[str, str], T_world_map: Sequence[Floats]) -> str | None:
    """A sentence on where the odometry of a session slipped; None where nothing says so.

    Args:
        kept: the encounters that two sessions are joined by.
        others: encounters that passed every test, contradict these, and agree with each other.
        names: of the place session and of the query session. T_world_map: (n, 7) for either, as they are joined.
    """
    if len(others) < _FEWEST:
        return None
    T_place, T_query = (T[[getattr(loop, own) for loop in others]] for T, own in zip(T_world_map, _NUMBERS, strict=True))
    measured = np.stack([loop.T_place_query for loop in others])
    apart = se3.log(se3.compose(se3.inverse(se3.compose(T_place, measured)), T_query))
    turn, metres = (float(np.median(np.linalg.norm(xi, axis=1))) for xi in (apart[:, :3], apart[:, 3:]))
    if metres < _LEAST_M and turn < _LEAST_RAD:
        return None
    for name, number in zip(names, _NUMBERS, strict=True):
        own, theirs = ({int(getattr(loop, number)) for loop in loops} for loops in (kept, others))
        if len(theirs) < _FEWEST or not (max(own) < min(theirs) or max(theirs) < min(own)):
            continue
        how = f"{metres:.1f} m" + (f" and {np.rad2deg(turn):.0f}°" if turn >= _LEAST_RAD else "")
        return (
            f"{names[1]} and {names[0]} lie over each other along a part of the way only: {counted(len(others), 'encounter')} of "
            f"local maps {min(theirs)} to {max(theirs)} of {name} agree with each other, and lie {how} from where those of "
            f"local maps {min(own)} to {max(own)} put them: the odometry of one of the two slipped "
            "between, or two places look alike"
        )
    return None
