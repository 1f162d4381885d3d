"""What visual-inertial odometry says about one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Status = Literal["starting", "ok", "weak", "lost"]


@dataclass(frozen=True, slots=True, eq=False)
class VioEstimate:
    """State, covariance and diagnosis at the time of one frame (all images of one instant).

    Attributes:
        time_ns: of the images, in the clock of the IMU [ns].
        status: "starting": no start was found yet, and there is no state; "ok"; "weak": the cameras saw too little, or something
            contradicts, so that the covariance is the better part of the estimate; "lost": nothing was seen for so long that the
            IMU alone does not hold the pose any more, or the sensors contradict each other.
        reasons: why the status is not "ok", a sentence each, with numbers.
        T_world_imu: (4, 4) pose of the IMU in the world, whose z is up; NaN while starting.
        velocity_world: (3,) [m/s].
        gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s²].
        covariance: (15, 15) of the tangent `[θ, p, v, b_ω, b_a]`: rotation perturbed on the right (IMU frame) [rad], position
            and velocity along the world's axes. Relative to the first pose, whose position and yaw are known by definition.
        tracked: landmarks of the window seen in this frame that agree with it.
        new: corners found in this frame.
        rejected: corners and observations that were not used, by reason.
        is_keyframe: whether the frame became a keyframe.
        landmark_ids: (m,) int64 of the landmarks in the window; a landmark's last position is its best.
        landmarks: (m, 3) their positions in the world [m].
        landmark_sigmas: (m,) standard deviation of the distance from the camera that found them [m].
        lines_tracked: lines of the window seen in this frame that agree with it.
        lines_rejected: lines that were lost or not used, by reason.
        line_ids: (k,) int64 of the lines in the window; line_ends: (k, 6) both ends of what was seen of them last [m].
        T_imu_camera: (c, 4, 4) as refined, or as given.
        time_offset_s: added to the times of the images, beside what the recording knows [s].
        timing_s: seconds spent, by stage.

    Example:
        >>> from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
        >>> simulation = simulate_cameras("room", duration_s=2.0, rig=make_rig("stereo", scale=0.25, rate_hz=8.0))
        >>> recording = as_camera_recording(simulation)
        >>> cams = [stream.calibrated() for stream in recording.info.cameras]
        >>> rig = bp.Rig.of([c.model for c in cams], [c.T_body_camera for c in cams], [(c.width, c.height) for c in cams])
        >>> odometry, estimates = bp.VisualInertialOdometry(None, rig), []
        >>> for event in recording:
        ...     estimates += odometry.push_image(event) if isinstance(event, bp.CameraImage) else odometry.push_imu(event)
        >>> last = estimates[-1]
        >>> last.status, last.T_world_imu.shape, last.landmarks.shape[1]
        ('ok', (4, 4), 3)
    """

    time_ns: int
    status: Status
    reasons: tuple[str, ...]
    T_world_imu: NDArray[np.float64]
    velocity_world: NDArray[np.float64]
    gyro_bias: NDArray[np.float64]
    accel_bias: NDArray[np.float64]
    covariance: NDArray[np.float64]
    tracked: int
    new: int
    rejected: Mapping[str, int]
    is_keyframe: bool
    landmark_ids: NDArray[np.int64]
    landmarks: NDArray[np.float64]
    landmark_sigmas: NDArray[np.float64]
    lines_tracked: int
    lines_rejected: Mapping[str, int]
    line_ids: NDArray[np.int64]
    line_ends: NDArray[np.float64]
    T_imu_camera: NDArray[np.float64]
    time_offset_s: float
    timing_s: Mapping[str, float]
