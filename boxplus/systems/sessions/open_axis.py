"""How far along does one session lie in another, where no encounter by itself tells?

Along a street of even fronts a twentieth of what a local map sees faces along the street: steps of fronts, parked cars. A
registration that begins metres off finds none of them where it looks, calls the direction open, and stays where likeness has put
it. All encounters leave the same axis open, and all of them shift by the same. So what faces along it is laid over the other
session, that of all encounters at once, at every shift within reach: where one shift fits, and no other one nearly as well, that
is how far along it lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.registration import Surface, facing_planes
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.places import Places
from boxplus.systems.slam.loop import Floats, Loop

_LEAST_TURN = np.sin(np.deg2rad(15.0)) ** 2  # of directions that are told from each other: nearer ones are left open alike
_WORTH_OF_ONE = 0.99  # encounter that measures a direction, but for rounding
_FACING = 0.6  # cosine between a normal and the axis
_STEP, _FINE = 0.2, 0.02  # m, between shifts
_WIDTH = 0.15  # m, off its plane a point fits
_DISTANCE = 0.8  # m, within which a point has a plane
_POINTS = 400  # that face along the axis, of one local map
_FEWEST = 60  # of all together, that find a plane
_FITTING = 0.4  # mean weight of those that find one: of points anywhere within reach of a plane it is a seventh
_SHARE = 0.2  # of all, that find one
_ALIKE = 0.5  # of the best score, at another shift: then nothing tells the two apart
_APART = 1.0  # m, shifts that are others
_SIGMA = 0.05  # m, of the shift found
_HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class Shift:
    """How far along an axis a session lies from where it was thought to [m]; `refusal`, why nothing tells, None where it does."""

    metres: float
    refusal: str | None = None


def open_axis(loops: Sequence[Loop], query: Places, weak_sigma: float) -> Floats | None:
    """The direction (3,) in the query session's frame that no encounter measures; None where each is measured.

    Each encounter has the projector on the directions that it measures. The axis is that of which they measure least, all
    together. What one leaves open it knows to some degrees: only what it measures beyond that counts, or many that all leave open
    one direction, each a slightly different one, would pass for one that measures it.
    """
    projectors = np.stack([_measured(loop, query, weak_sigma) for loop in loops])
    axis = np.linalg.eigh(projectors.sum(axis=0))[1][:, 0]
    shares = np.einsum("i,kij,j->k", axis, projectors, axis)
    worth = float(np.maximum((shares - _LEAST_TURN) / (1.0 - _LEAST_TURN), 0.0).sum())
    return None if worth >= _WORTH_OF_ONE else np.asarray(axis)


def _measured(loop: Loop, query: Places, weak_sigma: float) -> Floats:
    """(3, 3) projector on the directions of the position that an encounter measures, in the query session's frame."""
    variance, axes = np.linalg.eigh(loop.covariance[3:, 3:])
    known = quaternion.to_matrix(query.session.T_session_map[loop.query, :4]) @ axes[:, variance < weak_sigma**2]
    return np.asarray(known @ known.T)


def shift_along(
    axis: Floats, loops: Sequence[Loop], T_place_query: Floats, place: Places, query: Places, config: SessionsConfig
) -> Shift:
    """Where along an axis (3,) of the query session's frame what faces along it lies on surfaces of the other session.

    Args:
        loops: encounters, whose local maps are compared.
        T_place_query: (7,) of the sessions' frames, where they were thought to be.
    """
    telling = [_Telling.of(axis, loop, T_place_query, place, query, config) for loop in loops]
    every = np.arange(-config.reach, config.reach + 0.5 * _STEP, _STEP)
    scores = np.array([_score(telling, shift, config)[0] for shift in every.tolist()])
    coarse = float(every[np.argmax(scores)])
    fine = np.arange(coarse - _STEP, coarse + _STEP, _FINE)
    found = [_score(telling, shift, config) for shift in fine.tolist()]
    best = int(np.argmax([score for score, _ in found]))
    score, near = found[best]
    asked = sum(len(one.points) for one in telling)
    if near < max(_FEWEST, _SHARE * asked) or score < _FITTING * near:
        return Shift(0.0, "nothing that faces along it lies over each other")
    elsewhere = np.where(np.abs(every - fine[best]) > _APART, scores, 0.0)
    if elsewhere.max() >= _ALIKE * score:
        away = abs(float(every[np.argmax(elsewhere)]) - float(fine[best]))
        return Shift(0.0, f"what faces along it fits as well {away:.1f} m farther")
    return Shift(float(fine[best]))


def moved_along(loop: Loop, axis: Floats, query: Places, count: int) -> Loop:
    """An encounter that leaves the axis open, with its part of what `count` of them together tell of it."""
    a = np.zeros(6)
    a[3:] = quaternion.to_matrix(query.session.T_session_map[loop.query, :4]).T @ axis
    variance = count * _SIGMA**2
    gain = loop.covariance @ a / (variance + a @ loop.covariance @ a)
    covariance = loop.covariance - np.outer(gain, a @ loop.covariance)
    return replace(
        loop,
        covariance=0.5 * (covariance + covariance.T),
        information=loop.information + np.outer(a, a) / variance,
        measured=min(loop.measured + 1, 6),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Telling:
    """Points (n, 3) of a local map that face along the axis, the surface that they are laid over, where, and the axis there."""

    points: NDArray[np.float32]
    target: Surface
    T: Floats
    axis: Floats

    @classmethod
    def of(
        cls, axis: Floats, loop: Loop, T_place_query: Floats, place: Places, query: Places, config: SessionsConfig
    ) -> _Telling:
        maps = place.session.T_session_map[loop.place], query.session.T_session_map[loop.query]
        T = se3.compose(se3.compose(se3.inverse(maps[0]), T_place_query), maps[1])
        own = query.surface(loop.query)
        along = quaternion.to_matrix(maps[1][:4]).T @ axis
        _, faces = facing_planes(own.points, own, _HERE, along, _FACING, _DISTANCE, config.slam.registration)
        points = own.points[faces]
        points = np.ascontiguousarray(points[:: max(len(points) // _POINTS, 1)])
        return cls(points, place.surface(loop.place), T, quaternion.to_matrix(T[:4]) @ along)


def _score(telling: Sequence[_Telling], shift: float, config: SessionsConfig) -> tuple[float, int]:
    """Sum of the weights of points on planes that face along the axis, and how many find one."""
    total, near = 0.0, 0
    for one in telling:
        if not len(one.points):
            continue
        T = one.T.copy()
        T[4:] += shift * one.axis
        e, found = facing_planes(one.points, one.target, T, one.axis, _FACING, _DISTANCE, config.slam.registration)
        total += float(np.maximum(0.0, 1.0 - (e[found] / _WIDTH) ** 2).sum())
        near += int(np.count_nonzero(found))
    return total, near
