"""Kernels: rays against a world of convex solids, and distances to its surfaces.

A solid is a row of `SOLID_WIDTH` numbers: kind, centre (3), rotation solid to world (9, row by row), half sizes (3), the radius
that encloses it, reflectivity. A ray meets a convex solid in one interval; what it hits is the near end, or the far end when it
starts inside (so a room is a box seen from inside). A rectangle is a box without height.

Solids are listed in the cells of a grid over x and y; a ray walks through the cells (Amanatides and Woo, Eurographics 1987).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

BOX, CYLINDER, SPHERE = 0.0, 1.0, 2.0
CENTRE, ROTATION, HALF, ENCLOSING, REFLECTIVITY, SOLID_WIDTH = 1, 4, 13, 16, 17, 18
NEAREST_HIT = 1e-6  # a ray that starts on a surface does not hit it there [m]
PARALLEL = 1e-12

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]


@kernel(inline=True)
def _slab(o: float, d: float, half: float) -> tuple[float, float]:
    """Where a ray lies between −half and +half of one axis."""
    if abs(d) < PARALLEL:
        if abs(o) > half:
            return math.inf, -math.inf
        return -math.inf, math.inf
    near, far = (-half - o) / d, (half - o) / d
    if near > far:
        return far, near
    return near, far


@kernel(inline=True)
def _roots(a: float, b: float, c: float) -> tuple[float, float]:
    """Where a t² + 2 b t + c ≤ 0."""
    if a < PARALLEL:
        if c > 0.0:
            return math.inf, -math.inf
        return -math.inf, math.inf
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return math.inf, -math.inf
    root = math.sqrt(discriminant)
    return (-b - root) / a, (-b + root) / a


@kernel(inline=True)
def hit_distance(solid: Floats, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    """Distance along the ray to the surface of one solid, infinite when it misses."""
    near: float
    far: float
    rx, ry, rz = ox - solid[1], oy - solid[2], oz - solid[3]
    along = rx * dx + ry * dy + rz * dz
    if rx * rx + ry * ry + rz * rz - along * along > solid[16] * solid[16]:
        return math.inf
    if solid[0] == SPHERE:
        near, far = _roots(1.0, along, rx * rx + ry * ry + rz * rz - solid[13] * solid[13])
    else:
        lx = solid[4] * rx + solid[7] * ry + solid[10] * rz
        ly = solid[5] * rx + solid[8] * ry + solid[11] * rz
        lz = solid[6] * rx + solid[9] * ry + solid[12] * rz
        ex = solid[4] * dx + solid[7] * dy + solid[10] * dz
        ey = solid[5] * dx + solid[8] * dy + solid[11] * dz
        ez = solid[6] * dx + solid[9] * dy + solid[12] * dz
        near, far = _slab(lz, ez, solid[15])
        if solid[0] == BOX:
            near_x, far_x = _slab(lx, ex, solid[13])
            near_y, far_y = _slab(ly, ey, solid[14])
            near = max(near, near_x, near_y)
            far = min(far, far_x, far_y)
        else:
            near_r, far_r = _roots(ex * ex + ey * ey, lx * ex + ly * ey, lx * lx + ly * ly - solid[13] * solid[13])
            near = max(near, near_r)
            far = min(far, far_r)
    if near > far or far <= NEAREST_HIT:
        return math.inf
    if near > NEAREST_HIT:
        return near
    return far


@kernel
def cast_rays(
    directions_lidar: Floats,
    rays_per_pose: int,
    R_world_lidar: Floats,
    p_world_lidar: Floats,
    solids: Floats,
    large: Indices,
    grid: Floats,
    cell_begin: Indices,
    cell_solids: Indices,
    max_range: float,
    ranges: Floats,
    hits: Indices,
) -> None:
    """First surface along every ray.

    Args:
        directions_lidar: (N, 3) unit vectors, LiDAR frame.
        rays_per_pose: rays `i * rays_per_pose …` leave from pose i.
        R_world_lidar, p_world_lidar: (M, 3, 3), (M, 3) poses of the LiDAR.
        solids: (S, SOLID_WIDTH).
        large: solids that are tested for every ray (the ground).
        grid: (5,) x and y of the low corner, side of a cell [m], number of cells in x and in y.
        cell_begin, cell_solids: solids of cell c are `cell_solids[cell_begin[c]:cell_begin[c + 1]]`.
        max_range: rays that meet nothing nearer have range infinity [m].
        ranges: (N,) out [m].
        hits: (N,) out, the solid.
    """
    side = grid[2]
    columns, rows = int(grid[3]), int(grid[4])
    for n in range(directions_lidar.shape[0]):
        m = n // rays_per_pose
        lx, ly, lz = directions_lidar[n, 0], directions_lidar[n, 1], directions_lidar[n, 2]
        dx = R_world_lidar[m, 0, 0] * lx + R_world_lidar[m, 0, 1] * ly + R_world_lidar[m, 0, 2] * lz
        dy = R_world_lidar[m, 1, 0] * lx + R_world_lidar[m, 1, 1] * ly + R_world_lidar[m, 1, 2] * lz
        dz = R_world_lidar[m, 2, 0] * lx + R_world_lidar[m, 2, 1] * ly + R_world_lidar[m, 2, 2] * lz
        ox, oy, oz = p_world_lidar[m, 0], p_world_lidar[m, 1], p_world_lidar[m, 2]
        best = max_range
        found = False
        hit = np.uint32(0)
        for k in range(large.shape[0]):
            t = hit_distance(solids[large[k]], ox, oy, oz, dx, dy, dz)
            if t <= best:
                best, hit, found = t, large[k], True

        middle_x, middle_y = 0.5 * columns * side, 0.5 * rows * side
        near_x, far_x = _slab(ox - grid[0] - middle_x, dx, middle_x)
        near_y, far_y = _slab(oy - grid[1] - middle_y, dy, middle_y)
        t_enter, t_leave = max(near_x, near_y, 0.0), min(far_x, far_y)
        if t_enter <= t_leave:
            column = min(max(int((ox + t_enter * dx - grid[0]) / side), 0), columns - 1)
            row = min(max(int((oy + t_enter * dy - grid[1]) / side), 0), rows - 1)
            step_x, step_y = 1, 1
            next_x, next_y, delta_x, delta_y = math.inf, math.inf, math.inf, math.inf
            if dx < 0.0:
                step_x = -1
            if dy < 0.0:
                step_y = -1
            if abs(dx) > PARALLEL:
                delta_x = side / abs(dx)
                next_x = (grid[0] + (column + (step_x > 0)) * side - ox) / dx
            if abs(dy) > PARALLEL:
                delta_y = side / abs(dy)
                next_y = (grid[1] + (row + (step_y > 0)) * side - oy) / dy
            while t_enter < best and 0 <= column < columns and 0 <= row < rows:
                cell = row * columns + column
                for k in range(cell_begin[cell], cell_begin[cell + 1]):
                    t = hit_distance(solids[cell_solids[k]], ox, oy, oz, dx, dy, dz)
                    if t <= best:
                        best, hit, found = t, cell_solids[k], True
                if next_x < next_y:
                    t_enter = next_x
                    next_x += delta_x
                    column += step_x
                else:
                    t_enter = next_y
                    next_y += delta_y
                    row += step_y
        hits[n] = hit
        ranges[n] = best if found else math.inf


@kernel
def surface_distances(p_world: Floats, solids: Floats, distances: Floats) -> None:
    """Unsigned distance of points (N, 3) to the nearest surface of any solid, inside or outside of it."""
    for n in range(p_world.shape[0]):
        best = math.inf
        for s in range(solids.shape[0]):
            solid = solids[s]
            rx, ry, rz = p_world[n, 0] - solid[1], p_world[n, 1] - solid[2], p_world[n, 2] - solid[3]
            if solid[0] == SPHERE:
                signed = math.sqrt(rx * rx + ry * ry + rz * rz) - solid[13]
            else:
                lx = abs(solid[4] * rx + solid[7] * ry + solid[10] * rz)
                ly = abs(solid[5] * rx + solid[8] * ry + solid[11] * rz)
                lz = abs(solid[6] * rx + solid[9] * ry + solid[12] * rz)
                if solid[0] == BOX:
                    qx, qy, qz = lx - solid[13], ly - solid[14], lz - solid[15]
                else:
                    qx, qy, qz = math.sqrt(lx * lx + ly * ly) - solid[13], -math.inf, lz - solid[15]
                outside = math.sqrt(max(qx, 0.0) ** 2 + max(qy, 0.0) ** 2 + max(qz, 0.0) ** 2)
                signed = outside + min(max(qx, qy, qz), 0.0)
            best = min(best, abs(signed))
        distances[n] = best
