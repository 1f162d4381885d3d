"""A residual of one's own: where a camera is mounted on a robot's hand (hand-eye calibration), written in two ways.

    python own_residual.py

The hand moves by A, measured by the robot; the camera by B, measured from its images. Both see the same motion through the
mounting X = T_hand_camera: A X = X B. The residual is what is left, e = Log((A X)⁻¹ (X B)).
"""

import numpy as np

import boxplus as bp
from boxplus.manifolds import se3
from boxplus.manifolds.quaternion import multiply_scalars, rotate
from boxplus.manifolds.se3 import log_scalars


def hand_eye_batch(X, A, B):
    """All residuals at once in NumPy: (n, 7) each, returns (n, 6)."""
    return se3.log(se3.compose(se3.inverse(se3.compose(A, X)), se3.compose(X, B)))


def hand_eye(X, A, B):
    """One residual, compiled: rows of 7 numbers, returns 6. With C = X B and D = A X, the error is Log(D⁻¹ C)."""
    cw, cx, cy, cz = multiply_scalars(X[0], X[1], X[2], X[3], B[0], B[1], B[2], B[3])
    dw, dx, dy, dz = multiply_scalars(A[0], A[1], A[2], A[3], X[0], X[1], X[2], X[3])
    c0, c1, c2 = rotate(X[0], X[1], X[2], X[3], B[4], B[5], B[6])
    d0, d1, d2 = rotate(A[0], A[1], A[2], A[3], X[4], X[5], X[6])
    w, x, y, z = multiply_scalars(dw, -dx, -dy, -dz, cw, cx, cy, cz)
    t0, t1, t2 = rotate(dw, -dx, -dy, -dz, c0 + X[4] - d0 - A[4], c1 + X[5] - d1 - A[5], c2 + X[6] - d2 - A[6])
    return log_scalars(w, x, y, z, t0, t1, t2)


rng = np.random.default_rng(1)
true = bp.SE3.boxplus([1.0, 0, 0, 0, 0, 0, 0], [0.1, -0.2, 1.5, 0.05, -0.02, 0.10])
sigma = np.repeat([0.002, 0.001], 3)  # [rad], [m]
A = bp.SE3.random(rng, 40)
B = se3.compose(se3.inverse(true), se3.compose(A, true))
B = bp.SE3.boxplus(B, sigma * rng.normal(size=(40, 6)))

for function, is_batch in ((hand_eye, False), (hand_eye_batch, True)):
    residual = bp.residuals.UserResidual(function, dim=6, manifolds=(bp.SE3,), data=(A, B), is_batch=is_batch, sigma=sigma)
    problem = bp.Problem()
    mounting = problem.add_variables(bp.SE3, [1.0, 0, 0, 0, 0, 0, 0], name="T_hand_camera")
    problem.add_residuals(residual, mounting)
    solution = problem.solve()
    e = bp.SE3.boxminus(solution[mounting], true)[0]
    std = solution.standard_deviations(mounting)[0]
    print(f"{function.__name__}: {solution.status} after {solution.iterations} iterations, Jacobian {residual.jacobian_kind}")
    print(f"  rotation  off by {np.degrees(np.linalg.norm(e[:3])):.3f}°, standard deviations {np.degrees(std[:3]).round(3)}°")
    print(f"  position  off by {1e3 * np.linalg.norm(e[3:]):.2f} mm, standard deviations {(1e3 * std[3:]).round(2)} mm")
