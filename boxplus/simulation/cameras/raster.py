"""Kernels: what every pixel of a camera sees.

The image is divided into tiles. The solids that any ray of a tile may meet are listed, the nearest first, by the cone around its
rays; a ray then asks only these, and stops where nothing nearer can follow. Rows may have poses of their own (a rolling shutter).
Where neighbours see different faces, the pixel is the mean of nine rays; elsewhere one ray sees the texture through the
footprint of its pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.simulation.cameras.textures import Pictures, read_filtered, read_round
from boxplus.simulation.worlds.raycast import BOX, SPHERE, hit_distance

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]

TILE, BLOCK = 16, 128
NOTHING = np.uint32(0xFFFFFFFF)
SURFACE_WIDTH = 7  # of a row for each solid: picture, shifts x and y, albedo, contrast, direction of the picture's x axis
_COARSER = 6.37  # the second reading, which keeps the period of the picture from showing
_COARSE_SHARE = 0.35
_SUN = (0.42, 0.31, 0.85)
_AMBIENT, _DIFFUSE = 0.62, 0.38
_SUBPIXELS = 3
_WIDEST = 1.5  # opening of a cone up to which planes touch it [rad]


@kernel(inline=True)
def _world_ray(R: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A direction of the camera in the world, of length one."""
    dx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
    dy = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
    dz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    scale = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * scale, dy * scale, dz * scale


@kernel(borrow=True)
def _cone(
    directions: Floats, R: Floats, p: Floats, i0: int, i1: int, j0: int, j1: int
) -> tuple[float, float, float, float, float]:
    """Axis and opening [rad] of the cone around the rays of a part of the image, negative where it has none, and how far
    the rays' origins are apart [m]."""
    ax, ay, az = 0.0, 0.0, 0.0
    for i in range(i0, i1):
        for j in range(j0, j1):
            if directions[i, j, 2] != 0.0 or directions[i, j, 0] != 0.0:
                wx, wy, wz = _world_ray(R[i], directions[i, j, 0], directions[i, j, 1], directions[i, j, 2])
                ax, ay, az = ax + wx, ay + wy, az + wz
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if norm <= 0.0:
        return 0.0, 0.0, 1.0, -1.0, 0.0
    ax, ay, az = ax / norm, ay / norm, az / norm
    least = 1.0
    for i in range(i0, i1):
        for j in range(j0, j1):
            if directions[i, j, 2] != 0.0 or directions[i, j, 0] != 0.0:
                wx, wy, wz = _world_ray(R[i], directions[i, j, 0], directions[i, j, 1], directions[i, j, 2])
                least = min(least, wx * ax + wy * ay + wz * az)
    middle = (i0 + i1) // 2
    wander = 0.0
    for i in range(i0, i1):
        ex, ey, ez = p[i, 0] - p[middle, 0], p[i, 1] - p[middle, 1], p[i, 2] - p[middle, 2]
        wander = max(wander, math.sqrt(ex * ex + ey * ey + ez * ez))
    # Pixels have corners, and rays between the middles of the pixels are cast as well.
    return ax, ay, az, 1.1 * math.acos(max(least, -1.0)) + 2e-3, wander


@kernel(inline=True)
def _local(solid: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector of the world in the frame of a solid."""
    return (
        solid[4] * x + solid[7] * y + solid[10] * z,
        solid[5] * x + solid[8] * y + solid[11] * z,
        solid[6] * x + solid[9] * y + solid[12] * z,
    )


@kernel(inline=True)
def _distance_before(
    solids: Floats, k: int, ox: float, oy: float, oz: float, ax: float, ay: float, az: float, opening: float, wander: float
) -> float:
    """A distance before which a solid is not met by the rays of a cone [m], negative where it is not met at all."""
    rx, ry, rz = solids[k, 1] - ox, solids[k, 2] - oy, solids[k, 3] - oz
    distance = math.sqrt(rx * rx + ry * ry + rz * rz)
    radius = solids[k, 16] + wander
    near: float = max(distance - radius, 0.0)
    if near > 0.0:
        largest = opening + math.asin(radius / distance)
        if largest < math.pi and (rx * ax + ry * ay + rz * az) < distance * math.cos(largest):
            return -1.0
    if solids[k, 0] != BOX:
        return near
    # A long box fills little of its ball: is it beyond one of four planes that touch the cone, and how far is it?
    solid = solids[k]
    lx, ly, lz = _local(solid, rx, ry, rz)
    ex, ey, ez = max(abs(lx) - solid[13], 0.0), max(abs(ly) - solid[14], 0.0), max(abs(lz) - solid[15], 0.0)
    near = max(near, math.sqrt(ex * ex + ey * ey + ez * ez) - wander)
    if opening < _WIDEST:
        bx, by, bz = _local(solid, ax, ay, az)
        s, c = math.sin(opening), math.cos(opening)
        # Two directions across the axis, from the coordinate that it has least of.
        if abs(bx) <= abs(by) and abs(bx) <= abs(bz):
            ux, uy, uz = 0.0, -bz, by
        elif abs(by) <= abs(bz):
            ux, uy, uz = bz, 0.0, -bx
        else:
            ux, uy, uz = -by, bx, 0.0
        scale = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux * scale, uy * scale, uz * scale
        vx, vy, vz = by * uz - bz * uy, bz * ux - bx * uz, bx * uy - by * ux
        for side in range(4):
            sign = 1.0 - 2.0 * (side & 1)
            tx, ty, tz = (ux, uy, uz) if side < 2 else (vx, vy, vz)
            nx, ny, nz = sign * c * tx - s * bx, sign * c * ty - s * by, sign * c * tz - s * bz
            reach = abs(nx) * solid[13] + abs(ny) * solid[14] + abs(nz) * solid[15]
            if nx * lx + ny * ly + nz * lz - reach > wander:
                return -1.0
    return near


@kernel(borrow=True)
def list_solids(
    directions: Floats, R: Floats, p: Floats, solids: Floats,
    tile_begin: Indices, tile_end: Indices, tile_solids: Indices, tile_near: Floats, scratch: Indices,
) -> int:  # fmt: skip
    """The solids that rays of each tile may meet, nearest first.

    Args:
        directions: (H, W, 3) unit vectors in the camera frame, zero where the lens sees nothing.
        R, p: (H, 3, 3), (H, 3) pose of the camera in the world for each row.
        solids: (S, 18), see raycast.py.
        tile_begin, tile_end: (T,) out; tiles are counted row by row.
        tile_solids, tile_near: (N,) out, the solids and a distance before which none of them is met [m].
        scratch: (S,) for the kernel's own use.

    Returns:
        How many entries there are; when more than N, nothing beyond N was written.
    """
    height, width = directions.shape[0], directions.shape[1]
    tiles_across = (width + TILE - 1) // TILE
    count = 0
    capacity = tile_solids.shape[0]
    for I0 in range(0, height, BLOCK):
        for J0 in range(0, width, BLOCK):
            I1, J1 = min(I0 + BLOCK, height), min(J0 + BLOCK, width)
            ax, ay, az, opening, wander = _cone(directions, R, p, I0, I1, J0, J1)
            middle = (I0 + I1) // 2
            candidates = 0
            for k in range(solids.shape[0]):
                near = _distance_before(solids, k, p[middle, 0], p[middle, 1], p[middle, 2], ax, ay, az, opening, wander)
                if near >= 0.0 and opening >= 0.0:
                    scratch[candidates] = k
                    candidates += 1
            for i0 in range(I0, I1, TILE):
                for j0 in range(J0, J1, TILE):
                    i1, j1 = min(i0 + TILE, height), min(j0 + TILE, width)
                    ax, ay, az, opening, wander = _cone(directions, R, p, i0, i1, j0, j1)
                    middle = (i0 + i1) // 2
                    tile = (i0 // TILE) * tiles_across + j0 // TILE
                    first = count
                    for c in range(candidates if opening >= 0.0 else 0):
                        k = scratch[c]
                        near = _distance_before(solids, k, p[middle, 0], p[middle, 1], p[middle, 2], ax, ay, az, opening, wander)
                        if near >= 0.0:
                            if count < capacity:
                                at = count
                                while at > first and tile_near[at - 1] > near:
                                    tile_near[at], tile_solids[at] = tile_near[at - 1], tile_solids[at - 1]
                                    at -= 1
                                tile_near[at], tile_solids[at] = near, k
                            count += 1
                    tile_begin[tile], tile_end[tile] = min(first, capacity), min(count, capacity)
    return count


@kernel(inline=True)
def _nearest(
    solids: Floats, listed: Indices, near: Floats, begin: int, end: int,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, farthest: float,
) -> tuple[float, np.uint32]:  # fmt: skip
    best = farthest
    hit = NOTHING
    for k in range(begin, end):
        if near[k] > best:
            break
        t = hit_distance(solids[listed[k]], ox, oy, oz, dx, dy, dz)
        if t < best:
            best, hit = t, listed[k]
    return best, hit


@kernel(inline=True)
def _face(solid: Floats, lx: float, ly: float, lz: float) -> int:
    """Which face of a solid a point of its surface lies on: 0 to 2 by the axis of its normal, 3 for what is curved."""
    if solid[0] == BOX:
        ex = solid[13] - abs(lx)
        ey = solid[14] - abs(ly)
        ez = solid[15] - abs(lz)
        if ex <= ey and ex <= ez:
            return 0
        return 1 if ey <= ez else 2
    if solid[0] == SPHERE:
        ax, ay, az = abs(lx), abs(ly), abs(lz)
        if ax >= ay and ax >= az:
            return 0
        return 1 if ay >= az else 2
    return 2 if solid[15] - abs(lz) < solid[13] - math.sqrt(lx * lx + ly * ly) else 3


@kernel(borrow=True)
def cast_pixels(
    directions: Floats, R: Floats, p: Floats, solids: Floats,
    tile_begin: Indices, tile_end: Indices, tile_solids: Indices, tile_near: Floats,
    farthest: float, ranges: Floats, faces: Indices,
) -> None:  # fmt: skip
    """Distance along the ray (H, W) [m], infinite where there is nothing, and 4 · solid + face (H, W), `NOTHING` there."""
    height, width = directions.shape[0], directions.shape[1]
    tiles_across = (width + TILE - 1) // TILE
    for i in range(height):
        ox, oy, oz = p[i, 0], p[i, 1], p[i, 2]
        for j in range(width):
            ranges[i, j] = math.inf
            faces[i, j] = NOTHING
            if directions[i, j, 2] == 0.0 and directions[i, j, 0] == 0.0:
                continue
            tile = (i // TILE) * tiles_across + j // TILE
            dx, dy, dz = _world_ray(R[i], directions[i, j, 0], directions[i, j, 1], directions[i, j, 2])
            t, hit = _nearest(solids, tile_solids, tile_near, tile_begin[tile], tile_end[tile], ox, oy, oz, dx, dy, dz, farthest)
            if hit != NOTHING:
                solid = solids[hit]
                lx, ly, lz = _local(solid, ox + t * dx - solid[1], oy + t * dy - solid[2], oz + t * dz - solid[3])
                ranges[i, j] = t
                faces[i, j] = np.uint32(4) * hit + np.uint32(_face(solid, lx, ly, lz))


@kernel
def _sky(dz: float) -> float:
    return 0.75 + 0.2 * max(dz, 0.0)


@kernel(borrow=True, fastmath=True, inline=True)
def _radiance(
    solid: Floats, surface: Floats, pyramids: Pictures, offsets: Indices, pixels_per_m: float, t: float,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float,
    ux: float, uy: float, uz: float, vx: float, vy: float, vz: float,
) -> float:  # fmt: skip
    """Light that comes back along a ray; (ux, uy, uz) and (vx, vy, vz): by how much the ray turns from pixel to pixel."""
    lx, ly, lz = _local(solid, ox + t * dx - solid[1], oy + t * dy - solid[2], oz + t * dz - solid[3])
    ex, ey, ez = _local(solid, dx, dy, dz)
    face = _face(solid, lx, ly, lz)
    nx, ny, nz = 0.0, 0.0, 0.0
    if solid[0] == SPHERE:
        nx, ny, nz = lx / solid[13], ly / solid[13], lz / solid[13]
    elif face == 0:
        nx = 1.0
    elif face == 1:
        ny = 1.0
    elif face == 2:
        nz = 1.0
    else:
        nx, ny = lx / solid[13], ly / solid[13]
    facing = nx * ex + ny * ey + nz * ez
    if facing > 0.0:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    facing = min(facing, -1e-3)
    # Where the neighbours' rays meet the plane that touches the surface here.
    aux, auy, auz = _local(solid, ux, uy, uz)
    avx, avy, avz = _local(solid, vx, vy, vz)
    su, sv = (nx * aux + ny * auy + nz * auz) / facing, (nx * avx + ny * avy + nz * avz) / facing
    pux, puy, puz = t * (aux - su * ex), t * (auy - su * ey), t * (auz - su * ez)
    pvx, pvy, pvz = t * (avx - sv * ex), t * (avy - sv * ey), t * (avz - sv * ez)
    if face == 0:
        a, b, au, bu, av, bv = ly, lz, puy, puz, pvy, pvz
    elif face == 1:
        a, b, au, bu, av, bv = lx, lz, pux, puz, pvx, pvz
    elif face == 2:
        a, b, au, bu, av, bv = lx, ly, pux, puy, pvx, pvy
    else:  # around a cylinder
        a, b = math.atan2(ly, lx) * solid[13], lz
        au, bu, av, bv = nx * puy - ny * pux, puz, nx * pvy - ny * pvx, pvz
    k = pixels_per_m
    c, s = surface[5], surface[6]
    x, y = k * (c * a + s * b) + surface[1] + 97.0 * face, k * (c * b - s * a) + surface[2] + 211.0 * face
    xu, yu, xv, yv = k * (c * au + s * bu), k * (c * bu - s * au), k * (c * av + s * bv), k * (c * bv - s * av)
    fine, width = read_filtered(pyramids, offsets, np.uint32(surface[0]), x, y, xu, yu, xv, yv)
    q = 1.0 / _COARSER
    coarse = read_round(pyramids, offsets, np.uint32(0), q * width, q * y + 31.0, q * x)
    pattern = (1.0 - _COARSE_SHARE) * fine + _COARSE_SHARE * coarse - 0.5
    wx = solid[4] * nx + solid[5] * ny + solid[6] * nz
    wy = solid[7] * nx + solid[8] * ny + solid[9] * nz
    wz = solid[10] * nx + solid[11] * ny + solid[12] * nz
    light = _AMBIENT + _DIFFUSE * (0.5 + 0.5 * (wx * _SUN[0] + wy * _SUN[1] + wz * _SUN[2]))
    radiance: float = light * surface[3] * (1.0 + 2.0 * surface[4] * pattern)
    return radiance


@kernel(inline=True)
def _at_border(faces: Indices, i: int, j: int) -> bool:
    here = faces[i, j]
    for k in range(max(i - 1, 0), min(i + 2, faces.shape[0])):
        for m in range(max(j - 1, 0), min(j + 2, faces.shape[1])):
            if faces[k, m] != here:
                return True
    return False


@kernel(borrow=True, fastmath=True)
def shade_pixels(
    directions: Floats, right: Floats, down: Floats, R: Floats, p: Floats, solids: Floats, surfaces: Floats,
    pyramids: Pictures, offsets: Indices, pixels_per_m: float,
    tile_begin: Indices, tile_end: Indices, tile_solids: Indices, tile_near: Floats, farthest: float,
    ranges: Floats, faces: Indices, radiance: NDArray[np.float32],
) -> None:  # fmt: skip
    """Adds what every pixel sees to `radiance` (H, W).

    Args:
        directions, right, down: (H, W, 3) as in `list_solids`, and their differences from pixel to pixel.
        surfaces: (S, SURFACE_WIDTH).
        pyramids, offsets: see textures.py.
        pixels_per_m: of the pictures on the surfaces.
        ranges, faces: from `cast_pixels`.
    """
    height, width = directions.shape[0], directions.shape[1]
    tiles_across = (width + TILE - 1) // TILE
    for i in range(height):
        ox, oy, oz = p[i, 0], p[i, 1], p[i, 2]
        for j in range(width):
            x, y, z = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
            if z == 0.0 and x == 0.0:
                continue
            border = _at_border(faces, i, j)
            if not border and faces[i, j] == NOTHING:
                radiance[i, j] += _sky(_world_ray(R[i], x, y, z)[2])
                continue
            ux, uy, uz = _turned(R[i], right[i, j])
            vx, vy, vz = _turned(R[i], down[i, j])
            if not border:
                dx, dy, dz = _world_ray(R[i], x, y, z)
                hit = faces[i, j] >> np.uint32(2)
                radiance[i, j] += _radiance(
                    solids[hit], surfaces[hit], pyramids, offsets, pixels_per_m, ranges[i, j],
                    ox, oy, oz, dx, dy, dz, ux, uy, uz, vx, vy, vz,
                )  # fmt: skip
                continue
            tile = (i // TILE) * tiles_across + j // TILE
            total = 0.0
            for a in range(_SUBPIXELS):
                for b in range(_SUBPIXELS):
                    fu, fv = (b + 0.5) / _SUBPIXELS - 0.5, (a + 0.5) / _SUBPIXELS - 0.5
                    dx, dy, dz = _world_ray(
                        R[i], x + fu * right[i, j, 0] + fv * down[i, j, 0], y + fu * right[i, j, 1] + fv * down[i, j, 1],
                        z + fu * right[i, j, 2] + fv * down[i, j, 2],
                    )  # fmt: skip
                    t, hit = _nearest(
                        solids, tile_solids, tile_near, tile_begin[tile], tile_end[tile],
                        ox, oy, oz, dx, dy, dz, farthest,
                    )  # fmt: skip
                    if hit == NOTHING:
                        total += _sky(dz)
                    else:
                        total += _radiance(
                            solids[hit], surfaces[hit], pyramids, offsets, pixels_per_m, t,
                            ox, oy, oz, dx, dy, dz, ux, uy, uz, vx, vy, vz,
                        )  # fmt: skip
            radiance[i, j] += total / (_SUBPIXELS * _SUBPIXELS)


@kernel(inline=True)
def _turned(R: Floats, d: Floats) -> tuple[float, float, float]:
    return (
        R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2],
        R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2],
        R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2],
    )
