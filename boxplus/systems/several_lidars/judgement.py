"""What a fit of one LiDAR to another says about its declared pose and its clock, in sentences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.several_lidars.motion import LidarMotion
from boxplus.systems.several_lidars.pair import PairFit, fit_pair
from boxplus.systems.several_lidars.readings import other_reading
from boxplus.systems.several_lidars.surfaces import Surfaces

Verdict = Literal["agree", "contradicted", "unverified"]
Cause = Literal["", "pose", "inverted", "clock", "pose or clock", "pose and clock", "unit", "the same"]

_FLOOR = np.array([np.radians(0.2)] * 3 + [0.02] * 3 + [0.003])
"""Beside the covariance of a fit: what the surfaces and the first LiDAR's own path leave in error (rad, m, s)."""
_CONTRADICTED = 5.0  # standard deviations, floor included
_SHOWN = np.array([np.radians(2.0)] * 3 + [0.3] * 3 + [0.008])
"""A standard deviation below which a component counts as checked (rad, m, s)."""
_LEAST_NEAR, _LEAST_FITTING, _GOOD_FITTING = 0.1, 0.6, 0.85
_OFFSETS_S = (0.25, -0.25, 0.5, -0.5)


@dataclass(frozen=True, slots=True)
class PairJudgement:
    """A verdict about one LiDAR against the first one.

    Attributes:
        verdict: "agree"; "contradicted"; "unverified": they did not see the same surfaces, or the motion shows nothing.
        cause: what is wrong, where it is contradicted.
        text: a sentence with the numbers, without the LiDAR's name.
        rotation_deg, translation_m, time_offset_s: found, from what is declared; None where nothing could be fitted.
        sigma_deg, sigma_m, sigma_s: their standard deviations, of the worst axis.
        T_first_other: (4, 4) as found.
        unshown: of an agreement, what motion and scene do not show: "position", "clock".
    """

    verdict: Verdict
    cause: Cause
    text: str
    rotation_deg: float | None = None
    translation_m: float | None = None
    time_offset_s: float | None = None
    sigma_deg: float | None = None
    sigma_m: float | None = None
    sigma_s: float | None = None
    T_first_other: NDArray[np.float64] | None = None
    unshown: tuple[str, ...] = ()


def judge_pair(
    motion: LidarMotion,
    surfaces: Surfaces,
    p_other: NDArray[np.float64],
    time_ns: NDArray[np.int64],
    T_declared: NDArray[np.float64],
) -> PairJudgement:
    """Fit and judge; arguments as of `fit_pair`. Where what is declared leads nowhere, its inverse and other clocks are tried,
    then other readings of its points.
    """

    def fit(T: NDArray[np.float64], offset_s: float = 0.0) -> PairFit | None:
        return fit_pair(motion, surfaces, p_other, time_ns, T_declared, T, offset_s)

    inverse = np.asarray(np.linalg.inv(T_declared), np.float64)
    best, cause = fit(T_declared), "declared"
    if best is None or best.fitting < _GOOD_FITTING:
        tries: list[tuple[str, Callable[[], PairFit | None]]] = [("inverted", lambda: fit(inverse))]
        tries += [("declared", lambda offset_s=offset_s: fit(T_declared, offset_s)) for offset_s in _OFFSETS_S]  # type: ignore[misc]
        for name, attempt in tries:
            other = attempt()
            if other is not None and (best is None or _score(other) > _score(best)):
                best, cause = other, name
            if best is not None and best.fitting >= _GOOD_FITTING:
                break
    judgement = PairJudgement("unverified", "", "hardly any of its points lie near a surface that the first LiDAR saw meanwhile")
    is_near = best is not None and best.near >= _LEAST_NEAR
    if best is not None and is_near:
        judgement = _judged(best, inverted=cause == "inverted")
        if judgement.verdict != "contradicted" or best.fitting >= _GOOD_FITTING:
            return judgement
    read = other_reading(motion, surfaces, p_other, time_ns, T_declared, _SHOWN)
    if read is None or (best is not None and _score(best) >= _score(read[1])):
        return judgement
    reading, found = read
    nowhere = judgement.text if not is_near else "its points lie beside the surfaces that the first LiDAR saw"
    text = f"{nowhere}, but {found.near:.0%} of them lie near one (and {found.fitting:.0%} of these on it) {reading.text}"
    return PairJudgement(
        "contradicted", reading.cause, text, T_first_other=found.T_first_other if reading.cause == "pose" else None
    )


def _score(fit: PairFit) -> float:
    return fit.fitting * min(fit.near, 0.5)


def _judged(fit: PairFit, *, inverted: bool) -> PairJudgement:
    d, C = fit.difference, fit.covariance
    total = C + np.diag(_FLOOR**2)
    size = np.sqrt(np.array([part @ part for part in (d[:3], d[3:6], d[6:])]))
    sigma = [float(np.sqrt(np.linalg.eigvalsh(C[part, part])[-1])) for part in (slice(0, 3), slice(3, 6), slice(6, 7))]
    numbers = (
        f"turned by {np.degrees(size[0]):.2f} ± {np.degrees(sigma[0]):.2f} deg, moved by {size[1]:.3f} ± {sigma[1]:.3f} m, "
        f"its times {d[6] * 1e3:+.1f} ± {sigma[2] * 1e3:.1f} ms, {fit.fitting:.0%} of the points near surfaces on them"
    )

    def judgement(verdict: Verdict, cause: Cause, text: str) -> PairJudgement:
        return PairJudgement(
            verdict,
            cause,
            text,
            float(np.degrees(size[0])),
            float(size[1]),
            float(d[6]),
            float(np.degrees(sigma[0])),
            sigma[1],
            sigma[2],
            fit.T_first_other,
        )

    if _deviations(d, total) > _CONTRADICTED:
        return judgement("contradicted", *_named(d, total, numbers, inverted=inverted))
    if fit.fitting < _LEAST_FITTING:
        text = f"its points lie beside the surfaces that the first LiDAR saw: they fit best {numbers}"
        return judgement("contradicted", "pose or clock", f"{text}; T_lidar_other or its clock is wrong, by far")
    shown = np.sqrt(np.diag(C)) < _SHOWN
    if not shown[:3].all():
        return judgement("unverified", "", f"the surfaces both saw do not show how it lies: they fit {numbers}")
    unshown = tuple(name for name, part in (("position", shown[3:6]), ("clock", shown[6:])) if not part.all())
    doubt = f"; its {' and '.join(unshown)} could not be checked: the motion or the scene does not show it" if unshown else ""
    agreed = judgement("agree", "", f"its points fit what the first LiDAR saw where declared ({numbers}){doubt}")
    return replace(agreed, unshown=unshown)


def _named(d: NDArray[np.float64], C: NDArray[np.float64], numbers: str, *, inverted: bool) -> tuple[Cause, str]:
    """Which part of the difference the fit cannot do without: pose, clock, both or either."""
    fits = f"its points fit what the first LiDAR saw {numbers}"
    if inverted:
        return "inverted", f"{fits}, near the inverse of T_lidar_other: it is inverted, or the topics are swapped"
    pose, clock = _deviations(d[:6], C[:6, :6]) > _CONTRADICTED, _deviations(d[6:], C[6:, 6:]) > _CONTRADICTED
    give = f"time_offset_s of {d[6]:+.3f} s more"
    if pose and clock:
        return "pose and clock", f"{fits}: T_lidar_other is wrong, or its clock is far off"
    if clock:
        return "clock", f"{fits}: its clock is wrong; synchronise it, or give a {give}"
    if pose:
        return "pose", f"{fits}: T_lidar_other is wrong"
    return "pose or clock", f"{fits}: T_lidar_other or its clock is wrong; the motion does not tell which"


def _deviations(d: NDArray[np.float64], C: NDArray[np.float64]) -> float:
    return float(np.sqrt(d @ np.linalg.solve(C, d)))
