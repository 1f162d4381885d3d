"""Is a proposed loop one? Every test has its sentence, so that a refused loop says what spoke against it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile
from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.local_maps.registration import Registration, Surface, fitting_share, register
from boxplus.systems.slam.config import SlamConfig
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.odometry_chain import RelativePoses, mahalanobis
from boxplus.systems.slam.proposals import Proposal
from boxplus.systems.slam.rivals import rival_shifts

Floats = NDArray[np.float64]

_RIVAL_AGREEMENT = 0.6  # of two density images, against that where the query was laid, for a shift to be tried
_RIVALS = 3  # tried
_TOLERANCE = 2.5  # standard deviations from a plane within which a point fits
_SAME_MINIMUM = 0.5  # m: a start that comes back to within this is no rival
_BASIN_ROTATION, _BASIN_POSITION = 0.1, 1.0  # rad, m: by which density images misplace a true loop
_RMS_FLOOR = 0.02  # m: successive maps that fit better than this say nothing about others


def verify(
    proposal: Proposal,
    maps: tuple[LocalMap, LocalMap],
    surfaces: tuple[Surface, Surface],
    rms_odometry: float,
    odometry: RelativePoses,
    config: SlamConfig,
) -> Loop:
    """Lay the query over the place and ask whether that is a loop: fit, overlap both ways, innovation, rivals.

    Args:
        maps: the query and the place; surfaces: theirs.
        rms_odometry: how well successive local maps fit there [m].
    """
    query, place = maps
    own, there = surfaces
    base = Loop(
        query.number,
        proposal.place,
        proposal.source,
        proposal.inliers,
        proposal.T_start,
        proposal.T_start,
        np.eye(6),
        np.zeros((6, 6)),
    )
    if proposal.source in ("appearance", "scan context") and (refusal := _far_off(base, odometry, config)):
        return replace(base, refusal=refusal)
    bend = _deformation(query, place, proposal.T_start)
    found = register(own, there, proposal.T_start, config.registration, bend)
    if found is not None and len(found.weak):
        # What was not measured is taken from the odometry, so that it pulls at nothing.
        start = _with_weak_from(found, odometry.between(place.number, query.number)[0])
        found = register(own, there, start, config.registration, bend)
    if found is not None and len(found.weak):
        found = _where_less_is_open(found, own, there, bend, odometry.between(place.number, query.number), config)
    if found is None:
        return replace(base, refusal="too few points of one map lie on planes of the other")
    loop = replace(
        base,
        T_place_query=found.T_target_source,
        covariance=found.covariance,
        information=found.information,
        measured=6 - len(found.weak),
        overlap=found.overlap,
        rms=found.rms,
        rms_odometry=rms_odometry,
    )
    innovation, limit = _innovation(loop, found, odometry, config)
    loop = replace(loop, innovation=innovation, innovation_limit=limit)
    return replace(loop, refusal=_refusal(loop, found, own, there, odometry, config))


def _with_weak_from(found: Registration, T_odo: Floats) -> Floats:
    """The registration's pose, moved along its weak directions to where another pose has it."""
    xi = se3.log(se3.compose(se3.inverse(found.T_target_source), T_odo))
    scale = np.repeat([found.lever_m, 1.0], 3)
    along = np.linalg.qr(found.weak.T)[0]
    return se3.compose(found.T_target_source, se3.exp(along @ (along.T @ (xi * scale)) / scale))


def _where_less_is_open(
    found: Registration, own: Surface, there: Surface, bend: Floats, T_S_odo: tuple[Floats, Floats], config: SlamConfig
) -> Registration:
    """Another pose along what the surfaces leave open, where they leave less open and fit better, or as much and fit far better.

    Along a street the ends of its houses tell where one is. Laid two metres beside them, none of their points finds the plane it
    belongs to, and what they would tell seems open: the query then lies wherever the odometry has put it.
    """
    tolerance = _TOLERANCE * max(found.rms, _RMS_FLOOR)
    best, fitting = found, -1.0
    for shift in _shifts(found.T_target_source, own, there, T_S_odo, config):
        other = register(own, there, _shifted(found.T_target_source, shift), config.registration, bend)
        if other is None or len(other.weak) > len(found.weak) or not _is_open(found, other.T_target_source):
            continue
        if fitting < 0.0:
            fitting = fitting_share(own, there, found.T_target_source, tolerance, config.registration)
        share = fitting_share(own, there, other.T_target_source, tolerance, config.registration)
        if share * (1.0 if len(other.weak) < len(best.weak) else config.rival_fit) > fitting:
            best, fitting = other, share
    return best


def _shifts(T: Floats, own: Surface, there: Surface, T_S_odo: tuple[Floats, Floats], config: SlamConfig) -> Floats:
    """(k, 2) by which the query may lie elsewhere in the place's x and y, as both look from above."""
    T_odo, S_odo = T_S_odo
    R = quaternion.to_matrix(T_odo[:4])
    S = config.odometry_scale**2 * (R @ S_odo[3:, 3:] @ R.T)[:2, :2] + 1e-6 * np.eye(2)
    return rival_shifts(
        own.points,
        there.points,
        T,
        cell=config.descriptor.cell,
        least=config.rival_distance,
        sigma=4.0 * S,  # the loop itself may be as far from the odometry as its rival, on the other side
        share=_RIVAL_AGREEMENT,
        count=_RIVALS,
    )


def _shifted(T: Floats, shift: Floats) -> Floats:
    moved = T.copy()
    moved[4:6] += shift
    return moved


def _deformation(query: LocalMap, place: LocalMap, T_place_query: Floats) -> Floats:
    """(6, 6) of how two maps are bent by the drift while they were made, on the right of T_place_query.

    A random walk about the middle of a stretch of length L, averaged over it, has a twelfth of the variance that it has over L,
    which is the covariance from the middle of one map to that of the next (docs/slam.md).
    """
    Ad = se3.adjoint(se3.inverse(T_place_query))
    # The first map has none before it; the other one stands for it.
    Q, P = query.covariance, place.covariance if place.number else query.covariance
    return (Q + Ad @ P @ Ad.T) / 12.0


def _far_off(loop: Loop, odometry: RelativePoses, config: SlamConfig) -> str | None:
    """Whether no registration could bring the motion of the density images to where the odometry says one is."""
    T_odo, S_odo = odometry.between(loop.place, loop.query)
    xi = se3.log(se3.compose(se3.inverse(loop.T_start), T_odo))
    S = config.odometry_scale**2 * S_odo + np.diag(np.repeat([_BASIN_ROTATION**2, _BASIN_POSITION**2], 3))
    far, limit = mahalanobis(xi, S), math.sqrt(chi_square_quantile(config.innovation, 6))
    if far <= limit:
        return None
    metres = float(np.linalg.norm(loop.T_start[4:] - T_odo[4:]))
    sigmas = f"{far:.0f} standard deviations, {limit:.1f} at most"
    return f"looks alike, but {metres:.0f} m from where the odometry puts it; that is {sigmas}"


def _innovation(loop: Loop, found: Registration, odometry: RelativePoses, config: SlamConfig) -> tuple[float, float]:
    T_odo, S_odo = odometry.between(loop.place, loop.query)
    xi = se3.log(se3.compose(se3.inverse(found.T_target_source), T_odo))
    # Along what was not measured, the registration stayed where it began; the covariance says so, and nothing is asked there.
    S = config.odometry_scale**2 * S_odo + found.covariance
    limit = math.sqrt(chi_square_quantile(config.innovation, max(loop.measured, 1)))
    return mahalanobis(xi, S), limit


def _refusal(
    loop: Loop, found: Registration, own: Surface, there: Surface, odometry: RelativePoses, config: SlamConfig
) -> str | None:
    if loop.measured < config.least_measured:
        return f"the surfaces determine {loop.measured} of 6 directions only"
    if min(loop.overlap) < config.least_overlap:
        shares = " and ".join(f"{100.0 * share:.0f} %" for share in loop.overlap)
        return f"the maps overlap too little: {shares} of their points, {100.0 * config.least_overlap:.0f} % asked for"
    bound = config.largest_rms * max(loop.rms_odometry, _RMS_FLOOR)
    if loop.rms > bound:
        return f"surfaces lie {100.0 * loop.rms:.1f} cm apart, more than the {100.0 * bound:.1f} cm that the odometry explains"
    if loop.innovation > loop.innovation_limit:
        return f"{loop.innovation:.1f} standard deviations from the odometry; true loops stay below {loop.innovation_limit:.1f}"
    if rival := _rival(loop, found, own, there, odometry, config):
        return rival
    return None


def _rival(
    loop: Loop, found: Registration, own: Surface, there: Surface, odometry: RelativePoses, config: SlamConfig
) -> str | None:
    """A sentence on another place of the same two maps that fits as well, and that the odometry does not exclude."""
    T_odo, S_odo = odometry.between(loop.place, loop.query)
    T = found.T_target_source
    shifts = _shifts(T, own, there, (T_odo, S_odo), config)
    tolerance = _TOLERANCE * max(found.rms, _RMS_FLOOR)
    fitting = fitting_share(own, there, T, tolerance, config.registration) if len(shifts) else 0.0
    for shift in shifts:
        other = register(own, there, _shifted(T, shift), config.registration)
        if other is None:
            continue
        if fitting_share(own, there, other.T_target_source, tolerance, config.registration) < config.rival_fit * fitting:
            continue
        moved = np.linalg.norm(other.T_target_source[4:] - T[4:])
        if moved < _SAME_MINIMUM or _is_open(found, other.T_target_source):
            continue
        # What leaves open how far it is to where more is measured has found nothing there that could tell: no place of its own.
        if len(other.weak) > len(found.weak) and _is_open(other, T):
            continue
        xi = se3.log(se3.compose(se3.inverse(other.T_target_source), T_odo))
        if mahalanobis(xi, config.odometry_scale**2 * S_odo + other.covariance) <= loop.innovation_limit:
            return f"the maps fit as well {moved:.1f} m away, and the odometry cannot tell which"
    return None


def _is_open(found: Registration, T_other: Floats) -> bool:
    """Whether another pose differs along what the surfaces leave open only."""
    if not len(found.weak):
        return False
    xi = se3.log(se3.compose(se3.inverse(found.T_target_source), T_other)) * np.repeat([found.lever_m, 1.0], 3)
    along = np.linalg.qr(found.weak.T)[0]
    return bool(np.linalg.norm(xi - along @ (along.T @ xi)) < _SAME_MINIMUM)
