"""How a wrong calibration moves the pixels p₂ of a frame: ∂p₂/∂q for causes q of what is left of the residuals (`leftover.py`).

The ray m of a pixel p₁ = π(m) and its inverse depth ρ follow from the calibration as well, and change by dm and dρ with it:

    ∂p₂/∂q = ∂π/∂q(Y) + P_Y (R dm + t dρ),     dm = −P₁⁻¹ ∂π/∂q(m),     P₁ = ∂π/∂(m_x, m_y)

dρ is none where a sensor measures depths. Those of a stereo pair are found where π'(Y'), Y' = R' m + ρ t', lies in the second
image, along a = P' t': a cause that moves it by d there without the depth has dρ = −(a · d) / (a · a).

A rolling shutter takes row v later by τ = (v − (H − 1)/2) / H of its readout q. With the camera's velocity (w, u), in itself, a
point X moves by −(w × X + u) τ q until its row is taken, so that with τ₁ of p₁ and τ₂ of p₂

    ∂p₂/∂q = P_Y (R τ₁ (w₁ × m + ρ u₁) − τ₂ (w₂ × Y + ρ u₂))

Source: docs/direct_odometry.md; Meingast, Geyer and Sastry, Geometric models of rolling-shutter cameras, OMNIVIS 2005.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion
from boxplus.manifolds.se3 import SE3Left
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair
from boxplus.systems.direct_odometry.sensor_watches.leftover import Leftover

Matrix = NDArray[np.float64]


def by_focal_length(leftover: Leftover, camera: Pinhole, stereo: StereoPair | None = None) -> Matrix:
    """(n, 2) ∂p₂ by the share that the focal lengths are to grow by; with a stereo pair, those of both cameras."""
    dm = leftover_rays(leftover, camera, leftover.pixels - _centre(camera))
    moved = leftover.seen_at - _centre(camera) + leftover.turned(dm)
    if stereo is None:
        return moved
    seen = SecondView.of(leftover, stereo)
    return moved + leftover.by_inverse_depth * seen.depth_change(seen.pixels - _centre(seen.camera) + seen.turned(dm))[:, None]


def by_principal_point(leftover: Leftover, camera: Pinhole, axis: int) -> Matrix:
    """(n, 2) ∂p₂ by where the principal point lies along an axis, in focal lengths."""
    d = np.zeros((len(leftover.m), 2))
    d[:, axis] = (camera.fx, camera.fy)[axis]
    return d + leftover.turned(leftover_rays(leftover, camera, d))


def by_turn_of_second(leftover: Leftover, stereo: StereoPair) -> Matrix:
    """(n, 2) ∂p₂ by a turn [rad] of the second camera in the plane of the baseline and its axis, which no epipolar line shows."""
    seen = SecondView.of(leftover, stereo)
    axis = np.cross([0.0, 0.0, 1.0], seen.t)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    turned = seen.projected(np.cross(np.broadcast_to(axis, seen.Y.shape), seen.Y))
    return leftover.by_inverse_depth * seen.depth_change(turned)[:, None]


def by_readout(leftover: Leftover, height: int, velocities: tuple[Matrix, Matrix]) -> Matrix:
    """(n, 2) ∂p₂ by the time [s] from first to last row; velocities (6,) [w, u] of the camera at the keyframe and the frame."""
    (w_1, u_1), (w_2, u_2) = ((velocity[:3], velocity[3:]) for velocity in velocities)
    rho = leftover.inverse_depth[:, None]
    tau_1, tau_2 = (((p[:, 1:] - 0.5 * (height - 1)) / height) for p in (leftover.pixels, leftover.seen_at))
    own = tau_1 * (np.cross(np.broadcast_to(w_1, leftover.m.shape), leftover.m) + rho * u_1)
    seen = tau_2 * (np.cross(np.broadcast_to(w_2, leftover.Y.shape), leftover.Y) + rho * u_2)
    return leftover.turned(own) - leftover.projected(seen)


def leftover_rays(leftover: Leftover, camera: Pinhole, moved: Matrix) -> Matrix:
    """dm (n, 3) of the rays of the keyframe's pixels, where ∂π/∂q(m) = moved (n, 2)."""
    _, P, _, _ = camera.project_with_jacobians(leftover.m)
    dm = np.zeros((len(moved), 3))
    dm[:, :2] = -np.linalg.solve(P[:, :, :2], moved[:, :, None])[:, :, 0]
    return dm


@dataclass(frozen=True, slots=True, eq=False)
class SecondView:
    """The keyframe's pixels in the second image of a stereo pair.

    Attributes:
        camera: the second one; R, t: of T_right_left.
        Y: (n, 3) Y'; pixels: (n, 2) π'(Y'); P: (n, 2, 3) P'.
    """

    camera: Pinhole
    R: Matrix
    t: Matrix
    Y: Matrix
    pixels: Matrix
    P: Matrix

    @classmethod
    def of(cls, leftover: Leftover, stereo: StereoPair) -> SecondView:
        """Of the pixels of a keyframe; where one is not seen, nothing moves."""
        T = SE3Left.check("T_right_left", stereo.T_right_left)[0]
        camera, R = check_pinhole(stereo.camera, "direct odometry"), quaternion.to_matrix(T[:4])
        Y = leftover.m @ R.T + leftover.inverse_depth[:, None] * T[4:]
        pixels, P, _, _ = camera.project_with_jacobians(Y)
        return cls(camera, R, T[4:], Y, np.nan_to_num(pixels), np.nan_to_num(P))

    def projected(self, D: Matrix) -> Matrix:
        """P' D (n, 2) [pixels]."""
        return np.asarray(np.einsum("nij,nj->ni", self.P, D))

    def turned(self, d: Matrix) -> Matrix:
        """P' R' d (n, 2) [pixels]."""
        return self.projected(d @ self.R.T)

    def depth_change(self, moved: Matrix) -> Matrix:
        """dρ (n,) of a cause that moves pixels of the second image by `moved` (n, 2) at the same depth."""
        a = self.projected(np.broadcast_to(self.t, self.Y.shape))
        square = (a**2).sum(axis=1)
        return np.asarray(np.where(square > 0.0, -(a * moved).sum(axis=1) / np.maximum(square, 1e-30), 0.0))


def _centre(camera: Pinhole) -> Matrix:
    return np.array([camera.cx, camera.cy])
