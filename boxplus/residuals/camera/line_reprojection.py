"""Reprojection error of a straight line: signed distances of a segment's end points to the projected line.

Derivation: docs/residuals/line_reprojection.md.
A line is its moment and direction L = [m; d], m = p × d, held as (U, φ) on `Line3D`: U = [u₁, u₂, u₃] and
L = [cos φ u₁; sin φ u₂]. With T_camera_world = (R, t):

    m_c = R m + t × R d,   d_c = R d,   l = det(K) K⁻ᵀ m_c,   n = √(l₁² + l₂²)
    e = [x_startᵀ l, x_endᵀ l] / n     [px], x = [u, v, 1]

Jacobians, with the rows aᵀ = ∂e/∂l · det(K) K⁻ᵀ, ∂e/∂l = ([u, v, 1] − e [l₁, l₂, 0]/n)/n:

    ∂e/∂[w, v] = [m_c × a, d_c × a]                     T_camera_world on the left, T ← Exp([w, v]) T
    ∂e/∂[θ, δ] = [bᵀ cᵀ] ∂L/∂[θ, δ],  b = Rᵀ a,  c = −Rᵀ (t × a),

    ∂L/∂[θ, δ] = [0, −w₁u₃, w₁u₂, −w₂u₁; w₂u₃, 0, −w₂u₁, w₁u₂],  w₁ = cos φ, w₂ = sin φ,  U ← U Exp(θ), φ ← φ + δ

Singular: a line through the camera centre (m_c = 0, to rounding) and an image line at infinity (n ≤ 10⁻⁹ |l₃|) are
invalid. A segment shorter than 1 px gives two equal rows and is refused or dropped. A line without direction is refused
where `Line3D` is made; one through the world origin (w₁ = 0) is not singular. Motion along the line is not constrained,
and one view does not determine a line.

Source: docs/residuals/line_reprojection.md; Bartoli and Sturm, Structure from motion using lines, 2005.
"""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.image_residual import ImageResidual
from boxplus.residuals.camera.reprojection import check_pixels
from boxplus.residuals.residual import Array, Arrays, Mask, Rows
from boxplus.residuals.whitening import Whitening

_logger = logging.getLogger(__name__)
_LENGTH_MIN = 1.0  # of a segment [px]
_AT_INFINITY = 1e-9  # n/|l₃| up to which an image line counts as at infinity
_ROUNDING = 1e-13  # |m_c|/(|m| + |t| |d|) up to which m_c is zero
_NO_JACOBIANS = (np.zeros((0, 2, 6)), np.zeros((0, 2, 4)))


Matrix3 = tuple[float, float, float, float, float, float, float, float, float]


@kernel(inline=True)
def _image_line(
    R: Matrix3, tx: float, ty: float, tz: float, U: Matrix3, w1: float, w2: float, K_line: NDArray[np.float64]
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """l, m_c and d_c of the line (U, φ), w₁ = cos φ and w₂ = sin φ, in the camera T_camera_world = (R, t)."""
    mx, my, mz = w1 * U[0], w1 * U[3], w1 * U[6]
    dx, dy, dz = w2 * U[1], w2 * U[4], w2 * U[7]
    ex = R[0] * dx + R[1] * dy + R[2] * dz
    ey = R[3] * dx + R[4] * dy + R[5] * dz
    ez = R[6] * dx + R[7] * dy + R[8] * dz
    cx = R[0] * mx + R[1] * my + R[2] * mz + ty * ez - tz * ey
    cy = R[3] * mx + R[4] * my + R[5] * mz + tz * ex - tx * ez
    cz = R[6] * mx + R[7] * my + R[8] * mz + tx * ey - ty * ex
    l0 = K_line[0, 0] * cx + K_line[0, 1] * cy + K_line[0, 2] * cz
    l1 = K_line[1, 0] * cx + K_line[1, 1] * cy + K_line[1, 2] * cz
    l2 = K_line[2, 0] * cx + K_line[2, 1] * cy + K_line[2, 2] * cz
    return l0, l1, l2, cx, cy, cz, ex, ey, ez


@kernel
def _change(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    lines: NDArray[np.float64],
    line_of: NDArray[np.uint32],
    delta: NDArray[np.float64],
    K_line: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """out = ∂e/∂z δ: what δ (N, 4) of the end points does to their distances, across the line."""
    one_camera = K_line.shape[0] == 1
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j = pose_of[n], line_of[n]
        R = rotation_entries(poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3])
        U = rotation_entries(lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3])
        w1, w2 = math.cos(lines[j, 4]), math.sin(lines[j, 4])
        K = K_line[np.uint64(0) if one_camera else n]
        l0, l1, _, _, _, _, _, _, _ = _image_line(R, poses[i, 4], poses[i, 5], poses[i, 6], U, w1, w2, K)
        inverse = 1.0 / math.sqrt(l0 * l0 + l1 * l1)
        out[n, 0] = (delta[n, 0] * l0 + delta[n, 1] * l1) * inverse
        out[n, 1] = (delta[n, 2] * l0 + delta[n, 3] * l1) * inverse


@kernel
def _line_reprojection(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    lines: NDArray[np.float64],
    line_of: NDArray[np.uint32],
    segments: NDArray[np.float64],
    K_line: NDArray[np.float64],
    r: NDArray[np.float64],
    J_pose: NDArray[np.float64],
    J_line: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    one_camera = K_line.shape[0] == 1
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j = pose_of[n], line_of[n]
        k = np.uint64(0) if one_camera else n
        R = rotation_entries(poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3])
        tx, ty, tz = poses[i, 4], poses[i, 5], poses[i, 6]
        U = rotation_entries(lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3])
        w1, w2 = math.cos(lines[j, 4]), math.sin(lines[j, 4])
        l0, l1, l2, cx, cy, cz, ex, ey, ez = _image_line(R, tx, ty, tz, U, w1, w2, K_line[k])
        norm_sq = l0 * l0 + l1 * l1
        size = abs(w1) + math.sqrt(tx * tx + ty * ty + tz * tz) * abs(w2)
        # Both tests are false for a NaN, which passes on into the residual, where it is seen and named.
        invalid = norm_sq <= _AT_INFINITY * _AT_INFINITY * l2 * l2 or cx * cx + cy * cy + cz * cz <= (_ROUNDING * size) * (
            _ROUNDING * size
        )
        valid[n] = not invalid
        if invalid:
            r[n, 0] = 0.0
            r[n, 1] = 0.0
            if with_jacobians:
                J_pose[n] = 0.0
                J_line[n] = 0.0
            continue
        inverse = 1.0 / math.sqrt(norm_sq)
        g0, g1 = l0 * inverse, l1 * inverse
        for row in range(np.uint64(2)):
            u, v = segments[n, 2 * row], segments[n, 2 * row + np.uint64(1)]
            e = (u * l0 + v * l1 + l2) * inverse
            r[n, row] = e
            if not with_jacobians:
                continue
            h0, h1 = (u - e * g0) * inverse, (v - e * g1) * inverse
            a0 = h0 * K_line[k, 0, 0] + h1 * K_line[k, 1, 0] + inverse * K_line[k, 2, 0]
            a1 = h0 * K_line[k, 0, 1] + h1 * K_line[k, 1, 1] + inverse * K_line[k, 2, 1]
            a2 = h0 * K_line[k, 0, 2] + h1 * K_line[k, 1, 2] + inverse * K_line[k, 2, 2]
            J_pose[n, row, 0] = cy * a2 - cz * a1
            J_pose[n, row, 1] = cz * a0 - cx * a2
            J_pose[n, row, 2] = cx * a1 - cy * a0
            J_pose[n, row, 3] = ey * a2 - ez * a1
            J_pose[n, row, 4] = ez * a0 - ex * a2
            J_pose[n, row, 5] = ex * a1 - ey * a0
            s0, s1, s2 = tz * a1 - ty * a2, tx * a2 - tz * a0, ty * a0 - tx * a1
            b0 = R[0] * a0 + R[3] * a1 + R[6] * a2
            b1 = R[1] * a0 + R[4] * a1 + R[7] * a2
            b2 = R[2] * a0 + R[5] * a1 + R[8] * a2
            c0 = R[0] * s0 + R[3] * s1 + R[6] * s2
            c1 = R[1] * s0 + R[4] * s1 + R[7] * s2
            c2 = R[2] * s0 + R[5] * s1 + R[8] * s2
            b_u1 = b0 * U[0] + b1 * U[3] + b2 * U[6]
            b_u2 = b0 * U[1] + b1 * U[4] + b2 * U[7]
            b_u3 = b0 * U[2] + b1 * U[5] + b2 * U[8]
            c_u1 = c0 * U[0] + c1 * U[3] + c2 * U[6]
            c_u2 = c0 * U[1] + c1 * U[4] + c2 * U[7]
            c_u3 = c0 * U[2] + c1 * U[5] + c2 * U[8]
            J_line[n, row, 0] = w2 * c_u3
            J_line[n, row, 1] = -w1 * b_u3
            J_line[n, row, 2] = w1 * b_u2 - w2 * c_u1
            J_line[n, row, 3] = w1 * c_u2 - w2 * b_u1


class LineReprojection(ImageResidual):
    """Straight lines seen as segments: distances of the end points to the projected line, as derived above.

    Variables: `T_camera_world` on `SE3Left` (7,), `line_world` on `Line3D` (5,).

    Args:
        camera: a `Pinhole` without distortion, or calibration matrices K, (3, 3) or (N, 3, 3), upper triangular with
            K[2, 2] = 1; skew is allowed.
        segments: (N, 4) end points [u_start, v_start, u_end, v_end], undistorted [px].
        sigma, covariance, information: of the two distances, as in `Whitening.of` for all N; none stands for 1 px.
        drop_short: leave segments shorter than 1 px out instead of refusing them.

    Attributes:
        kept: rows of `segments` that are residuals, in order; all of them unless some were dropped. Connect the variables
            of these: `cameras[camera_of[residual.kept]]`.
        dropped: rows of `segments` that were too short.

    Raises:
        InputError: segments of another shape, not finite or shorter than 1 px; a camera with distortion; a K that is not
            a calibration matrix; or noise that `Whitening.of` refuses.

    Example:
        >>> from boxplus.manifolds import lines
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> segment = [[195.0, 241.0, 445.0, 241.0]]  # u, v of both ends, a pixel below the line
        >>> seen = bp.residuals.LineReprojection(camera, segment, sigma=0.5)
        >>> np.abs(seen.evaluate(bp.SE3Left.identity(), lines.from_points([-1.0, 0.0, 4.0], [1.0, 0.0, 4.0]))).round(6)
        array([[1., 1.]])
    """

    measured_name = "segments"

    def __init__(
        self,
        camera: Pinhole | ArrayLike,
        segments: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
        drop_short: bool = False,
    ) -> None:
        every = check_pixels("segments", segments, 4)
        short = np.hypot(every[:, 2] - every[:, 0], every[:, 3] - every[:, 1]) < _LENGTH_MIN
        self.kept, self.dropped = np.flatnonzero(~short), np.flatnonzero(short)
        if len(self.dropped):
            rows = ", ".join(map(str, self.dropped[:10])) + (", …" if len(self.dropped) > 10 else "")
            if not drop_short:
                raise InputError(
                    "segments of 1 px and longer",
                    f"{len(self.dropped)} shorter: rows {rows}",
                    "their direction is noise: remove them, or give drop_short=True and use `kept`",
                )
            _logger.warning("dropped %d of %d segments shorter than 1 px: rows %s", len(self.dropped), len(every), rows)
        K_line = _line_matrices(camera, len(every))
        self._K_line = K_line if len(K_line) == 1 else np.ascontiguousarray(K_line[self.kept])
        self.segments = np.ascontiguousarray(every[self.kept])
        whitening = Whitening.of(2, len(every), sigma=sigma, covariance=covariance, information=information)
        super().__init__(
            dim=2,
            count=len(self.segments),
            manifolds=(SE3Left, Line3D),
            roles=("T_camera_world", "line_world"),
            whitening=whitening.rows(self.kept),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _line_reprojection(
            begin, end, x[0], index[0], x[1], index[1], self.segments, self._K_line, r, jacobians[0], jacobians[1], valid, True
        )

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        _line_reprojection(
            begin, end, x[0], index[0], x[1], index[1], self.segments, self._K_line, r, *_NO_JACOBIANS, valid, False
        )

    def change_into(self, begin: int, end: int, x: Arrays, index: Rows, delta: Array, out: Array) -> None:
        """See `ImageResidual.change_into`."""
        _change(begin, end, x[0], index[0], x[1], index[1], delta, self._K_line, out)


def _line_matrices(camera: Pinhole | ArrayLike, count: int) -> NDArray[np.float64]:
    """det(K) K⁻ᵀ, (1, 3, 3) or (count, 3, 3), of a camera or of calibration matrices."""
    if isinstance(camera, Pinhole):
        if camera.distortion is not None:
            raise InputError(
                "a camera without distortion",
                f"{camera.distortion}",
                "a lens bends straight lines: undistort the end points with `camera.undistort` and drop the distortion",
            )
        return camera.K_line[None]
    K = as_floats(camera, "camera")
    if K.shape not in ((3, 3), (count, 3, 3)):
        raise InputError(
            f"a Pinhole, or K of shape (3, 3) or ({count}, 3, 3)", f"shape {K.shape}", "one K for all segments, or one for each"
        )
    K = K.reshape(-1, 3, 3)
    sound = np.isfinite(K).all(axis=(1, 2)) & (K[:, 0, 0] > 0.0) & (K[:, 1, 1] > 0.0) & (K[:, 2, 2] == 1.0)
    sound &= (K[:, 1, 0] == 0.0) & (K[:, 2, 0] == 0.0) & (K[:, 2, 1] == 0.0)
    if not sound.all():
        n = int(np.argmin(sound))
        raise InputError(
            "K = [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], finite, with fx and fy positive",
            f"{K[n].tolist()} in row {n}",
            "divide K by K[2, 2], and turn the camera frame where a focal length is negative",
        )
    return np.ascontiguousarray(np.linalg.det(K)[:, None, None] * np.linalg.inv(K).swapaxes(1, 2))
