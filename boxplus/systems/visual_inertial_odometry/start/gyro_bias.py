"""The bias of the gyroscope, from how rays turn between neighbouring frames.

Between frames i and j the gyroscope says γ(b) = γ Exp(J^γ δb). With one bias for all pairs of frames and a translation for each:

- one camera: rays u_i, u_j in the axes of the body lie in one plane with the translation t, of unknown length,
      t · (u_i × γ(b) u_j) / √(|t × u_i|² + |t × u_j|²) = 0                                   (Kneip and Lynen, ICCV 2013)
- several cameras: points x_i, triangulated in frame i, are seen in frame j,
      z_j − π(T_cb (γ(b)ᵀ (x_i − t))) = 0

Gauss-Newton over δb and all t, the translations eliminated, weights after Geman and McClure with a scale that narrows: mistaken
tracks fade as the estimate gets better (graduated non-convexity).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.systems.visual_inertial_odometry.start.ray_tracks import Floats, Integers, RayTracks

_LARGEST_BIAS = 0.3  # rad/s, standard deviation beforehand: it holds what the images leave open
_SMALLEST_SINE = 0.05
_FEWEST = 8  # tracks that a pair of frames needs
_GUESSES = 20
_STEPS = 2  # of Gauss-Newton for each scale
_BEGIN_S = 0.3  # between the first frames of pairs
# Time between the frames of pairs [s], first short, where a wrong bias does little, then longer, where it shows; scales [px].
_EPIPOLAR_PX = ((0.05, (5.0, 3.0, 3.0)), (0.15, (5.0, 3.0)), (0.4, (5.0, 3.0, 2.0)), (0.8, (5.0, 3.0, 2.0, 2.0)))
_POINT_PX = ((0.2, (60.0, 60.0, 30.0, 20.0, 10.0, 5.0, 3.0, 3.0)),)


@dataclass(frozen=True)
class TurnFit:
    """Attributes:
    bias: (3,) of the gyroscope [rad/s].
    agreeing: share of the rays whose weight ended above one half.
    """

    bias: Floats
    agreeing: float


def estimate_gyro_bias(tracks: RayTracks, turns: Preintegration, pixel: float, points: Floats | None) -> TurnFit | None:
    """The bias of the gyroscope, or None where too few tracks connect the frames.

    Args:
        tracks: in K frames.
        turns: of the K − 1 intervals between them, at the bias to begin with.
        pixel: a pixel, in the unit of the rays.
        points: (N, 3) the point of every sighting in the body at that time, NaN where it is not known; None for one camera.
    """
    bias, weight = turns.bias_gyro[0].copy(), None
    u = tracks.directions()
    interval_s = float(np.mean(turns.duration_s))
    thin = max(1, round(_BEGIN_S / interval_s))
    for gap_s, scales in _EPIPOLAR_PX if points is None else _POINT_PX:
        step = max(1, round(gap_s / interval_s))
        first, second = tracks.pairs(step)
        if points is not None:
            known = np.isfinite(points[first]).all(axis=1)
            first, second = first[known], second[known]
        frame = tracks.frame_of[first]
        enough = np.bincount(frame, minlength=len(tracks.time_ns)) >= _FEWEST
        enough[np.arange(len(enough)) % thin != 0] = False
        if not enough.any():
            break
        first, second = first[enough[frame]], second[enough[frame]]
        bias, weight = _fit(tracks, turns, step, first, second, u, points, bias, [scale * pixel for scale in scales])
    return None if weight is None else TurnFit(bias, float(np.mean(weight > 0.5)))


def _fit(
    tracks: RayTracks,
    turns: Preintegration,
    step: int,
    first: Integers,
    second: Integers,
    u: Floats,
    points: Floats | None,
    bias: Floats,
    scales: Sequence[float],
) -> tuple[Floats, Floats]:
    """The bias and the weights (N,) of pairs of sightings `first` and `second`, `step` frames apart."""
    pairs, pair_of = np.unique(tracks.frame_of[first], return_inverse=True)
    gamma, by_bias = _turns(turns, pairs, step)
    R = quaternion.to_matrix(tracks.T_imu_camera[:, :4])
    t, weight = np.zeros((len(pairs), 3)), np.ones(len(first))
    for number, scale in enumerate(np.repeat(scales, _STEPS)):
        R_pair = gamma @ so3.exp(by_bias @ (bias - turns.bias_gyro[0]))
        if points is None:
            v = np.einsum("nij,nj->ni", R_pair[pair_of], u[second])
            if number % _STEPS == 0:
                t = _directions(u[first], v, pair_of, len(pairs), scale)
            r, J_bias, J_t = _epipolar(u[first], v, t, pair_of, R_pair, by_bias)
        else:
            r, J_bias, J_t = _reprojected(tracks, points[first], second, t, pair_of, R, R_pair, by_bias)
        weight = (scale**2 / (scale**2 + (r * r).sum(axis=1))) ** 2
        change, change_t = _step(r, J_bias, J_t, weight / scales[-1] ** 2, pair_of, len(pairs), bias)
        bias = bias + change
        if points is not None:
            t = t + change_t
        else:
            t = t + np.einsum("pk,pki->pi", change_t, _tangents(t))
            t /= np.linalg.norm(t, axis=1)[:, None]
    return bias, weight


def _turns(turns: Preintegration, pairs: Integers, step: int) -> tuple[Floats, Floats]:
    """γ (P, 3, 3) from frame k to k + step, and ∂θ/∂b_g (P, 3, 3) of it on its right."""
    gamma = np.broadcast_to(np.eye(3), (len(pairs), 3, 3)).copy()
    by_bias = np.zeros((len(pairs), 3, 3))
    for k in range(step):
        one = quaternion.to_matrix(turns.gamma_wxyz[pairs + k])
        by_bias = np.swapaxes(one, 1, 2) @ by_bias + turns.bias_jacobian[pairs + k][:, 3:6, 3:]
        gamma = gamma @ one
    return gamma, by_bias


def _directions(u: Floats, v: Floats, pair_of: Integers, count: int, scale: float) -> Floats:
    """(P, 3) unit translations across the normals of most epipolar planes: the best of those of two rays each."""
    normal = np.cross(u, v)
    random = np.random.Generator(np.random.PCG64(0))
    order = np.argsort(pair_of, kind="stable")
    begin = np.searchsorted(pair_of[order], np.arange(count))
    size = np.bincount(pair_of, minlength=count)
    best, t = np.full(count, -np.inf), np.zeros((count, 3))
    for _ in range(_GUESSES):
        a, b = (order[begin + (random.random(count) * size).astype(np.int64)] for _ in range(2))
        guess = np.cross(normal[a], normal[b])
        length = np.linalg.norm(guess, axis=1)
        guess /= np.maximum(length, 1e-12)[:, None]
        of = guess[pair_of]
        r = _sine(np.einsum("ni,ni->n", of, normal), of, u, v)
        score = np.bincount(pair_of, scale**2 / (scale**2 + r * r), count)
        score[length < 1e-12] = -np.inf
        better = score > best
        best[better], t[better] = score[better], guess[better]
    t[~np.isfinite(best)] = [1.0, 0.0, 0.0]
    return t


def _sine(product: Floats, t: Floats, u: Floats, v: Floats) -> Floats:
    """t · (u × v) as an angle."""
    along_u, along_v = np.einsum("ni,ni->n", t, u), np.einsum("ni,ni->n", t, v)
    size = np.sqrt(np.maximum(2.0 - along_u**2 - along_v**2, _SMALLEST_SINE**2))
    angle: Floats = product / size
    return angle


def _tangents(t: Floats) -> Floats:
    """(P, 2, 3) axes across unit vectors."""
    axes: Floats = np.linalg.svd(t[:, None, :])[2][:, 1:, :]
    return axes


def _epipolar(u: Floats, v: Floats, t: Floats, pair_of: Integers, R: Floats, by_bias: Floats) -> tuple[Floats, Floats, Floats]:
    """r (N, 1), ∂r/∂b (N, 1, 3) and ∂r/∂t (N, 1, 2) in a tangent plane of t."""
    t_of = t[pair_of]
    across_u, across_v = np.cross(t_of, u), np.cross(t_of, v)
    size = np.maximum(np.sqrt((across_u**2).sum(axis=1) + (across_v**2).sum(axis=1)), _SMALLEST_SINE)
    normal = np.cross(u, v)
    r = (t_of * normal).sum(axis=1) / size
    by_turn = np.cross(v, across_u) / size[:, None]  # φ · (v × (t × u)) for a turn φ in frame i
    J_bias = np.einsum("ni,nij->nj", by_turn, (R @ by_bias)[pair_of])
    J_t = np.einsum("nki,ni->nk", _tangents(t)[pair_of], normal / size[:, None])
    return r[:, None], J_bias[:, None, :], J_t[:, None, :]


def _reprojected(
    tracks: RayTracks, points: Floats, second: Integers, t: Floats, pair_of: Integers, R_cam: Floats, R: Floats, by_bias: Floats
) -> tuple[Floats, Floats, Floats]:
    """r (N, 2), ∂r/∂b (N, 2, 3) and ∂r/∂t (N, 2, 3)."""
    camera = tracks.camera_of[second]
    x = np.einsum("nji,nj->ni", R[pair_of], points - t[pair_of])  # in body j
    y = np.einsum("nji,nj->ni", R_cam[camera], x - tracks.T_imu_camera[camera, 4:])
    z = np.maximum(y[:, 2], 0.1)
    r = tracks.rays[second] - y[:, :2] / z[:, None]
    P = np.zeros((len(y), 2, 3))
    P[:, 0, 0] = P[:, 1, 1] = 1.0 / z
    P[:, :, 2] = -y[:, :2] / z[:, None] ** 2
    P = -P @ np.swapaxes(R_cam[camera], 1, 2)
    J_turn = P @ so3.hat(x)  # x(γ Exp(φ)) = x − φ × x
    J_bias = J_turn @ by_bias[pair_of]
    J_t = -P @ np.swapaxes(R[pair_of], 1, 2)
    return r, J_bias, J_t


def _step(
    r: Floats, J_bias: Floats, J_t: Floats, weight: Floats, pair_of: Integers, count: int, bias: Floats
) -> tuple[Floats, Floats]:
    """Gauss-Newton for the bias and for every translation, these eliminated."""
    size = J_t.shape[2]
    H_tt, H_tb = np.zeros((count, size, size)), np.zeros((count, size, 3))
    g_t = np.zeros((count, size))
    weighted = weight[:, None, None] * J_t
    np.add.at(H_tt, pair_of, np.einsum("nrk,nrl->nkl", weighted, J_t))
    np.add.at(H_tb, pair_of, np.einsum("nrk,nrl->nkl", weighted, J_bias))
    np.add.at(g_t, pair_of, np.einsum("nrk,nr->nk", weighted, r))
    H_tt += (1e-6 * np.trace(H_tt, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(size)
    H = np.einsum("n,nrk,nrl->kl", weight, J_bias, J_bias) + np.eye(3) / _LARGEST_BIAS**2
    g = np.einsum("n,nrk,nr->k", weight, J_bias, r) + bias / _LARGEST_BIAS**2
    solved = np.linalg.solve(H_tt, np.concatenate([H_tb, g_t[:, :, None]], axis=2))
    H -= np.einsum("pki,pkj->ij", H_tb, solved[:, :, :3])
    g -= np.einsum("pki,pk->i", H_tb, solved[:, :, 3])
    change = -np.linalg.solve(H, g)
    return change, -(solved[:, :, 3] + solved[:, :, :3] @ change)


def stereo_points(tracks: RayTracks, nearest: float = 0.2) -> Floats:
    """(N, 3) points in the body, from the cameras that saw them at one time; NaN where only one did or the rays do not meet."""
    points = np.full((len(tracks.rays), 3), np.nan)
    if len(tracks.T_imu_camera) < 2:
        return points
    u = tracks.directions()
    key = tracks.track_of - tracks.track_of.min(initial=0)
    key = key * len(tracks.time_ns) + tracks.frame_of
    _, group, seen = np.unique(key, return_inverse=True, return_counts=True)
    # Least squares of the distances to the rays: Σ (I − u uᵀ) (x − c) = 0.
    A, b = np.zeros((len(seen), 3, 3)), np.zeros((len(seen), 3))
    centre = tracks.T_imu_camera[tracks.camera_of, 4:]
    P = np.eye(3) - u[:, :, None] * u[:, None, :]
    np.add.at(A, group, P)
    np.add.at(b, group, np.einsum("nij,nj->ni", P, centre))
    ok = (seen >= 2) & (np.linalg.eigvalsh(A)[:, 0] > 1e-6)  # parallel rays meet nowhere
    x = np.full((len(seen), 3), np.nan)
    x[ok] = np.linalg.solve(A[ok], b[ok][:, :, None])[:, :, 0]
    way = ((x[group] - centre) * u).sum(axis=1)
    miss = np.linalg.norm(x[group] - centre - way[:, None] * u, axis=1)
    bad = ~(way > nearest) | ~(miss < 0.02 * way)
    bad_group = np.zeros(len(seen), dtype=np.bool_)
    np.logical_or.at(bad_group, group, bad)
    kept = ~bad_group[group]
    points[kept] = x[group[kept]]
    return points
