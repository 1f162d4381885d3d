"""How the LiDAR moved, from the scans alone: what the IMU is compared with.

Every scan is registered to a map of those before it, point to plane (Xu et al., IEEE T-RO 2022, eq. 12), from the motion of the
scan before (constant velocity, as in KISS-ICP: Vizzo et al., RA-L 2023), and undistorted with the motion that the registration
finds. No sample of the IMU enters: whatever is wrong with it cannot have caused what is found here. What the scene does not
determine stays without information, whatever number the registration has come to.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.track import Track

_FOLLOWED = 5  # poses of a track, the first two included, after which the others that began with it are given up


class GrowingPath:
    """The path of the LiDAR through scans as they come, in order of time: of a track, and of those that it forks into."""

    def __init__(self, track: Track) -> None:
        self._tracks = [track]

    @property
    def failed(self) -> int:
        """Scans that could not be registered so far."""
        return self._tracks[0].failed

    @property
    def is_torn(self) -> bool:
        """Whether scans do not lie upon the ones before them: one could not be registered, or came long after the last."""
        return self._tracks[0].is_torn

    def path(self) -> LidarPath:
        """Through all scans so far."""
        return self._tracks[0].path()

    def turn_by(self, guesses: Sequence[Turning]) -> None:
        """How the LiDAR may turn from now on, where more has come to be known of it."""
        for track in self._tracks:
            track.turn_by(guesses)

    def add(self, scan: Scan, expected: Twist | None = None) -> None:
        """Register the next scan; `expected` is one more start."""
        self._tracks = _worth_following([one for track in self._tracks for one in track.add(scan, expected)])


def lidar_path(
    scans: Iterable[Scan],
    config: RegistrationConfig,
    guesses: Sequence[Turning] = (),
    *,
    undistort: bool = False,
    expected: Sequence[Twist] | None = None,
    velocity: NDArray[np.float64] | None = None,
    held: bool = False,
    unbroken: bool = False,
) -> LidarPath:
    """The path of the LiDAR through `scans`, in order of time; streamed.

    Args:
        scans: consecutive sweeps.
        config: the noise of the points and the sizes of map cells and voxels; nothing of the IMU is used.
        guesses: how the LiDAR may have turned, further starts for every registration; the one that fits best is kept.
        undistort: whether to undistort with the first guess, where it has been found to be right, instead of a constant rate.
        expected: of every scan, how an estimator believes that the LiDAR moved: one more start, and no further search.
        velocity: (3,) with which the first registration begins [m/s], LiDAR frame; zero when not given.
        held: whether the LiDAR moves as far along its way as is expected, whatever the scan says of that (`common_motion`).
        unbroken: whether to stop at the first scan that cannot be registered: the most costly one, as all starts are tried.
    """
    growing = GrowingPath(Track(config, guesses, undistort=undistort, velocity=velocity, held=held))
    for number, scan in enumerate(scans):
        growing.add(scan, None if expected is None else expected[number])
        if unbroken and growing.failed:
            break
    return growing.path()


def _worth_following(tracks: list[Track]) -> list[Track]:
    """Of tracks through the same scans those that may be right, the best one first: one, where later scans have told."""
    if len(tracks) == 1:
        return tracks
    failed = min(track.failed for track in tracks)
    left = [track for track in tracks if track.failed == failed]
    if left[0].length <= 1:  # they have lost hold together, and begin anew where the one is that was the best before
        return left[:1]
    left.sort(key=lambda track: track.cost)
    return left if left[0].length < _FOLLOWED else left[:1]
