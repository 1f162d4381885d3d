"""Whether grey values contradict the depths of a sensor: the parallax of a motion tells depths as well, up to one scale.

ρ is the measured inverse depth of a pixel p, which on a plane is affine in p: moved with the surface, it stays exact. Causes q
of depths that do not fit change it to ρ (1 + Σ q b), in the order of `_CAUSES`:

    b = −ρ z₀                                 a constant that is missing in z, by the median depth z₀
    b = −W ∂ρ/∂u / ρ, −W ∂ρ/∂v / ρ            depths that belong to pixels farther along u or v, by the image's width W
    b = −(p − c)ᵀ∇ρ / ρ                       depths of a camera with another focal length
    b = m_x² + m_y²                           distances in place of z: √(1 + m_x² + m_y²) is q = 0.5 near the axis
    b = ∂ρ/∂t / ρ                             depths that are late [s], ∂ρ/∂t = −ρ² ∂z/∂t − ∇ρᵀ ∂p/∂t by the camera's velocity

which moves the pixels p₂ of a frame by P_Y t ρ b (see `leftover.py`). One factor of all depths is the scale of the world, which
images do not tell. Pixels at the ends and creases of surfaces, where ∇ρ means little, do not take part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_odometry.sensor_watches.leftover import Combined, Leftover

Matrix = NDArray[np.float64]
_LEAST_SIGMAS = 6.0  # for a contradiction
_OWN_ERROR = 0.003  # standard deviation of one frame that its scatter does not show
_REACH = 2  # pixels around one that its surface is told by
_BENT, _ROUGH = 0.02, 0.03  # shares of ρ by which a pixel, and pixels around it, may be off the plane
_FEWEST_PIXELS = 100
_CAUSES = (  # what is said, by how much of q, in what unit, and the least q that is
    ("depths that are {:+.1f} % of the median depth off, all by the same length", 100.0, 0.03),
    ("depths that lie {:+.1f} % of the width beside their grey values along u", 100.0, 0.01),
    ("depths that lie {:+.1f} % of the width beside their grey values along v", 100.0, 0.01),
    ("depths of a camera whose focal length is {:+.1f} % off that of the images", 100.0, 0.015),
    ("distances from the camera in place of depths along its axis (by {:+.0f} %)", 200.0, 0.05),
    ("depths that are {:+.0f} ms late", 1000.0, 0.025),
)
_SIGNS = (-1.0, -1.0, -1.0, -1.0, 1.0, 1.0)  # of what is wrong, by what is asked for


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """How the sensor's depths change around the pixels of a keyframe at full resolution, and how the camera moved.

    Attributes:
        slope: (n, 2) ∂ρ/∂u, ∂ρ/∂v by ρ [1/px]; is_plane: (n,) whether they mean something.
        velocity: (6,) [w, v] of the camera, in itself [rad/s, m/s].
    """

    slope: Matrix
    is_plane: NDArray[np.bool_]
    velocity: Matrix

    @classmethod
    def around(cls, tracker: Keyframe, depth: NDArray[np.float32], velocity: Matrix) -> Surfaces:
        """Of measured depths (H, W) [m], 0 where there is none."""
        height, width = depth.shape
        centre = tracker.levels[-1].pixels.astype(np.int64)
        inside = np.all((centre >= _REACH) & (centre < np.array([width, height]) - _REACH), axis=1)
        centre = np.clip(centre, _REACH, np.array([width, height]) - 1 - _REACH)
        dv, du = (d.ravel() for d in np.mgrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1])
        z = depth[centre[:, 1, None] + dv, centre[:, 0, None] + du].astype(np.float64)
        known = np.asarray(np.all(z > 0.0, axis=1)) & inside
        ratio = np.where(known[:, None], depth[centre[:, 1], centre[:, 0], None] / np.where(z > 0.0, z, 1.0), 1.0)
        slope = np.stack([ratio @ du, ratio @ dv], axis=1) / float(du @ du)
        spread = np.ptp(ratio, axis=1) - 2.0 * _REACH * np.abs(slope).sum(axis=1)
        is_plane = known & (np.abs(ratio.mean(axis=1) - 1.0) < _BENT) & (spread < _ROUGH)
        return cls(slope, is_plane, velocity)


class DepthWatch:
    """What the frames so far say of a sensor's depths."""

    def __init__(self) -> None:
        self._found = Combined(len(_CAUSES), _OWN_ERROR)

    def add(self, leftover: Leftover, surfaces: Surfaces, tracker: Keyframe) -> None:
        """A frame that was aligned to a keyframe with these surfaces."""
        if np.count_nonzero(surfaces.is_plane) < _FEWEST_PIXELS:
            return
        b = _changes(leftover.m, leftover.inverse_depth, surfaces, tracker)
        by_share = leftover.by_inverse_depth * leftover.inverse_depth[:, None]
        found = leftover.explained_by([by_share * change[:, None] for change in b], surfaces.is_plane.astype(np.float64))
        if found is not None:
            self._found.add(*found)

    @property
    def contradiction(self) -> str:
        """What must be wrong with the depths, in a sentence; empty where nothing is."""
        found = self._found.strongest([least for _, _, least in _CAUSES], _LEAST_SIGMAS)
        if found is None:
            return ""
        k, q, sigma = found
        text, unit, _ = _CAUSES[k]
        return (
            f"the parallax of the motion contradicts the depths: it looks like {text.format(unit * _SIGNS[k] * q)}, "
            f"{abs(q) / sigma:.0f} standard deviations, over {self._found.frames} keyframes; check that depth and image "
            "are registered, taken at the same time, and in the unit and sense that the format defines"
        )


def _changes(m: Matrix, rho: Matrix, surfaces: Surfaces, tracker: Keyframe) -> list[Matrix]:
    """b (n,) of each cause."""
    camera: Pinhole = tracker.camera
    f, (su, sv) = np.array([camera.fx, camera.fy]), surfaces.slope.T
    w, v = surfaces.velocity[:3], surfaces.velocity[3:]
    X = m / rho[:, None]
    moved = -np.cross(np.broadcast_to(w, X.shape), X) - v
    flow = f * (moved[:, :2] - m[:, :2] * moved[:, 2:]) * rho[:, None]
    by_time = -rho * moved[:, 2] - su * flow[:, 0] - sv * flow[:, 1]
    width = float(tracker.shape[1])
    return [
        -rho * tracker.median_depth,
        -width * su,
        -width * sv,
        -(f * m[:, :2] * surfaces.slope).sum(axis=1),
        (m[:, :2] ** 2).sum(axis=1),
        by_time,
    ]
