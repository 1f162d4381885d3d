"""Which extrinsic a run begins with: given, recorded, or estimated from how gyroscope and LiDAR turn."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.recordings.recording import Event, Recording
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.lidar_rotation import RotationAlignment, estimate_rotation_extrinsic
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

_LOG = logging.getLogger(__name__)

Source = Literal["given", "recording", "estimated", "identity"]

_TURNING_RAD_S = 0.15
_STRETCH_S = 12.0
_SEARCH_S = 120.0
_MOST_POINTS = 20_000
"""Of a scan that is kept for the estimate; 12 s of scans stay below 50 MB."""


@dataclass(frozen=True, slots=True)
class Extrinsic:
    """The LiDAR's pose in the IMU frame at the start of a run, and why.

    Attributes:
        T_imu_lidar: (4, 4) float64: p_imu = T_imu_lidar p_lidar.
        source: "given" (option or configuration), "recording" (its static transforms), "estimated" or "identity".
        text: one sentence.
        refine: it is a guess, to be refined while running wherever the motion allows.
        warning: what the user should do about it; empty when it is given.
    """

    T_imu_lidar: NDArray[np.float64]
    source: Source
    text: str
    refine: bool
    warning: str

    def applied_to(self, config: LioConfig) -> LioConfig:
        """The configuration with this extrinsic; a guess is refined online unless the configuration decides."""
        changes: dict[str, object] = {"T_imu_lidar": tuple(map(tuple, self.T_imu_lidar.tolist()))}
        if self.refine and "extrinsic_estimation" not in config.model_fields_set:
            changes["extrinsic_estimation"] = "gated"
        return LioConfig.model_validate(config.model_dump() | changes)


def choose_extrinsic(recording: Recording, config: LioConfig) -> Extrinsic:
    """The extrinsic from the configuration, else from the recording's static transforms, else estimated.

    The estimate aligns the rotation rates of gyroscope and LiDAR over the first seconds of rotation
    (`estimate_rotation_extrinsic`); when they do not determine the rotation, it stays the identity. The translation
    cannot be seen that way and starts at zero.

    Raises:
        RecordingError: nothing at all could be read.
    """
    if config.T_imu_lidar is not None:
        return Extrinsic(np.array(config.T_imu_lidar), "given", "T_imu_lidar as given", False, "")
    if recording.info.T_imu_lidar is not None:
        text = f"T_imu_lidar from {recording.info.T_imu_lidar_source or 'the recording'}"
        return Extrinsic(recording.info.T_imu_lidar, "recording", text, False, "")
    unknown = "neither --T-imu-lidar, the configuration nor the recording says how the LiDAR is mounted"
    remedy = "give --T-imu-lidar for the best result"
    try:
        alignment = _align(recording)
    except InputError as error:
        _LOG.info("no estimate of the extrinsic: %s", error)
        why = f"the rotation could not be estimated either ({error})"
        return Extrinsic(
            np.eye(4), "identity", f"identity assumed: {unknown}; {why}", True, f"{unknown}: identity assumed; {why}; {remedy}"
        )
    if alignment.observable_axes < 3:
        why = f"the first rotations do not determine it: {alignment.text}"
        return Extrinsic(np.eye(4), "identity", f"identity assumed: {why}", True, f"{unknown}: identity assumed; {why}; {remedy}")
    T = np.eye(4)
    T[:3, :3] = alignment.R_imu_lidar
    angle = np.degrees(np.arccos(np.clip((np.trace(alignment.R_imu_lidar) - 1.0) / 2.0, -1.0, 1.0)))
    text = f"rotation estimated from the data ({angle:.1f} deg from identity), translation begins at zero: {alignment.text}"
    warning = (
        f"{unknown}: its rotation was estimated from the data ({angle:.1f} deg from identity, "
        f"std {alignment.std_deg.max():.2f} deg), its translation begins at zero, both are refined while running; {remedy}"
    )
    return Extrinsic(T, "estimated", text, True, warning)


def _align(recording: Recording) -> RotationAlignment:
    scans, imu = _turning_stretch(recording)
    return estimate_rotation_extrinsic(scans, imu)


def _turning_stretch(events: Iterable[Event]) -> tuple[list[Scan], ImuSamples]:
    """Scans and samples of the first seconds in which the IMU turns, in bounded memory."""
    scans: list[Scan] = []
    blocks: list[ImuSamples] = []
    first_ns = begin_ns = None
    for event in events:
        now_ns = event.end_ns if isinstance(event, Scan) else int(event.time_ns[-1]) if len(event) else None
        if now_ns is None:
            continue
        first_ns = now_ns if first_ns is None else first_ns
        if isinstance(event, ImuSamples):
            blocks.append(event)
            if begin_ns is None and np.nanmax(np.linalg.norm(event.gyro, axis=1), initial=0.0) > _TURNING_RAD_S:
                begin_ns = now_ns
        elif len(event):
            scans.append(_thinned(event))
        since_s = (now_ns - (first_ns if begin_ns is None else begin_ns)) * 1e-9
        if since_s > (_SEARCH_S if begin_ns is None else _STRETCH_S):
            break
        if begin_ns is None:  # keep one second before the motion
            scans = [scan for scan in scans if scan.end_ns > now_ns - 1_000_000_000]
            blocks = [block for block in blocks if block.time_ns[-1] > now_ns - 1_000_000_000]
    if not blocks:
        raise InputError("IMU samples", "none at the beginning of the recording", "give --T-imu-lidar")
    return scans, ImuSamples(
        np.concatenate([block.time_ns for block in blocks]),
        np.concatenate([block.gyro for block in blocks]),
        np.concatenate([block.accel for block in blocks]),
    )


def _thinned(scan: Scan) -> Scan:
    stride = -(-len(scan) // _MOST_POINTS)
    if stride == 1:
        return scan
    return Scan(scan.p_lidar[::stride].copy(), scan.time_ns[::stride].copy(), None, scan.start_ns, scan.end_ns)
