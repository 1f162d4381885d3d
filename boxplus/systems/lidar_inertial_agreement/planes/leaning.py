"""What leans under a mounting and should not: where no motion shows the mounting, gravity does."""

from __future__ import annotations

import numpy as np

from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.planes.ground_lean import GroundLean
from boxplus.systems.lidar_inertial_agreement.planes.plane_tilt import PlaneTilt

_UPRIGHT_RAD = np.deg2rad(4.0)  # what an accelerometer's bias of 0.7 m/s² tilts
_MIRRORS_RAD, _MIRRORS_SHARE = np.deg2rad(1.5), 0.2  # the tilt that a mirrored axis leaves, and its share of the tilt without
_MIRRORED_RAD, _NEARLY_ALL = np.deg2rad(2.5), 0.12  # a tilt of which a mirrored axis leaves so little is hardly a bias
_DEVIATIONS = 3.0
_STEEPEST_RAD, _BANK_RAD = np.deg2rad(21.0), np.deg2rad(60.0)  # streets climb by 19 deg; what leans by more than a bank is a wall


def leaning(planes: PlaneTilt | None, ground: GroundLean | None) -> Finding | None:
    """What says that the mounting is another one: planes that are not upright, or a road too steep for one; None where nothing.

    Args:
        planes: how far what stands around is from upright; None where nothing shows it.
        ground: how far the ground leans; None where nothing shows it.
    """
    return _of_planes(planes) or _of_ground(ground)


def _of_planes(planes: PlaneTilt | None) -> Finding | None:
    if planes is None or planes.tilt < _least_tilt(planes):
        return None
    text = (
        f"{'three' if planes.directions == 3 else 'two'} directions of planes, orthogonal to each other, are "
        f"{np.degrees(planes.tilt):.0f} deg from upright by the accelerometer under the given T_imu_lidar: "
    )
    axis = int(np.argmin(planes.mirrored))
    if planes.mirrored[axis] < min(_MIRRORS_RAD, _MIRRORS_SHARE * planes.tilt):
        text += f"with {'xyz'[axis]} of the points mirrored they are upright; else "
    advice = "check T_imu_lidar, and that the topics are those of this mounting, unless the place itself is tilted"
    return Finding("extrinsic", text + advice)


def _least_tilt(planes: PlaneTilt) -> float:
    """The tilt that contradicts a mounting [rad].

    A bias of the accelerometer tilts the world anyhow. That one of three axes, given the other sign, takes seven eighths of the
    tilt away happens by chance once in twenty times, so that less of a tilt will do.
    """
    mirrored = planes.directions == 3 and float(planes.mirrored.min()) < _NEARLY_ALL * planes.tilt
    return float(_MIRRORED_RAD if mirrored else _UPRIGHT_RAD) + _DEVIATIONS * planes.std


def _of_ground(ground: GroundLean | None) -> Finding | None:
    """A road that is steeper than any."""
    if ground is None or not _STEEPEST_RAD + _DEVIATIONS * ground.std < ground.lean < _BANK_RAD:
        return None
    return Finding(
        "extrinsic",
        f"the ground that the LiDAR moves along, {ground.speed:.0f} m/s fast and {ground.height:.1f} m above it, leans by "
        f"{np.degrees(ground.lean):.0f} deg by the accelerometer under the given T_imu_lidar, which no road does: check "
        "T_imu_lidar, and that the topics are those of this mounting, unless it flies or is pulled along a slope",
    )
