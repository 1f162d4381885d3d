"""Which extrinsic a run begins with: given, recorded, or estimated from how gyroscope and LiDAR turn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import islice, takewhile
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.recordings.recording import Event, Recording, end_ns
from boxplus.runs.lidar_inertial.rehearsal import rehearse
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.finding import Cause, Finding
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions, judges_rotation
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import thinned
from boxplus.systems.lidar_inertial_agreement.translation import ARM
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

Source = Literal["given", "recording", "estimated", "identity", "none"]

_TURNING_RAD_S = 0.15
_ESTIMATE = 12.0, 120.0  # length of a stretch, and how far stretches are looked for [s]
_CHECK = 6.0, 20.0
_MOST_STRETCHES = 5  # that are looked at in vain
# A narrow view that loses hold once leaves nothing of a stretch: pieces of it, as begin and end in shares of its length.
_PIECES = (0.0, 0.5), (0.25, 0.75), (0.5, 1.0)
_FEWEST_SCANS = 15  # of a piece
_PARTLY = 0.4  # of the turns, that a mounting explains where it is tried again
_FAR_LESS = 0.3  # of what a mirror leaves unexplained, a mounting may leave
_NO_MOUNTING: frozenset[Cause] = frozenset({"gyro_unit", "gyro_sign", "not_together"})  # then none explains any stretch
_WIDE_DEG, _WIDE_M = 10.0, 0.3
_LEVER_EXPLAINED = 0.8
_LEVER_CAUTION, _LEVER_FLOOR_M = 2.0, 0.01
_MOST_SIGMAS = 4.0  # of the estimate, that a first run may leave it by
_LEAST_DEG = 0.3  # what the scans' own errors leave of the rotation
_MARGIN_NS = 100_000_000  # of samples about the scans of a piece
_NOBODY_SAYS = "neither --T-imu-lidar, the configuration nor the recording says how the LiDAR is mounted"
_REMEDY = "give --T-imu-lidar for the best result"
_UNIT_ADVICE = "give --gyro-unit"
_UNKNOWN = (
    "nobody gave T_imu_lidar, and the motion did not show it: {assumed}, and the path and its covariance are wrong by as much as "
    "the mounting is; give --T-imu-lidar (for axes that are parallel: --T-imu-lidar 'xyz_rpy_deg: X Y Z 0 0 0', X Y Z the "
    "LiDAR's place as seen from the IMU in metres; what is given is taken for exact), or turn the platform about all axes"
)
_MOST_POINTS = 20_000
"""Of a scan that is kept for the estimate; 12 s of scans stay below 50 MB."""


@dataclass(frozen=True, slots=True)
class Extrinsic:
    """The LiDAR's pose in the IMU frame at the start of a run, and why.

    Attributes:
        T_imu_lidar: (4, 4) float64: p_imu = T_imu_lidar p_lidar.
        source: "given" (option or configuration), "recording" (its static transforms), "estimated", "identity", or "none":
            there is no IMU.
        text: one sentence.
        refine: it is a guess, to be refined while running wherever the motion allows.
        warning: what the user should do about it; empty when it is given and nothing contradicts it.
        sigma: standard deviations of rotation [deg] and translation [m]; None leaves those of the configuration.
        contradiction: what the sensors contradict over the first seconds of rotation, whatever the mounting; sentences.
        unknown: what makes a result of it not to be trusted unless the motion bears the mounting out later: a sentence; empty
            where it is given, recorded, or was estimated about all axes.
        how: an estimate was found; empty where it is none.
    """

    T_imu_lidar: NDArray[np.float64]
    source: Source
    text: str
    refine: bool
    warning: str
    sigma: tuple[float, float] | None = None
    contradiction: str = ""
    unknown: str = ""
    how: str = ""

    def applied_to(self, config: LioConfig) -> LioConfig:
        """The configuration with this extrinsic; a guess is refined online unless the configuration decides."""
        if self.source == "none":
            return config
        changes: dict[str, object] = {"T_imu_lidar": tuple(map(tuple, self.T_imu_lidar.tolist()))}
        if self.refine and "extrinsic_estimation" not in config.model_fields_set:
            changes["extrinsic_estimation"] = "gated"
        if self.sigma is not None:
            changes["extrinsic_rotation_sigma_deg"], changes["extrinsic_translation_sigma"] = self.sigma
        return LioConfig.model_validate(config.model_dump() | changes)


def choose_extrinsic(recording: Recording, config: LioConfig, *, should_stop: Callable[[], bool] | None = None) -> Extrinsic:
    """The extrinsic from the configuration, else from the recording's static transforms, else estimated.

    Either way gyroscope, accelerometer and LiDAR are compared over the first seconds of rotation (`compare_sensors`): without a
    given extrinsic that comparison is the estimate of its rotation and translation, with their standard deviations, and goes on
    to later seconds where the first ones do not show it; with one, what it contradicts becomes a warning. What the motion does
    not determine stays at the identity and keeps a wide standard deviation. An estimate is then refined by a first run over the
    beginning (`rehearsal`).

    Args:
        recording: opened.
        config: of the odometry.
        should_stop: asked between comparisons and in that first run; True ends them, and what is known by then stands.

    Raises:
        RecordingError: nothing at all could be read.
        InputError: the LiDAR shows that the gyroscope is in another unit than it is read in.
    """
    if not recording.info.imu_topic:
        return Extrinsic(np.eye(4), "none", "no IMU takes part: poses are those of the LiDAR", False, "")
    known = _known_extrinsic(recording, config)
    should_stop = should_stop or (lambda: False)
    declared = None if known is None else known.T_imu_lidar
    compared = _compared(recording, config, declared, should_stop)
    if compared is not None:
        agreement, found = compared
        for finding in found:
            if finding.cause == "gyro_unit":
                raise InputError(
                    f"angular velocities in {recording.info.gyro_unit}, as they are read", finding.text, _UNIT_ADVICE
                )
        text = "; ".join(finding.text for finding in found)
        chosen = known if known is not None else _rehearsed(recording, config, _estimated(agreement), should_stop)
        return replace(chosen, warning="; ".join(filter(None, [text, chosen.warning])), contradiction=text)
    return known if known is not None else _estimated(None)


def _compared(
    recording: Recording, config: LioConfig, declared: NDArray[np.float64] | None, should_stop: Callable[[], bool]
) -> tuple[Agreement, list[Finding]] | None:
    """The sensors over the first stretch that turns; without a declared mounting over the first that shows all of its rotation.

    Where none does it is the one that shows most of it, or the first one. With it come what whole stretches contradict. None
    without scans and samples.
    """
    if declared is not None:
        for stretch in _turning_stretches(recording, *_CHECK):
            agreement = compare_sensors(*stretch, config, T_declared=declared)
            return agreement, contradictions(agreement, declared)
        return None
    best: Agreement | None = None
    found: list[Finding] = []
    for stretch in islice(_turning_stretches(recording, *_ESTIMATE), _MOST_STRETCHES):
        whole = compare_sensors(*stretch, config, refine=True)
        if not found and (best is None or np.isfinite(_open_rad(whole))):
            found = contradictions(whole, None)
        best = _better(best, whole)
        is_vain = any(finding.cause in _NO_MOUNTING for finding in found)
        if not is_vain and not np.isfinite(_open_rad(whole)):
            pieces = takewhile(lambda _: not should_stop(), _pieces_of(*stretch))
            parts = [compare_sensors(*piece, config, refine=True) for piece in pieces]
            begun = _partly_right([whole, *parts])
            if begun is not None and not should_stop():
                parts.append(compare_sensors(*stretch, config, T_expected=begun, refine=True))
            best = reduce(_better, filter(_is_no_mirror, parts), best)
        if is_vain or _open_rad(best) < np.radians(_WIDE_DEG) or should_stop():
            break
    return None if best is None else (best, found)


def _better(best: Agreement | None, other: Agreement) -> Agreement:
    return other if best is None or _open_rad(other) < _open_rad(best) else best


def _open_rad(agreement: Agreement) -> float:
    """Standard deviation of the mounting's rotation about the axis that is known worst; infinite where rotations tell nothing."""
    rotation = agreement.rotation
    return np.inf if rotation is None or not judges_rotation(agreement) else float(rotation.rotation_std[0][-1])


def _is_no_mirror(agreement: Agreement) -> bool:
    """Whether a mounting explains the turns far better than a mirror: few seconds, about two axes, show no flipped sign."""
    rotation = agreement.rotation
    return rotation is not None and 1.0 - rotation.explained < _FAR_LESS * (1.0 - rotation.mirrored)


def _partly_right(agreements: Sequence[Agreement]) -> NDArray[np.float64] | None:
    """(4, 4) T_imu_lidar of the one that explains most of the turns where none explains enough; None where a mirror does as well.

    Turns of 200 deg/s throw a registration off that nobody helps, and what is left of the path still shows the mounting coarsely:
    with it the gyroscope may help.
    """
    fits = [agreement.rotation for agreement in agreements if agreement.rotation is not None]
    best = max(fits, key=lambda fit: fit.explained, default=None)
    if best is None or any(np.isfinite(_open_rad(agreement)) and _is_no_mirror(agreement) for agreement in agreements):
        return None
    if best.explained < _PARTLY or best.mirrored > best.explained:
        return None
    T = np.eye(4)
    T[:3, :3] = best.R_imu_lidar
    return T


def _pieces_of(scans: list[Scan], imu: ImuSamples) -> Iterator[tuple[list[Scan], ImuSamples]]:
    """Pieces of a stretch."""
    first_ns, length_ns = scans[0].end_ns, scans[-1].end_ns - scans[0].end_ns
    for begin, end in _PIECES:
        piece = [scan for scan in scans if begin * length_ns <= scan.end_ns - first_ns <= end * length_ns]
        if len(piece) >= _FEWEST_SCANS:
            inside = (imu.time_ns > piece[0].start_ns - _MARGIN_NS) & (imu.time_ns < piece[-1].end_ns + _MARGIN_NS)
            yield piece, imu.where(inside)


def _known_extrinsic(recording: Recording, config: LioConfig) -> Extrinsic | None:
    if config.T_imu_lidar is not None:
        return Extrinsic(np.array(config.T_imu_lidar), "given", "T_imu_lidar as given", False, "")
    if recording.info.T_imu_lidar is not None:
        text = f"T_imu_lidar from {recording.info.T_imu_lidar_source or 'the recording'}"
        doubts = [entry.text for entry in recording.info.evidence if entry.key == "T_imu_lidar" and entry.verdict != "ok"]
        return Extrinsic(recording.info.T_imu_lidar, "recording", text, False, "; ".join(doubts))
    return None


def _estimated(agreement: Agreement | None) -> Extrinsic:
    """As far as the comparison determined it."""
    T, wide = np.eye(4), (_WIDE_DEG, _WIDE_M)
    rotation = None if agreement is None else agreement.rotation
    if agreement is None or rotation is None or not judges_rotation(agreement):
        why = "the platform does not turn enough at the beginning to estimate it, or the LiDAR sees too little"
        return Extrinsic(
            T,
            "identity",
            f"identity assumed: {_NOBODY_SAYS}; {why}",
            True,
            f"{_NOBODY_SAYS}: identity assumed; {why}; {_REMEDY}",
            wide,
            unknown=_UNKNOWN.format(assumed="the identity was assumed"),
        )
    T[:3, :3] = rotation.R_imu_lidar
    std_deg = np.degrees(rotation.rotation_std[0])
    translation = agreement.translation
    std_m = np.full(3, _WIDE_M)
    if translation is not None and translation.explained > _LEVER_EXPLAINED:
        T[:3, 3] = translation.p_imu_lidar
        # Neighbouring poses of the path share their errors, which the covariance does not know.
        std_m = np.minimum(_LEVER_CAUTION * np.sqrt(np.diag(translation.covariance)[ARM]) + _LEVER_FLOOR_M, _WIDE_M)
    open_axes = std_deg[-1] > _WIDE_DEG
    return _guessed(T, f"estimated over {rotation.intervals} scan pairs", std_deg, std_m, open_axes=open_axes)


def _guessed(
    T: NDArray[np.float64], how: str, std_deg: NDArray[np.float64], std_m: NDArray[np.float64], *, open_axes: bool
) -> Extrinsic:
    """An estimate, to be refined while running.

    Args:
        T: (4, 4) T_imu_lidar.
        how: it was found.
        std_deg, std_m: (3,) each, of rotation (ascending) and translation.
        open_axes: whether the motion has not turned about enough axes to show the rotation.
    """
    angle = np.degrees(np.linalg.norm(so3.log(T[:3, :3])))
    p, s_p = ", ".join(f"{value:.3f}" for value in T[:3, 3]), ", ".join(f"{value:.2f}" for value in std_m)
    s_R = ", ".join(f"{value:.1f}" for value in std_deg)
    text = f"{how}: {angle:.1f} deg from identity (std {s_R} deg about its principal axes), translation ({p}) m (std {s_p} m)"
    if open_axes:
        text += "; the motion turns about too few axes to determine the rest"
    sigma = (float(np.clip(std_deg[-1], _LEAST_DEG, _WIDE_DEG)), float(std_m.max()))
    unknown = _UNKNOWN.format(assumed="it was estimated about some axes only") if open_axes else ""
    return Extrinsic(T, "estimated", text, True, _warning(text), sigma, unknown=unknown, how=how)


def _warning(text: str) -> str:
    """What to do about an estimate, of which `text` tells."""
    return f"{_NOBODY_SAYS}: it was {text}, and is refined while running; {_REMEDY}"


def _rehearsed(recording: Recording, config: LioConfig, found: Extrinsic, should_stop: Callable[[], bool]) -> Extrinsic:
    """An estimate as a first run over the beginning of the recording refines it, where it can."""
    begun_with = found.applied_to(config)
    if found.source != "estimated" or found.unknown or found.sigma is None or begun_with.extrinsic_estimation == "off":
        return found
    rehearsal = rehearse(recording, begun_with, should_stop)
    if not isinstance(rehearsal, str):
        turned = np.degrees(np.linalg.norm(so3.log(found.T_imu_lidar[:3, :3].T @ rehearsal.T_imu_lidar[:3, :3])))
        moved = np.linalg.norm(rehearsal.T_imu_lidar[:3, 3] - found.T_imu_lidar[:3, 3])
        if turned > _MOST_SIGMAS * found.sigma[0] or moved > _MOST_SIGMAS * found.sigma[1]:
            rehearsal = f"it left the estimate by {turned:.1f} deg and {moved:.2f} m"
        elif rehearsal.std_m.max() > found.sigma[1]:
            rehearsal = "the motion showed nothing more of it"
    if isinstance(rehearsal, str):
        kept = f"{found.text}; a first run over the beginning made no more of it: {rehearsal}"
        return replace(found, text=kept, warning=_warning(kept))
    how = f"{found.how} and in a first run over {rehearsal.seconds:.0f} s"
    return _guessed(rehearsal.T_imu_lidar, how, rehearsal.std_deg, rehearsal.std_m, open_axes=False)


def _turning_stretches(events: Iterable[Event], length_s: float, search_s: float) -> Iterator[tuple[list[Scan], ImuSamples]]:
    """Scans and samples of the seconds in which the IMU turns, one stretch after the other, in bounded memory.

    Where it never turns, the last seconds that were looked at; nothing where there are not both.
    """
    scans: list[Scan] = []
    blocks: list[ImuSamples] = []
    first_ns = begin_ns = None
    none_yet = True
    for event in events:
        now_ns = end_ns(event)
        if now_ns is None:
            continue
        first_ns = now_ns if first_ns is None else first_ns
        if isinstance(event, ImuSamples):
            blocks.append(event)
            if begin_ns is None and np.nanmax(np.linalg.norm(event.gyro, axis=1), initial=0.0) > _TURNING_RAD_S:
                begin_ns = now_ns
        elif len(event):
            # Of several LiDARs the first alone: a wrong pose of another one must not look like a wrong one of the first.
            scans.append(thinned(event if event.lidar is None else event.of_lidar(0), _MOST_POINTS))
        if begin_ns is None:
            if now_ns - first_ns > search_s * 1e9:
                break
            # Keep what would be compared if it never turned.
            scans = [scan for scan in scans if scan.end_ns > now_ns - length_s * 0.5e9]
            blocks = [block for block in blocks if block.time_ns[-1] > now_ns - length_s * 0.5e9]
        elif now_ns - begin_ns > length_s * 1e9:
            if blocks and scans:
                yield scans, ImuSamples.joined(blocks)
                none_yet = False
            scans, blocks, begin_ns = [], [], None
    if blocks and scans and (none_yet or begin_ns is not None):
        yield scans, ImuSamples.joined(blocks)
