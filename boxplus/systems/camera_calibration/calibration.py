"""Cameras calibrated from a target: each alone, all together, and with an IMU; and what of it can be believed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings, require
from boxplus.errors import BoxplusError, InputError
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.camera_calibration.adjustment import Adjustment, Rig, adjust
from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.imu import CameraImuCalibration, calibrate_imu
from boxplus.systems.camera_calibration.lens import LENSES, LensKind
from boxplus.systems.camera_calibration.one_camera import FEWEST_VIEWS, calibrate_camera, usable_frames
from boxplus.systems.camera_calibration.stereo import PairAgreement, join
from boxplus.systems.camera_calibration.structure import (
    ImageStructure,
    TargetStructure,
    ViewScatter,
    halves_disagree,
    image_structure,
    target_structure,
    view_scatter,
)
from boxplus.systems.camera_calibration.target import AprilGrid

_APART, _LOST = 1.1, 0.2
_PATTERN = 0.1
_WORTH = 0.98
"""A lens of more parameters is taken where it leaves less than this share of the residuals."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """What a session before a target shows.

    Attributes:
        target: as stated.
        lens: of all cameras.
        rig: all cameras together, with covariance; None where they do not keep their places to each other at all.
        singles: every camera on its own, with this lens.
        sigma_by_lens: standard deviation of a corner [px] that each lens leaves, pooled over the cameras; lenses that were
            not tried, or do not fit at all, are missing.
        halves: for every camera how far both halves of the views disagree, in standard deviations; NaN with too few views.
        views: for every camera how differently its single views would have the lens; None with too few.
        images, on_target: patterns in the residuals.
        pairs: how the cameras keep their places to each other.
        imu: mounting on the IMU, or None without one.

    Example:
        >>> from boxplus.simulation.cameras.target_session import simulate_target_session
        >>> target = bp.AprilGrid(rows=4, columns=4, tag_size=0.1, spacing=0.3)
        >>> lens = bp.Pinhole(460.0, 460.0, 370.0, 240.0, bp.RadialTangential(-0.28, 0.07, 0.0, 0.0))
        >>> mounting = [[1.0, 0, 0, 0, 0, 0, 0]]
        >>> session = simulate_target_session([lens], mounting, (752, 480), target, frames=16, rate_hz=2.0, seed=1)
        >>> found = bp.calibrate_cameras(session.corners, target, bp.CameraCalibrationConfig(lens="pinhole-radtan"))
        >>> adjustment, number = found.of_camera(0)
        >>> sigma = np.sqrt(np.diag(adjustment.covariance)[adjustment.intrinsics(number)])
        >>> bool(sigma[:2].max() < 3.0)  # of fx and fy, in pixels
        True
    """

    target: AprilGrid
    lens: LensKind
    rig: Adjustment | None
    singles: tuple[Adjustment, ...]
    sigma_by_lens: dict[str, float]
    halves: tuple[float, ...]
    views: tuple[ViewScatter | None, ...]
    images: tuple[ImageStructure, ...]
    on_target: TargetStructure
    pairs: tuple[PairAgreement, ...]
    imu: CameraImuCalibration | None

    @property
    def rig_holds(self) -> bool:
        """Whether the cameras together leave about what they leave alone: they are rigid, and look at the same time."""
        if self.rig is None:
            return False
        alone = float(np.mean([single.sigma_px**2 for single in self.singles]))
        views = sum(len(np.unique(single.corners.frame_of)) for single in self.singles)
        return self.rig.sigma_px <= _APART * alone**0.5 and len(self.rig.lost_views) <= _LOST * views

    def of_camera(self, camera: int) -> tuple[Adjustment, int]:
        """The adjustment to believe for a camera, and its number there: the rig, or the camera alone where no rig holds."""
        return (self.rig, camera) if self.rig is not None and self.rig_holds else (self.singles[camera], 0)


def calibrate_cameras(
    corners: TargetCorners,
    target: AprilGrid,
    config: CameraCalibrationConfig | None = None,
    *,
    imu: ImuSamples | None = None,
    noise: ImuNoise | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> CameraCalibration:
    """Calibrate a rig of cameras, and its place on an IMU where there is one, without a guess.

    Args:
        corners: what the cameras saw of the target.
        target: its size decides all lengths.
        config: the lens, and how many views to use.
        imu: samples of the same session, the cameras' times in `corners`.
        noise: of the IMU; needed with `imu`.
        on_progress: called with the fraction done, in [0, 1].

    Raises:
        InputError: corners that the target does not have, too few views, views that no lens explains, cameras that never saw the
            target together, an IMU without noise or without motion.

    Source: docs/camera_calibration.md; Zhang, PAMI 2000; Furgale, Rehder and Siegwart, IROS 2013.

    Example:
        >>> from boxplus.simulation.cameras.target_session import simulate_target_session
        >>> target = bp.AprilGrid(rows=4, columns=4, tag_size=0.1, spacing=0.3)
        >>> lens = bp.Pinhole(460.0, 460.0, 370.0, 240.0, bp.RadialTangential(-0.28, 0.07, 0.0, 0.0))
        >>> mounting = [[1.0, 0, 0, 0, 0, 0, 0]]
        >>> session = simulate_target_session([lens], mounting, (752, 480), target, frames=16, rate_hz=2.0, seed=1)
        >>> found = bp.calibrate_cameras(session.corners, target, bp.CameraCalibrationConfig(lens="pinhole-radtan"))
        >>> bool(abs(found.singles[0].rig.models[0].fx - 460.0) < 3.0)
        True
    """
    require(corners, TargetCorners, "TargetCorners", "detect them, or make them from arrays")
    require(target, AprilGrid, "an AprilGrid", "give rows, columns, tag_size and spacing")
    config = as_settings(CameraCalibrationConfig, config)
    report = on_progress or (lambda _: None)
    if len(corners.pixels) == 0 or int(corners.corner_of.max()) >= target.count or int(corners.corner_of.min()) < 0:
        got = "none" if not len(corners.pixels) else f"{int(corners.corner_of.min())} to {int(corners.corner_of.max())}"
        raise InputError(
            f"corners 0 to {target.count - 1} of {target.describe()}",
            got,
            "check rows and columns of the target, and the corner file",
        )
    if imu is not None and noise is None:
        raise InputError("the noise densities of the IMU", "none", "take them from its data sheet or Allan deviation")
    places = target.corners
    chosen = _evenly(corners, config.max_views)
    by_lens: dict[LensKind, list[Adjustment]] = {}
    refused: list[BoxplusError] = []
    # The lens that was asked for first; the others where there is a choice, or where it leaves a pattern that one may explain.
    order = LENSES if config.lens == "auto" else (config.lens, *(kind for kind in LENSES if kind != config.lens))
    for number, kind in enumerate(order):
        try:
            by_lens[kind] = [calibrate_camera(chosen.of_camera(c), places, kind) for c in range(corners.cameras)]
        except BoxplusError as error:
            refused.append(error)
            if kind == config.lens:
                raise
        report(0.2 * (number + 1))
        if kind == config.lens and all(image_structure(single, 0).share < _PATTERN for single in by_lens[kind]):
            break
    if not by_lens:
        raise refused[0]
    sigma = {kind: float(np.sqrt(np.mean([s.sigma_px**2 for s in singles]))) for kind, singles in by_lens.items()}
    lens = _best(sigma) if config.lens == "auto" else config.lens
    singles = by_lens[lens]
    halves = tuple(_halves(single, places) for single in singles)
    pairs: list[PairAgreement] = []
    together: Adjustment | None = singles[0]
    if corners.cameras > 1:
        together, pairs = join(chosen, places, singles)
    report(0.75)
    mounted = None
    if imu is not None and noise is not None:
        first = singles[0]
        mounted = calibrate_imu(_first_camera(corners, first), places, first.rig.models[0], first.sigma_px, imu, noise)
    report(1.0)
    return CameraCalibration(
        target=target,
        lens=lens,
        rig=together,
        singles=tuple(singles),
        sigma_by_lens={str(kind): value for kind, value in sigma.items()},
        halves=halves,
        views=tuple(view_scatter(single, places) for single in singles),
        images=tuple(image_structure(single, 0) for single in singles),
        on_target=target_structure(singles, places),
        pairs=tuple(pairs),
        imu=mounted,
    )


def _evenly(corners: TargetCorners, most: int) -> TargetCorners:
    """The corners of at most so many of the frames."""
    frames = np.unique(corners.frame_of)
    if len(frames) <= most:
        return corners
    kept = frames[np.round(np.linspace(0, len(frames) - 1, most)).astype(int)]
    return corners.rows(np.isin(corners.frame_of, kept))


def _best(sigma: dict[LensKind, float]) -> LensKind:
    least = min(sigma.values())
    return next(kind for kind in LENSES if kind in sigma and sigma[kind] * _WORTH <= least)


def _halves(single: Adjustment, places: NDArray[np.float64]) -> float:
    corners = single.corners.rows(single.kept)
    frames = usable_frames(corners)
    if len(frames) < 2 * FEWEST_VIEWS + 2:
        return float("nan")
    try:
        parts = []
        for half in (frames[::2], frames[1::2]):
            poses = np.full_like(single.rig.T_target_body, np.nan)
            poses[half] = single.rig.T_target_body[half]
            part = corners.rows(np.isin(corners.frame_of, half))
            parts.append(adjust(part, places, Rig(single.rig.kinds, single.rig.models, single.rig.T_body_camera, poses)))
        return halves_disagree(*parts)
    except (BoxplusError, np.linalg.LinAlgError):
        return float("nan")


def _first_camera(corners: TargetCorners, found: Adjustment) -> TargetCorners:
    """What the first camera saw, without what did not fit; frames that were not used for the lens are all kept."""
    out = {tuple(row) for row in _keys(found.corners)[~found.kept]}
    keys = _keys(corners)
    inside = np.array([tuple(row) not in out for row in keys]) if out else np.ones(len(keys), dtype=np.bool_)
    return replace(corners.rows(inside & (corners.camera_of == 0)), sizes=corners.sizes[:1])


def _keys(corners: TargetCorners) -> NDArray[np.intp]:
    return np.stack([corners.frame_of, corners.camera_of, corners.corner_of], axis=1)
