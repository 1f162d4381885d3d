"""Poses of cameras from those of their body, and Jacobians back, as the head of `on_body` derives them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.quaternion import multiply_scalars, rotate, rotation_entries
from boxplus.residuals.matrix3 import apply


@kernel
def _write_camera_pose(
    n: int, i: int, k: int, bodies: NDArray[np.float64], mountings: NDArray[np.float64], T: NDArray[np.float64]
) -> None:
    """T[n] = (T_world_body T_body_camera)⁻¹ of body i and mounting k."""
    bw, bx, by, bz = bodies[i, 0], bodies[i, 1], bodies[i, 2], bodies[i, 3]
    lx, ly, lz = rotate(bw, bx, by, bz, mountings[k, 4], mountings[k, 5], mountings[k, 6])
    w, x, y, z = multiply_scalars(bw, bx, by, bz, mountings[k, 0], mountings[k, 1], mountings[k, 2], mountings[k, 3])
    px, py, pz = rotate(w, -x, -y, -z, bodies[i, 4] + lx, bodies[i, 5] + ly, bodies[i, 6] + lz)
    T[n, 0], T[n, 1], T[n, 2], T[n, 3] = w, -x, -y, -z
    T[n, 4], T[n, 5], T[n, 6] = -px, -py, -pz


@kernel
def all_camera_poses(bodies: NDArray[np.float64], mountings: NDArray[np.float64], T: NDArray[np.float64]) -> None:
    """T_camera_world of every mounting on every body, body by body, in T (bodies · mountings, 7)."""
    count = np.uint64(mountings.shape[0])
    for i in range(np.uint64(bodies.shape[0])):
        for k in range(count):
            _write_camera_pose(i * count + k, i, k, bodies, mountings, T)


@kernel
def camera_poses(
    begin: int,
    end: int,
    bodies: NDArray[np.float64],
    body_of: NDArray[np.uint32],
    mountings: NDArray[np.float64],
    mounting_of: NDArray[np.uint32],
    T: NDArray[np.float64],
) -> None:
    """T[n] = T_camera_world = (T_world_body T_body_camera)⁻¹ for the rows [begin, end) of T (N, 7)."""
    for n in range(np.uint64(begin), np.uint64(end)):
        _write_camera_pose(n, body_of[n], mounting_of[n], bodies, mountings, T)


@kernel
def relative_poses(begin: int, end: int, first: NDArray[np.float64], second: NDArray[np.float64], T: NDArray[np.float64]) -> None:
    """T[n] = T_21 = T_2_world T_1_world⁻¹ of camera poses (N, 7)."""
    for n in range(np.uint64(begin), np.uint64(end)):
        w, x, y, z = multiply_scalars(
            second[n, 0], second[n, 1], second[n, 2], second[n, 3], first[n, 0], -first[n, 1], -first[n, 2], -first[n, 3]
        )
        tx, ty, tz = rotate(w, x, y, z, first[n, 4], first[n, 5], first[n, 6])
        T[n, 0], T[n, 1], T[n, 2], T[n, 3] = w, x, y, z
        T[n, 4], T[n, 5], T[n, 6] = second[n, 4] - tx, second[n, 5] - ty, second[n, 6] - tz


@kernel
def first_of_relative(begin: int, end: int, T: NDArray[np.float64], J: NDArray[np.float64], J_first: NDArray[np.float64]) -> None:
    """J_first = −J Ad(T_21): from a left step of T_21 to one of T_1_world; J and J_first (N, d, 6)."""
    for n in range(np.uint64(begin), np.uint64(end)):
        w, x, y, z = T[n, 0], -T[n, 1], -T[n, 2], -T[n, 3]
        tx, ty, tz = T[n, 4], T[n, 5], T[n, 6]
        for row in range(np.uint64(J.shape[1])):
            b0, b1, b2 = J[n, row, 3], J[n, row, 4], J[n, row, 5]
            # [a, b] Ad = [(a + b [t]x) R, b R], and b [t]x is the row b × t.
            a0 = J[n, row, 0] + b1 * tz - b2 * ty
            a1 = J[n, row, 1] + b2 * tx - b0 * tz
            a2 = J[n, row, 2] + b0 * ty - b1 * tx
            a0, a1, a2 = rotate(w, x, y, z, a0, a1, a2)
            b0, b1, b2 = rotate(w, x, y, z, b0, b1, b2)
            J_first[n, row, 0], J_first[n, row, 1], J_first[n, row, 2] = -a0, -a1, -a2
            J_first[n, row, 3], J_first[n, row, 4], J_first[n, row, 5] = -b0, -b1, -b2


@kernel
def body_jacobians(
    begin: int,
    end: int,
    bodies: NDArray[np.float64],
    body_of: NDArray[np.uint32],
    mountings: NDArray[np.float64],
    mounting_of: NDArray[np.uint32],
    J: NDArray[np.float64],
    J_body: NDArray[np.float64],
    J_mounting: NDArray[np.float64],
) -> None:
    """From rows [a, b] by a left step of T_camera_world to those by T_world_body and T_body_camera; all (N, d, 6)."""
    for n in range(np.uint64(begin), np.uint64(end)):
        i, k = body_of[n], mounting_of[n]
        R = rotation_entries(bodies[i, 0], bodies[i, 1], bodies[i, 2], bodies[i, 3])
        C = rotation_entries(mountings[k, 0], mountings[k, 1], mountings[k, 2], mountings[k, 3])
        px, py, pz = mountings[k, 4], mountings[k, 5], mountings[k, 6]
        for row in range(np.uint64(J.shape[1])):
            a0, a1, a2 = J[n, row, 0], J[n, row, 1], J[n, row, 2]
            c0, c1, c2 = apply(C, J[n, row, 3], J[n, row, 4], J[n, row, 5])
            d0, d1, d2 = apply(C, a0, a1, a2)
            e0, e1, e2 = apply(R, c0, c1, c2)
            J_mounting[n, row, 0], J_mounting[n, row, 1], J_mounting[n, row, 2] = -a0, -a1, -a2
            J_mounting[n, row, 3], J_mounting[n, row, 4], J_mounting[n, row, 5] = -c0, -c1, -c2
            J_body[n, row, 0] = c1 * pz - c2 * py - d0
            J_body[n, row, 1] = c2 * px - c0 * pz - d1
            J_body[n, row, 2] = c0 * py - c1 * px - d2
            J_body[n, row, 3], J_body[n, row, 4], J_body[n, row, 5] = -e0, -e1, -e2
