"""A simulated sliding window: frames with velocities drive on, see landmarks, and know their motion like an IMU does."""

from __future__ import annotations

import numpy as np

from boxplus import SE3, Euclidean, Problem, marginalize
from boxplus.manifolds import quaternion, se3
from boxplus.optimization.marginalization.leak import world_gauge
from boxplus.residuals import UserResidual

VELOCITY = Euclidean(3)
POINT = Euclidean(3)
STEP_S = 0.2
GRAVITY = np.array([0.0, 0.0, -9.81])


def skew(v):
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def motion(T_i, v_i, T_j, v_j, m):
    """Rotation, change of velocity and of position in the body's frame, as preintegrated: does not see position and yaw."""
    R = quaternion.to_matrix(T_i[:, :4])
    dv = np.einsum("nji,nj->ni", R, v_j - v_i - GRAVITY * STEP_S)
    dp = np.einsum("nji,nj->ni", R, T_j[:, 4:] - T_i[:, 4:] - v_i * STEP_S - 0.5 * GRAVITY * STEP_S**2)
    turned = se3.compose(se3.inverse(m[:, :7]), se3.compose(se3.inverse(T_i), T_j))
    return np.concatenate([se3.log(turned)[:, :3], dv - m[:, 7:10], dp - m[:, 10:]], axis=1)


def motion_jacobian(T_i, v_i, T_j, v_j, m):
    R_i, R_j = quaternion.to_matrix(T_i[:, :4]), quaternion.to_matrix(T_j[:, :4])
    Rt = np.swapaxes(R_i, 1, 2)
    r = motion(T_i, v_i, T_j, v_j, m)
    e, dv, dp = r[:, :3], r[:, 3:6] + m[:, 7:10], r[:, 6:] + m[:, 10:]
    angle2 = np.maximum((e**2).sum(axis=1), 1e-12)[:, None, None]
    angle = np.sqrt(angle2)
    E = skew(e)
    Jr = np.eye(3) + 0.5 * E + (1.0 / angle2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))) * E @ E
    n = len(r)
    J_Ti, J_vi, J_Tj, J_vj = np.zeros((n, 9, 6)), np.zeros((n, 9, 3)), np.zeros((n, 9, 6)), np.zeros((n, 9, 3))
    J_Ti[:, :3, :3], J_Tj[:, :3, :3] = -Jr @ np.swapaxes(R_j, 1, 2) @ R_i, Jr
    J_Ti[:, 3:6, :3], J_vi[:, 3:6], J_vj[:, 3:6] = skew(dv), -Rt, Rt
    J_Ti[:, 6:, :3], J_Ti[:, 6:, 3:], J_Tj[:, 6:, 3:], J_vi[:, 6:] = skew(dp), -np.eye(3), Rt @ R_j, -STEP_S * Rt
    return J_Ti, J_vi, J_Tj, J_vj


def seen(T, point, m):
    """Bearing of a point in the body's frame, as its place in a plane before the body's x axis."""
    p = np.einsum("nji,nj->ni", quaternion.to_matrix(T[:, :4]), point - T[:, 4:])
    ahead = p[:, 0] > 0.3
    depth = np.where(ahead, p[:, 0], 1.0)
    return np.stack([p[:, 1] / depth - m[:, 0], p[:, 2] / depth - m[:, 1]], axis=1) * ahead[:, None], ahead


def seen_jacobian(T, point, m):
    R = quaternion.to_matrix(T[:, :4])
    p = np.einsum("nji,nj->ni", R, point - T[:, 4:])
    depth = np.where(p[:, 0] > 0.3, p[:, 0], 1.0)
    P = np.zeros((len(p), 2, 3))
    P[:, 0, 0], P[:, 1, 0] = -p[:, 1] / depth**2, -p[:, 2] / depth**2
    P[:, 0, 1] = P[:, 1, 2] = 1.0 / depth
    return np.concatenate([P @ skew(p), -P], axis=2), P @ np.swapaxes(R, 1, 2)


def motion_residual(m):
    return UserResidual(
        motion, manifolds=(SE3, VELOCITY, SE3, VELOCITY), dim=9, data=(m,), jacobian=motion_jacobian, is_batch=True,
        sigma=[0.005] * 3 + [0.03] * 3 + [0.01] * 3, fixes_gauge=False,
    )  # fmt: skip


def view_residual(uv):
    return UserResidual(
        seen, manifolds=(SE3, POINT), dim=2, data=(uv,), jacobian=seen_jacobian, is_batch=True, sigma=0.005, fixes_gauge=False
    )


class Drive:
    """Truth and measurements of frame k, on a winding path among landmarks."""

    def __init__(self, seed, count):
        rng = np.random.default_rng(seed)
        t = STEP_S * np.arange(count + 1)
        self.p = np.stack([6.0 * np.sin(0.35 * t), 8.0 * np.sin(0.2 * t + 0.3), 0.5 * np.sin(0.5 * t)], axis=1)
        v = np.gradient(self.p, STEP_S, axis=0)
        yaw = np.unwrap(np.arctan2(v[:, 1], v[:, 0]))
        tangent = np.stack([0.1 * np.sin(t), 0.1 * np.cos(0.7 * t), yaw], axis=1)
        R = se3.exp(np.concatenate([tangent, np.zeros_like(tangent)], axis=1))[:, :4]
        self.T = np.concatenate([R, self.p], axis=1)
        self.v = v
        self.points = np.column_stack([rng.uniform(-25, 25, (600, 2)), rng.uniform(-4, 4, 600)])
        self.rng = rng

    def moved(self, k):
        """(13,) what an IMU between frames k − 1 and k would say, with its noise."""
        i, j = self.T[k - 1 : k], self.T[k : k + 1]
        R = quaternion.to_matrix(i[:, :4])[0]
        dv = R.T @ (self.v[k] - self.v[k - 1] - GRAVITY * STEP_S)
        dp = R.T @ (self.p[k] - self.p[k - 1] - self.v[k - 1] * STEP_S - 0.5 * GRAVITY * STEP_S**2)
        turn = SE3.boxplus(se3.compose(se3.inverse(i), j), np.append(0.005 * self.rng.standard_normal(3), np.zeros(3)))
        return np.concatenate([turn[0], dv + 0.03 * self.rng.standard_normal(3), dp + 0.01 * self.rng.standard_normal(3)])

    def sees(self, k):
        """Numbers of the landmarks seen from frame k, and their (n, 2) bearings with noise."""
        p = (self.points - self.p[k]) @ quaternion.to_matrix(self.T[k, :4])
        depth = np.where(p[:, 0] > 1.0, p[:, 0], 1.0)
        uv = p[:, 1:] / depth[:, None]
        visible = np.flatnonzero((p[:, 0] > 1.0) & (p[:, 0] < 15.0) & (np.abs(uv) < 0.8).all(axis=1))[:12]
        return visible, uv[visible] + 0.005 * self.rng.standard_normal((len(visible), 2))


def drive(seed, frames, *, first_estimates=True, window=6, solve_options=None):
    """Drive on; returns the leak of every marginalisation, the error of the last frame and its covariance (6, 6)."""
    world = Drive(seed, frames)
    problem = Problem()
    T, v = world.T[0], world.v[0]
    poses = problem.add_variables(SE3, T, name="frames")
    speeds = problem.add_variables(VELOCITY, v, name="velocities")
    points = problem.add_variables(POINT, np.zeros((0, 3)), name="points")
    gauge = world_gauge({poses: "world_from_body", speeds: "vector", points: "point"}, rotation="yaw")
    id_of, leaks = {}, []
    options = {"max_iterations": 3, "initial_damping": 1e-8} | (solve_options or {})
    solution = None
    for k in range(frames):
        if k:
            m = world.moved(k)
            newest = poses[-1:].rows[0]
            R = quaternion.to_matrix(poses.values[newest, None, :4])[0]
            T = se3.compose(poses.values[newest], np.concatenate([m[:4], m[10:]]))
            T[4:] += speeds.values[-1] * STEP_S + 0.5 * GRAVITY * STEP_S**2
            v = speeds.values[-1] + GRAVITY * STEP_S + R @ m[7:10]
            T_k, v_k = problem.extend(poses, T), problem.extend(speeds, v)
            problem.add_residuals(motion_residual(m[None]), poses[k - 1], speeds[k - 1], T_k, v_k, name=f"motion {k}")
        visible, uv = world.sees(k)
        fresh = [n for n in visible if n not in id_of]
        if fresh:
            start = world.points[fresh] + 0.3 * world.rng.standard_normal((len(fresh), 3))
            id_of |= dict(zip(fresh, problem.extend(points, start).ids.tolist(), strict=True))
        problem.add_residuals(view_residual(uv), poses[k], points[[id_of[n] for n in visible]], name=f"view {k}")
        solution = problem.solve(**options)
        problem.set_values(solution)
        if k >= window:
            present = set(visible.tolist())
            lost = [id_of.pop(n) for n in list(id_of) if n not in present]
            marginal = marginalize(
                problem, [poses[[k - window]], speeds[[k - window]], points[lost]],
                at=solution, gauge=gauge, first_estimates=first_estimates,
            )  # fmt: skip
            leaks.append(marginal.leak)
    return problem, poses, leaks, world
