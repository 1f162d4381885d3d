"""What speaks against a georeference that was found: fixes that fit nothing, clocks, lever arm, an odometry that is bent."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from boxplus.manifolds import quaternion
from boxplus.systems.georeference.attachment import AttachedFixes
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.fit import Fit
from boxplus.systems.georeference.heights import height_jump
from boxplus.systems.georeference.jump import Jump
from boxplus.systems.georeference.plateau import Plateau
from boxplus.systems.georeference.slide import Slide

_MANY_GATED = 0.15
_LONG = 0.1  # of all fixes, a stretch of gated ones that is more than multipath
_LASTING = 30.0  # [s]
_SIGMAS = 3.0
_LEAST_DELAY = 0.03
_ADDED = 0.85  # of the standard deviation that a delay had before, below which fixes have added something to it
NOISY = 1.5
_APART = 1.0  # [s] of two clocks, that fixes show at three standard deviations or not at all
_ONE_CLOCK = 0.01  # [s] beforehand: somebody has said that they are not
_FAST = 0.3  # [m/s] of a steady way, below which that moves a map by less than fixes are known to
_BENT = 4.0  # mean square of the odometry's errors, where 1 is what its covariance allows


def gated_stretches(attached: AttachedFixes, found: Fit) -> list[tuple[float, float, float]]:
    """(begin since the first fix [s], duration [s], median distance [m]) of stretches of fixes that are not used."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    distance = np.linalg.norm(found.errors, axis=1)
    return [(float(seconds[a]), float(seconds[b - 1] - seconds[a]), float(np.median(distance[a:b]))) for a, b in found.gated]


def of_gated(attached: AttachedFixes, found: Fit) -> Counter[str]:
    """Gated fixes by what they look like."""
    counts: Counter[str] = Counter()
    for a, b in found.gated:
        counts["off for a stretch (multipath)" if b - a > 2 else "off alone"] += b - a
    return counts


def contradiction_of(jump: Jump | None, plateau: Plateau | None, found: Fit) -> str | None:
    """Why the result is not to be trusted: it lies between two datums, or in one of them."""
    said = [_of_jump(jump)] if jump is not None and jump.contradicts(found) else []
    if plateau is not None and not plateau.is_short:
        said.append(f"{_of_plateau(plateau)}; nobody knows which is right")
    return "; ".join(said) or None


def _of_plateau(plateau: Plateau) -> str:
    return (
        f"fixes lie {plateau.metres:.1f} m off for {plateau.duration:.0f} s from {plateau.begin:.0f} s on, all by the same and "
        "longer than multipath lasts: another datum or base station there, which is not used"
    )


def _of_jump(jump: Jump) -> str:
    what = (
        "another datum or base station from there on, or multipath too small to be told"
        if jump.lasts
        else "multipath that lasts to the begin or the end of the recording, or another datum or base station on one side"
    )
    return f"fixes jump by {jump.metres:.1f} m against the odometry at {jump.seconds:.0f} s: {what}; the map lies between the two"


def doubts_of(
    attached: AttachedFixes,
    found: Fit,
    has_lever: bool,
    stretches: list[tuple[float, float, float]],
    jump: Jump | None,
    plateau: Plateau | None,
    slide: Slide | None,
    config: GeoreferenceConfig,
) -> list[str]:
    """Sentences about what to doubt, beside what contradicts itself."""
    warnings = []
    if not has_lever:
        lever = ", ".join(f"{x:.2f}" for x in found.lever)
        warnings.append(
            f"the lever arm of the antenna is not known: estimated as {lever} m in the IMU frame, to "
            f"{float(np.max(found.lever_sigma[:2])):.2f} m on the ground; give --gnss-lever-arm"
        )
    if attached.hold is not None and attached.hold.lasts:
        warnings.append(attached.hold.text)
    delay, sigma = told_delay(found.delay, found.delay_sigma, config.delay_sigma)
    if abs(delay) > max(_SIGMAS * sigma, _LEAST_DELAY):
        late, allowed = "late" if found.delay > 0 else "early", abs(found.delay)
        warnings.append(
            f"fixes seem to be stamped {abs(delay):.2f} s {late} (± {sigma:.2f} s), of which {allowed:.2f} s were allowed for; "
            f"correct the stamps, or set gnss.time_offset_s={config.time_offset_s - delay:.2f}"
            f"{_or_lever(attached, found, delay, sigma)}"
        )
    speed = steady_speed(attached, found, config)
    if speed > _FAST:
        warnings.append(
            "the way is too straight and too steady to tell whether the clocks of receiver and odometry are apart: each second "
            f"of it moves the map by {speed:.1f} m along the way, and {config.delay_sigma:.2g} s are allowed for; where they are "
            f"one, set gnss.delay_sigma={_ONE_CLOCK}"
        )
    share = 1.0 - float(found.is_used.mean())
    if share > _MANY_GATED:
        warnings.append(f"{100 * share:.0f} % of the fixes contradict the others and are not used")
    total = (attached.time_ns[-1] - attached.time_ns[0]) * 1e-9
    for begin, duration, metres in stretches:
        is_told = plateau is not None and plateau.begin <= begin <= plateau.begin + plateau.duration
        if duration > max(_LONG * total, _LASTING) and not is_told:
            warnings.append(
                f"fixes lie {metres:.1f} m off for {duration:.0f} s from {begin:.0f} s on, longer than multipath lasts: "
                "another datum or base station, or the odometry is wrong there"
            )
    if plateau is not None and plateau.is_short:
        warnings.append(_of_plateau(plateau))
    if jump is not None and not jump.contradicts(found):
        warnings.append(_of_jump(jump))
    if slide is not None:
        warnings.append(slide.text)
    if found.noise_scale > NOISY:
        warnings.append(
            f"fixes scatter {found.noise_scale:.1f} times as much as they claim, or the odometry does between two local maps; "
            "they are believed that much less"
        )
    if found.height_scale > 1.0:
        warnings.append(
            f"heights of the fixes scatter {found.height_scale * found.noise_scale:.1f} times as much as they claim, and the "
            f"places {found.noise_scale:.1f} times: heights are believed that much less{_where_heights_jump(attached, found)}"
        )
    if found.tension > _BENT:
        warnings.append(
            f"fixes bend the odometry {math.sqrt(found.tension):.1f} times as much as its covariance allows: it drifts more than "
            "claimed, or the fixes have another scale or datum"
        )
    return warnings


def _where_heights_jump(attached: AttachedFixes, found: Fit) -> str:
    """Where another reference of heights begins, which is nothing of the places."""
    seconds = (attached.time_ns - attached.time_ns[0]) * 1e-9
    jump = height_jump(-found.errors[:, 2])
    if jump is None:
        return ""
    at, metres = jump
    return (
        f"; they jump by {metres:+.1f} m at {seconds[at]:.0f} s: another reference of heights from there on (the sea in place of "
        "the ellipsoid), or another base station"
    )


def steady_speed(attached: AttachedFixes, found: Fit, config: GeoreferenceConfig) -> float:
    """By how much a second of a clock that is apart moves the map unseen [m]; zero where the fixes show it, or may.

    A delay τ moves fixes by v τ, of which the mean over the way is a shift of the map, and only the rest can be seen.
    """
    of_fixes = 1.0 / found.delay_sigma**2 - 1.0 / config.delay_sigma**2
    if of_fixes * _APART**2 > _SIGMAS**2 or config.delay_sigma <= _ONE_CLOCK:
        return 0.0
    seconds = float(attached.time_ns[-1] - attached.time_ns[0]) * 1e-9
    p_enu = attached.frame.to_enu(attached.lat_lon_alt[[0, -1]])
    return float(np.linalg.norm(p_enu[1, :2] - p_enu[0, :2])) / max(seconds, 1e-9)


def told_delay(delay: float, sigma: float, before: float) -> tuple[float, float]:
    """What fixes say of their delay by themselves, and its standard deviation, of a fit that knew it to be 0 ± `before` [s].

    Information adds up: 1/σ² = 1/σ_told² + 1/σ_before², and delay/σ² = told/σ_told² + 0. A delay of the fit is drawn to zero, the
    more so the less fixes know it; stamps that are corrected by it stay late. Where they add hardly anything to what was known,
    the delay of the fit stays.
    """
    of_fixes = 1.0 / sigma**2 - 1.0 / before**2
    return (delay / (sigma**2 * of_fixes), 1.0 / math.sqrt(of_fixes)) if sigma < _ADDED * before else (delay, sigma)


def _or_lever(attached: AttachedFixes, found: Fit, delay: float, sigma: float) -> str:
    """A word on the antenna where it may explain a delay that fixes tell: a shift of it in the body's frame does at any speed.

    A delay is known by velocities, and beside an unknown antenna by what of them differs from their mean: its standard deviation
    grows by the ratio of the two.
    """
    used = found.is_used
    v_body = np.einsum("nba,nb->na", quaternion.to_matrix(attached.T_map_imu[used, :4]), attached.v_map[used])
    mean = v_body.mean(axis=0)
    size, varying = np.linalg.norm(v_body, axis=1), np.linalg.norm(v_body - mean, axis=1)
    told_by = math.sqrt(float((varying**2).sum()) / max(float((size**2).sum()), 1e-12))
    if abs(delay) * told_by > _SIGMAS * sigma:
        return ""
    where = "back" if delay > 0 else "ahead"
    metres = abs(delay) * float(np.linalg.norm(mean))
    return f"; an antenna {metres:.1f} m farther {where} than the lever arm says would look the same"
