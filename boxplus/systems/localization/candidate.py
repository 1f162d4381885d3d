"""A pose at which a query may lie in the map, and everything that was asked of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.registration import Surface, approach, mean_distance, register
from boxplus.systems.localization.config import LocalizationConfig
from boxplus.systems.localization.global_search import Guess, same_pose
from boxplus.systems.localization.standing import seen_through, standing

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

_NEAR = 0.3  # m, between a point that stands and the map's
_ASKED = 4000  # points that stand, for the fit
_FAR = 0.15  # m, that a point is off its surface at most: beyond, it does not belong to it
_FAR_WORSE = 0.5  # of the best fit, before the last stage of registration: what fits less is not worth that stage
_ONE = 0.2, np.deg2rad(1.0), 0.2  # m, rad, m: guesses that come so near to each other go on as one
_STACKED_M = 2.0  # m, on the ground, between poses that lie above one another; in height, of storeys at least
_NO_PLANES = "too few points on planes of the map"


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A place in the map, registered.

    Attributes:
        place: number of the local map it was found over.
        T_map_query: (7,) after registration; covariance (6, 6) on the right of it [rad, m].
        agreement: of both from above, see `Guess`.
        fit: share of the query's points that stand within 0.3 m of points of the map.
        distance: their mean distance from the map's surfaces, where each counts 15 cm at most; that where nobody looked [m].
        overlap: share of all points within 0.5 m.
        rms: spread of distances to the map's planes [m].
        measured: how many of the six directions the surfaces determine.
        seen_through: share of directions in which the map has something nearer than what was measured; NaN where something else
            speaks against it already, and nobody looked.
        refusal: why it is not believed, in a sentence; None where nothing speaks against it.
    """

    place: int
    T_map_query: Floats
    covariance: Floats
    agreement: float
    fit: float
    distance: float
    overlap: float
    rms: float
    measured: int
    seen_through: float
    refusal: str | None


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """What is looked for: a local map, and the newest scan of it.

    Attributes:
        points: (N, 3), frame level; stands: those of them that stand.
        scan: (M, 3) of one scan, in the frame of the query; viewpoint: (3,) where it was taken.
    """

    points: Points
    stands: Points
    surface: Surface
    scan: Points
    viewpoint: Floats

    @classmethod
    def of(cls, points: Points, scan: Points, viewpoint: Floats) -> Query:
        stands = points[standing(points)]
        spread = np.ascontiguousarray(stands[:: max(len(stands) // _ASKED, 1)])
        return cls(points, spread, Surface.of(points), scan, viewpoint)


def examine(guess: Guess, T_approached: Floats, query: Query, surroundings: Surface, config: LocalizationConfig) -> Candidate:
    """Register a query to the map, and ask what speaks against it.

    Args:
        T_approached: (7,) T_map_query that `approach` came to from the guess.
        surroundings: the map around the guess, map frame.
    """
    found = register(query.surface, surroundings, T_approached, config.registration, is_close=True)
    if found is None:
        return _unfit(guess, guess.T_map_query, 0.0, _NO_PLANES)
    T = found.T_target_source
    fit = _share_near(query.stands, surroundings, T)
    candidate = Candidate(
        guess.place,
        T,
        found.covariance,
        guess.agreement,
        fit,
        mean_distance(query.stands, surroundings, T, _FAR, config.registration),
        found.overlap[0],
        found.rms,
        6 - len(found.weak),
        float("nan"),
        None,
    )
    refusal = _refusal(candidate, config)
    if refusal is not None:
        return replace(candidate, refusal=refusal)
    scan = se3.act(T, query.scan.astype(np.float64)).astype(np.float32)
    map_stands = surroundings.points[standing(surroundings.points)]
    through = seen_through(scan, map_stands, se3.act(T, query.viewpoint[None])[0])
    if through > config.most_seen_through:
        refusal = f"in {100 * through:.0f} % of directions the map has something nearer than what is seen"
    return replace(candidate, seen_through=through, refusal=refusal)


def _refusal(candidate: Candidate, config: LocalizationConfig) -> str | None:
    if candidate.measured < 6:
        return f"the surfaces determine {candidate.measured} of 6 directions only"
    if candidate.fit < config.least_fit:
        return f"{100 * candidate.fit:.0f} % of what stands is in the map, {100 * config.least_fit:.0f} % asked for"
    if candidate.overlap < config.least_overlap:
        return f"{100 * candidate.overlap:.0f} % of the points are in the map, {100 * config.least_overlap:.0f} % asked for"
    if candidate.rms > config.largest_rms:
        return f"surfaces lie {100 * candidate.rms:.1f} cm apart, {100 * config.largest_rms:.0f} cm at most"
    return None


def rivalry(candidates: list[Candidate], config: LocalizationConfig) -> tuple[Candidate | None, str, bool]:
    """The best candidate that nothing speaks against, why it is not believed yet (empty where it is), and whether at once.

    Every other pose is its rival, also one that was refused: a second place that fits nearly as well means that the map is alike
    in two places, and a pose nearby that does that the surfaces repeat.
    """
    ranked = sorted(candidates, key=lambda candidate: -candidate.fit)
    best = next((candidate for candidate in ranked if candidate.refusal is None), None)
    if best is None:
        return None, f"no place passes every test{_storeys(ranked[0], ranked, config) if ranked else ''}", False
    at_once = True
    for other in ranked:
        if other is best or same_pose(other.T_map_query, best.T_map_query):
            continue
        is_clearly_worse = (
            1.0 - other.fit >= config.telling_misfit * (1.0 - best.fit)
            or (1.0 - config.telling_lead) * other.distance >= best.distance
        )
        if best.fit - other.fit < config.telling * (0.5 if is_clearly_worse else 1.0):
            away = float(np.linalg.norm(other.T_map_query[4:] - best.T_map_query[4:]))
            fits = f"{_percent(other)} and {_percent(best)}{_storeys(best, ranked, config)}"
            return best, f"another pose, {away:.1f} m away, fits nearly as well: {fits}", False
        at_once = at_once and other.fit * config.decisive <= best.fit
    return best, "", at_once


def _storeys(best: Candidate, ranked: list[Candidate], config: LocalizationConfig) -> str:
    """What follows a verdict where poses above one another fit as well as the best (empty where none do)."""
    stacked = [best]
    for other in ranked:
        d = np.abs(other.T_map_query[4:] - best.T_map_query[4:])
        is_above = np.hypot(d[0], d[1]) < _STACKED_M and d[2] > _STACKED_M
        if is_above and best.fit - other.fit < 0.5 * config.telling:
            stacked += [other] if not any(same_pose(other.T_map_query, one.T_map_query) for one in stacked) else []
    if len(stacked) < 2:
        return ""
    stacked.sort(key=lambda one: one.fit)
    return (
        f"; {len(stacked)} poses above one another fit alike, {_percent(stacked[0])} to {_percent(stacked[-1])}: storeys that "
        "look the same from here; go where they differ"
    )


def best_first(candidates: list[Candidate]) -> list[Candidate]:
    """Those that nothing refuses, then the others, each by how well they fit."""
    return sorted(candidates, key=lambda candidate: (candidate.refusal is not None, -candidate.fit))


def distinct(candidates: list[Candidate]) -> list[Candidate]:
    """The first of each pose: several guesses come to the same one."""
    found: list[Candidate] = []
    for one in candidates:
        if not any(same_pose(one.T_map_query, other.T_map_query) for other in found):
            found.append(one)
    return found


def lead(best: Candidate, candidates: list[Candidate]) -> float:
    """By what part less than at the best rival the points that stand are off the map's surfaces; negative where they are more.

    What both places have is their kind: racks, columns and walls fit wherever there are such, also in the map of another hall.
    The rest tells which place of its kind this one is. In its own map most of it lies where it did; in that of another place it
    fits no better than at the rivals (docs/localization.md).
    """
    others = [one.distance for one in candidates if one is not best and not same_pose(one.T_map_query, best.T_map_query)]
    return 1.0 - best.distance / max(min(others, default=_FAR), 1e-9)


def contradiction(here: Candidate, others: list[Candidate], T_map_query: Floats, config: LocalizationConfig) -> str | None:
    """What speaks against a place that is followed, in words; None where nothing does.

    Less is asked than of a place that is to be found: a corridor may leave a direction open, a map may end.

    Args:
        here: examined from the pose (7,) at which the place is followed.
    """
    if here.measured == 6 and not same_pose(here.T_map_query, T_map_query):
        away = float(np.linalg.norm(here.T_map_query[4:] - T_map_query[4:]))
        return f"the surfaces of the map draw what is seen {away:.1f} m away"
    if here.seen_through > config.most_seen_through:
        return here.refusal
    better = max((one for one in others if one.refusal is None), key=lambda one: one.fit, default=None)
    if better is None or same_pose(better.T_map_query, T_map_query):
        return None
    if better.fit - here.fit < config.telling or better.distance > (1.0 - config.least_lead) * here.distance:
        return None
    away = float(np.linalg.norm(better.T_map_query[4:] - T_map_query[4:]))
    return f"another pose, {away:.1f} m away, fits better: {_percent(better)} and {_percent(here)}"


def examine_all(
    guesses: list[Guess], query: Query, points_near: Callable[[Floats, float], Points], config: LocalizationConfig
) -> list[Candidate]:
    """Candidates of the guesses in their order, each registered to the map around it, and of those that come to one pose one.

    What fits far worse than the best is left at a glance.
    """
    reach = float(np.quantile(np.linalg.norm(query.points, axis=1), 0.98)) + 5.0
    around: dict[tuple[int, ...], Surface] = {}
    seen: list[tuple[Guess, Surface, Floats | None, float]] = []
    for guess in guesses:
        key = tuple(np.round(guess.T_map_query[4:] / reach * 2.0).astype(int).tolist())
        if key not in around:
            around[key] = Surface.of(points_near(np.array(key) * reach / 2.0, 1.5 * reach))
        target = around[key]
        T = approach(query.surface, target, guess.T_map_query, config.registration) if len(target.points) else None
        if T is not None and any(before is not None and same_pose(before, T, *_ONE) for _, _, before, _ in seen):
            continue
        seen.append((guess, target, T, 0.0 if T is None else _share_near(query.stands, target, T)))
    worth = _FAR_WORSE * max((fit for *_, fit in seen), default=0.0)
    found: list[Candidate] = []
    for guess, target, T, fit in seen:
        if T is None:
            found.append(_unfit(guess, guess.T_map_query, 0.0, _NO_PLANES))
        elif fit < worth:
            found.append(_unfit(guess, T, fit, f"{100 * fit:.0f} % of what stands is in the map, far less than elsewhere"))
        else:
            found.append(examine(guess, T, query, target, config))
    return found


def _unfit(guess: Guess, T_map_query: Floats, fit: float, refusal: str) -> Candidate:
    none = float("nan")
    return Candidate(guess.place, T_map_query, np.eye(6), guess.agreement, fit, _FAR, none, none, 0, none, refusal)


def _share_near(points: Points, target: Surface, T: Floats) -> float:
    if not len(points):
        return 0.0
    moved = se3.act(T, points.astype(np.float64))
    return float(np.mean(target.tree.nearest(moved, 1, max_distance=_NEAR).counts > 0))


def _percent(candidate: Candidate) -> str:
    return f"{100 * candidate.fit:.0f} %"
