"""A map laid onto the Earth, or a sentence that says why it was not. Derivation: docs/gnss.md."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.errors import SingularProblemError
from boxplus.manifolds import quaternion, se3
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.systems.georeference.attachment import AttachedFixes, attach
from boxplus.systems.georeference.config import GeoreferenceConfig
from boxplus.systems.georeference.doubts import NOISY, contradiction_of, doubts_of, gated_stretches, of_gated
from boxplus.systems.georeference.fit import Fit, antennas, fit, level
from boxplus.systems.georeference.heights import climb_of
from boxplus.systems.georeference.hypotheses import other_clock, other_readings
from boxplus.systems.georeference.jump import jump_of
from boxplus.systems.georeference.plateau import plateau_of
from boxplus.systems.georeference.slide import Unshown, slide_of, unshown_of
from boxplus.systems.georeference.start import Start, extent_of, find_start
from boxplus.systems.slam.graph import MapGraph, mean_up

Floats = NDArray[np.float64]

_FEWEST = 5
_SIGMAS = 3.0
_NOISIEST = 10.0  # [m] what successive fixes disagree by beyond this is no noise
_SHORT = 10.0  # times the noise of a fix: less than this of a way tells no heading
_WIDEST = 0.3  # of the extent, the tolerance of a fix at most: with more, anything fits
_LEAST_SHARE = 0.5
_EXPLAINS = 0.8  # of the fixes, for a mistake to be named
_STRETCHED = 0.1  # a path of another scale than this is another path
_OTHER_ANTENNA = 5.0  # standard deviations of an estimated lever arm, by which the given one is another
_QUIETER = 0.5  # of the scatter of the fixes, what another antenna leaves of it at most


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """What positions by satellite came to.

    Attributes:
        refusal: why the map is not laid onto the Earth; None where it is. Then, and only then, there are:
        frame: east, north and up at its origin; fit: T_enu_map with covariance, the maps' poses, lever arm, delay.
        attached: the fixes that were compared with the odometry.
        left_out: fixes that are not used, by reason.
        stretches: of fixes that fit nothing, (begin [s] since the first fix, duration [s], metres) each.
        warnings: what to doubt about it, one sentence each.
        contradiction: why it is not to be trusted, as the fixes contradict themselves; None where they do not.
        unshown: how far fixes may slide or turn without a word.
    """

    refusal: str | None
    frame: EnuFrame | None
    fit: Fit | None
    attached: AttachedFixes
    left_out: dict[str, int]
    stretches: list[tuple[float, float, float]]
    warnings: list[str]
    contradiction: str | None = None
    unshown: Unshown | None = None

    @property
    def used(self) -> int:
        """Fixes the result rests on."""
        return 0 if self.fit is None else int(self.fit.is_used.sum())


class _Refused(Exception):
    """Why there is no georeference; it never leaves this file."""


def georeference(
    graph: MapGraph,
    fixes: GnssFixes,
    time_ns: NDArray[np.int64],
    T_odo_imu: Floats,
    config: GeoreferenceConfig | None = None,
    p_imu_antenna: Floats | None = None,
) -> Georeference:
    """Lay local maps onto the Earth.

    Args:
        graph: local maps of an odometry, loops closed or not.
        fixes: of the receiver.
        time_ns: (K,) ascending, T_odo_imu: (K, 7) all poses of the odometry.
        config: settings; each has a default.
        p_imu_antenna: (3,) lever arm where the recording tells it; that of the settings goes first.

    Example: docs/gnss.md.
    """
    config = as_settings(GeoreferenceConfig, config)
    lever = p_imu_antenna if config.lever_arm is None else np.array(config.lever_arm)
    attached = attach(fixes, graph, time_ns, T_odo_imu, config)
    none = Georeference(None, None, None, attached, dict(attached.left_out), [], [])
    try:
        drift = _drift(graph)
        start, frame, warnings = _start(graph, attached, lever, drift[0], config)
        return _judged(graph, attached, frame, start, lever, drift[1], warnings, config)
    except _Refused as refused:
        return replace(none, refusal=str(refused))
    except SingularProblemError as error:
        return replace(none, refusal=f"the fixes do not determine where the map lies: {error}")


def _start(
    graph: MapGraph, attached: AttachedFixes, lever: Floats | None, drift: Floats, config: GeoreferenceConfig
) -> tuple[Start, EnuFrame, list[str]]:
    if len(attached) < _FEWEST:
        reasons = ", ".join(f"{count} {reason}" for reason, count in attached.left_out.items()) or "there are no others"
        raise _Refused(f"{len(attached)} fixes can be used; left out: {reasons}")
    frame = attached.frame
    p_enu = frame.to_enu(attached.lat_lon_alt)
    p_level = antennas(graph, attached, lever) @ level(graph.T_odo).T
    extent, stated = extent_of(p_level), float(np.median(attached.sigma))
    sigma = max(stated, min(_scatter(p_level, p_enu), _NOISIEST))
    if extent < _SHORT * sigma:
        raise _Refused(
            f"the antenna went {extent:.1f} m away while a fix is known to {sigma:.1f} m: the heading of the map is not "
            "determined; record a longer way"
        )
    allowed = (_SIGMAS * attached.sigma * sigma / stated) ** 2 + (_SIGMAS * drift[attached.map_of]) ** 2
    allowed += (_SIGMAS * attached.drift) ** 2
    speed = np.linalg.norm(attached.v_map, axis=1)
    allowed += (2.0 * config.delay_sigma * speed) ** 2
    allowed += 0.0 if lever is not None else (2.0 * config.lever_sigma) ** 2
    tolerance = np.minimum(np.sqrt(allowed), _WIDEST * extent)
    start = find_start(p_level, p_enu, tolerance)
    better, fits_swapped = other_readings(attached.lat_lon_alt, p_level, tolerance, start)
    if better is not None and better.start.share >= _EXPLAINS:
        share = 0.0 if start is None else start.share
        raise _Refused(
            f"{better.name}: read so, {100 * better.start.share:.0f} % of the fixes lie on the path of the odometry, as they are "
            f"{100 * share:.0f} %; correct the recording"
        )
    if start is None or start.share < _LEAST_SHARE or better is not None:
        lag = other_clock(attached.time_ns, p_level, p_enu, tolerance, start)
        if lag is not None and lag.start.share >= _EXPLAINS:
            raise _Refused(
                f"the clock of the receiver is another one: {100 * lag.start.share:.0f} % of the fixes follow the odometry "
                f"when {lag.offset_s:+.2f} s are added to their times; correct the stamps, or set "
                f"gnss.time_offset_s={config.time_offset_s + lag.offset_s:.2f}"
            )
        share = 0.0 if start is None else start.share
        raise _Refused(
            f"the fixes do not follow the odometry's path: at best {100 * share:.0f} % of them lie within "
            f"{np.median(tolerance):.1f} m of it, and fixes far apart lie {_ratio(p_level, p_enu):.3f} times as far as "
            "by the odometry; another datum, "
            "another unit, another vehicle, or the odometry is wrong"
        )
    if abs(start.scale - 1.0) > _STRETCHED:
        raise _Refused(
            f"the path of the fixes is {start.scale:.3f} times as large as the odometry's: another datum or "
            "unit, another vehicle, or a way too short for their noise"
        )
    warnings = []
    if fits_swapped:
        warnings.append(
            f"the path is too straight or too short to tell whether latitude and longitude are swapped: is "
            f"{frame.latitude:.4f}°, {frame.longitude:.4f}° the right place?"
        )
    return start, frame, warnings


def _judged(
    graph: MapGraph,
    attached: AttachedFixes,
    frame: EnuFrame,
    start: Start,
    lever: Floats | None,
    height_drift: Floats,
    warnings: list[str],
    config: GeoreferenceConfig,
) -> Georeference:
    turn = quaternion.from_matrix(level(graph.T_odo))
    T_enu_map = se3.compose(
        [math.cos(0.5 * start.yaw), 0.0, 0.0, math.sin(0.5 * start.yaw), *start.shift], [*turn, 0.0, 0.0, 0.0]
    )
    p_enu = frame.to_enu(attached.lat_lon_alt)
    found = fit(graph, attached, p_enu, T_enu_map, start.inliers, lever, config)
    share = 1.0 - float(found.is_used.mean())
    stretches = gated_stretches(attached, found)
    if share > config.most_gated:
        longest = max(stretches, key=lambda stretch: stretch[1])
        raise _Refused(
            f"{100 * share:.0f} % of the fixes contradict the others and the odometry (for {longest[1]:.0f} s they lie "
            f"{longest[2]:.1f} m off): nobody knows which are true; multipath, a datum that changes, or a wrong odometry"
        )
    yaw_sigma = math.sqrt(float(found.covariance[2, 2]))
    if yaw_sigma > config.largest_yaw_sigma:
        raise _Refused(
            f"the heading of the map is known to {math.degrees(yaw_sigma):.1f}° only, more than the "
            f"{math.degrees(config.largest_yaw_sigma):.1f}° of gnss.largest_yaw_sigma: record a longer way"
        )
    used = found.is_used
    doubts = [
        _heights(graph, attached, p_enu, lever, height_drift, found, config),
        _other_antenna(graph, attached, p_enu, T_enu_map, start, found, lever, config),
    ]
    warnings = warnings + [text for text in doubts if text is not None]
    jump = jump_of(attached, found, lambda after: fit(graph, attached, p_enu, found.T_enu_map, used, lever, config, after))
    plateau = plateau_of(attached, found)
    # Where fixes jump, a slide explains the same worse.
    slide = slide_of(attached, found.shifts) if jump is None and plateau is None else None
    left_out = Counter(attached.left_out) + of_gated(attached, found)
    return Georeference(
        refusal=None,
        frame=frame,
        fit=found,
        attached=attached,
        left_out=dict(left_out),
        stretches=stretches,
        warnings=warnings + doubts_of(attached, found, lever is not None, stretches, jump, plateau, slide, config),
        contradiction=contradiction_of(jump, plateau, found),
        unshown=unshown_of(attached, found.shifts),
    )


def _heights(
    graph: MapGraph,
    attached: AttachedFixes,
    p_enu: Floats,
    lever: Floats | None,
    drift: Floats,
    found: Fit,
    config: GeoreferenceConfig,
) -> str | None:
    """What is wrong with the heights of the fixes."""
    p_level = antennas(graph, attached, lever) @ level(graph.T_odo).T
    seconds = float(attached.time_ns[-1] - attached.time_ns[0]) * 1e-9
    off = np.linalg.norm(found.errors[found.is_used, :2], axis=1) / (math.sqrt(2.0) * attached.sigma[found.is_used])
    noise = float(np.median(np.sqrt(attached.covariance[:, 2, 2]))) * max(1.0, float(np.sqrt((off**2).mean())))
    climb = climb_of(p_level, p_enu[:, 2], drift[attached.map_of], noise, seconds, config.correlation)
    return None if climb is None else climb.doubt


def _other_antenna(
    graph: MapGraph,
    attached: AttachedFixes,
    p_enu: Floats,
    T_enu_map: Floats,
    start: Start,
    found: Fit,
    lever: Floats | None,
    config: GeoreferenceConfig,
) -> str | None:
    """Whether fixes that scatter with the lever arm that was given follow the path of an antenna elsewhere."""
    if lever is None or found.noise_scale <= NOISY:
        return None
    free = fit(graph, attached, p_enu, T_enu_map, start.inliers, None, config)
    off = np.abs(free.lever - lever)[:2] > _OTHER_ANTENNA * free.lever_sigma[:2]
    if not off.any() or free.noise_scale > _QUIETER * found.noise_scale:
        return None
    given, fitting = (f"({arm[0]:.2f}, {arm[1]:.2f}) m" for arm in (lever, free.lever))
    return (
        f"the lever arm is wrong: its x and y are given as {given}, and the fixes follow an antenna at {fitting} in the IMU "
        f"frame, from which they scatter {free.noise_scale:.1f} times as much as they claim, not {found.noise_scale:.1f}; look "
        "at its sign and its frame, or leave it out to have it estimated"
    )


def _scatter(p_level: Floats, p_enu: Floats) -> float:
    """Noise of a fix that does not last [m], from the lengths of successive steps: both have the same but for it."""
    a, b = (np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1) for p in (p_level, p_enu))
    return 1.4826 * float(np.median(np.abs(a - b))) / math.sqrt(2.0)


def _drift(graph: MapGraph) -> tuple[Floats, Floats]:
    """(n,) standard deviations of each map's position and height against the middle one, by the odometry alone [m]."""
    middle = len(graph.T_odo) // 2
    sigma, of_height = np.zeros(len(graph.T_odo)), np.zeros(len(graph.T_odo))
    up = np.swapaxes(quaternion.to_matrix(graph.T_odo[:, :4]), 1, 2) @ mean_up(graph.T_odo)
    for order in (range(middle + 1, len(sigma)), range(middle, 0, -1)):
        P = np.zeros((6, 6))
        for k in order:
            if order.step > 0:
                Z, own, to = se3.compose(se3.inverse(graph.T_odo[k - 1]), graph.T_odo[k]), graph.covariances[k], k
            else:
                Z, to = se3.compose(se3.inverse(graph.T_odo[k]), graph.T_odo[k - 1]), k - 1
                back = se3.adjoint(se3.inverse(Z))  # an error on the right of T is that of its inverse, by the adjoint
                own = back @ graph.covariances[k] @ back.T
            Ad = se3.adjoint(se3.inverse(Z))
            P = Ad @ P @ Ad.T + own
            sigma[to] = math.sqrt(max(float(np.linalg.eigvalsh(P[3:, 3:])[-1]), 0.0))
            of_height[to] = math.sqrt(max(float(up[to] @ P[3:, 3:] @ up[to]), 0.0))
    return sigma, of_height


def _ratio(p_level: Floats, p_enu: Floats) -> float:
    """Distances between fixes far apart, by the receiver over by the odometry; the median."""
    half = len(p_level) // 2
    a, b = (np.linalg.norm(p[half:, :2] - p[: len(p) - half, :2], axis=1) for p in (p_level, p_enu))
    far = a > 0.3 * extent_of(p_level)
    return float(np.median(b[far] / a[far])) if far.any() else float("nan")
