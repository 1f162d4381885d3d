"""What scans see of planes, for the two levels of refinement and for the verdict on it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.maps.plane_voxels.plane_map import PlaneMap, find_planes
from boxplus.maps.plane_voxels.thickness import Sharpness, sharpness
from boxplus.maps.plane_voxels.voxel_sums import VoxelSums
from boxplus.residuals.planes.pose_quadratic import add_plane_forms
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.keyframes import Keyframes
from boxplus.systems.refinement.planes.sums_on_planes import add_to_sides, add_weighed, moved_clusters, points_that, sighted

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LEAST_FACING = 0.05  # squared cosine of the angle at which a plane is seen
_SMOOTH = 0.005  # m, thickness of a plane that is never too rough
_LEAST_SIGMA = 0.002  # m, of a distance from a plane
_SAME_POSITION, _SAME_TURN, _SAME_SECONDS = 0.02, 0.004, 0.2  # m, rad: standing still, which weighs as much as so many seconds


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeClusters:
    """M clusters of points of keyframes on planes.

    Attributes:
        keyframe, plane: (M,) whose.
        clusters: (M, 4, 4) Σ w [ℓ; 1][ℓ; 1]ᵀ in the keyframe's LiDAR frame, divided by the variance of a distance.
        counted: (M,) mean of the weights w of its points, by `weights_of_slices`.
    """

    keyframe: Ints
    plane: Ints
    clusters: Floats
    counted: Floats


def lidar_poses(T_world_imu: Floats, T_imu_lidar: Floats) -> Floats:
    """(N, 7) T_world_lidar."""
    return se3.compose(T_world_imu, np.broadcast_to(T_imu_lidar, T_world_imu.shape))


def planes_of(run: FinishedRun, T_lidar: Floats, keyframes: Keyframes, config: RefinementConfig) -> tuple[PlaneMap, Floats]:
    """The planes of the map as it is, each through all the points that lie on it, and the information of one point on each (P,).

    It is zero where the plane is thicker than the noise of the range makes one that is seen under its angles: what is curved is
    no plane.

    What a plane is not flat by, a keyframe sees with all of its points alike: with σ_f of `config.plane_flatness` and n points a
    keyframe, their mean is known to σ²/n + σ_f², as if each of them had the variance σ² + n σ_f².
    """
    voxels = VoxelSums(config.smallest_voxel)
    R, p = quaternion.to_matrix(T_lidar[:, :4]), T_lidar[:, 4:]
    for number, points in enumerate(run.points):
        if len(points):
            voxels.add(points_that(points, judge=False), R[number], p[number], int(keyframes.of_scan[number]))
    planes = find_planes(voxels, config)
    del voxels
    world = np.zeros((2, len(planes), 4, 4))  # seen from behind, and from before
    facing = np.zeros((2, len(planes)))  # sum over points of the squared cosine of the angle at which the plane is seen
    latest, seen_by = np.full((2, len(planes)), -1), np.zeros((2, len(planes)))
    for seen in sighted(run.points, T_lidar, planes, config.threads):
        scan, plane = seen.scan, seen.plane
        side = planes.seen_from(p[scan], plane)
        mean = seen.clusters[:, :3, 3] / seen.clusters[:, 3:, 3]
        normal = np.einsum("kji,kj->ki", R[scan], planes.planes[plane, :3])
        share = np.einsum("ki,ki->k", normal, mean) ** 2 / np.einsum("ki,ki->k", mean, mean)
        moved = moved_clusters(seen.clusters, R[scan], p[scan] - planes.centres[plane])
        add_to_sides(side, plane, keyframes.of_scan[scan], moved, share, world, facing, latest, seen_by)
    side = np.argmax(world[:, :, 3, 3], axis=0)
    own_side = side, np.arange(len(planes))
    world, facing, seen_by = world[own_side], facing[own_side], seen_by[own_side]
    planes = planes.refitted(world, side)
    count = world[:, 3, 3]
    facing = np.maximum(facing / np.maximum(count, 1.0), _LEAST_FACING)
    usual = np.maximum(facing * _usual(planes.thickness**2 / facing, count), _SMOOTH**2)
    is_rough = planes.thickness**2 > config.plane_roughness**2 * usual
    each = count / np.maximum(seen_by, 1.0)
    variance = np.maximum(planes.thickness, _LEAST_SIGMA) ** 2 + each * config.plane_flatness**2
    return planes, np.where(is_rough, 0.0, 1.0 / variance)


def weights_of_slices(run: FinishedRun) -> Floats:
    """(N,) what the points of a slice count: less than one where the body stands still for longer than 0.2 s.

    The same rays meet the same spots again and again, and planes are found through what they meet: a sector of the scan and its
    planes may be tilted together, and every further turn at rest would make that seem as certain as if something new were seen.
    """
    T, weights, begin = run.T_world_imu, np.ones(len(run)), 0
    seconds, turn = (run.time_ns - run.time_ns[0]) * 1e-9, np.cos(0.5 * _SAME_TURN)
    for k in range(1, len(run) + 1):
        is_there = (
            k < len(run) and np.linalg.norm(T[k, 4:] - T[begin, 4:]) <= _SAME_POSITION and abs(T[k, :4] @ T[begin, :4]) >= turn
        )
        if not is_there:
            weights[begin:k] = min(_SAME_SECONDS / max(float(seconds[k - 1] - seconds[begin]), _SAME_SECONDS), 1.0)
            begin = k
    return weights


def keyframe_clusters(
    run: FinishedRun, T_lidar: Floats, keyframes: Keyframes, planes: PlaneMap, information: Floats, threads: int = 1
) -> KeyframeClusters:
    """What every keyframe sees with the scans around it, of the planes that two keyframes see."""
    relative = se3.compose(se3.inverse(T_lidar[keyframes.scan[keyframes.of_scan]]), T_lidar)
    R_key, p_key = quaternion.to_matrix(relative[:, :4]), relative[:, 4:]
    weights = weights_of_slices(run)
    keyframe: list[Ints] = []
    plane: list[Ints] = []
    clusters: list[Floats] = []
    counted: list[Floats] = []
    begins = np.flatnonzero(np.diff(keyframes.of_scan, prepend=-1))  # no keyframe is cut in two
    for seen in sighted(run.points, T_lidar, planes, threads, begins):
        useful = information[seen.plane] > 0.0
        k, number = seen.scan[useful], seen.plane[useful]
        if not len(k):
            continue
        key, of = np.unique(keyframes.of_scan[k] * len(planes) + number, return_inverse=True)
        total, squares = np.zeros((len(key), 4, 4)), np.zeros(len(key))
        add_weighed(of, moved_clusters(seen.clusters[useful], R_key[k], p_key[k]), weights[k], total, squares)
        keyframe.append(key // len(planes))
        plane.append(key % len(planes))
        clusters.append(total * information[plane[-1], None, None])
        counted.append(squares / total[:, 3, 3])
    if not keyframe:
        return KeyframeClusters(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros(0))
    all_planes = np.concatenate(plane)
    often = (np.bincount(all_planes, minlength=len(planes)) >= 2)[all_planes]
    return KeyframeClusters(
        np.concatenate(keyframe)[often],
        all_planes[often],
        np.concatenate(clusters)[often],
        np.concatenate(counted)[often],
    )


def scan_forms(
    run: FinishedRun, T_world_imu: Floats, T_imu_lidar: Floats, planes: PlaneMap, information: Floats, threads: int = 1
) -> Floats:
    """Q (N, 13, 13) of every scan on the planes (P,), for `PoseQuadratic` about the poses' positions; none where it is zero."""
    R_L, p_L = quaternion.to_matrix(T_imu_lidar[:4]), T_imu_lidar[4:]
    forms, weights = np.zeros((len(run), 13, 13)), weights_of_slices(run)
    for seen in sighted(run.points, lidar_poses(T_world_imu, T_imu_lidar), planes, threads):
        useful = information[seen.plane] > 0.0
        k, number = seen.scan[useful], seen.plane[useful]
        count = len(k)
        body = moved_clusters(seen.clusters[useful], np.broadcast_to(R_L, (count, 3, 3)), np.broadcast_to(p_L, (count, 3)))
        body *= (weights[k] * information[number])[:, None, None]
        normals = planes.planes[number, :3]
        offsets = np.einsum("ki,ki->k", normals, T_world_imu[k, 4:] - planes.centres[number]) + planes.planes[number, 3]
        begins = np.flatnonzero(np.diff(k, prepend=-1))
        for begin, end in pairwise([*begins.tolist(), count]):
            add_plane_forms(body[begin:end], normals[begin:end], offsets[begin:end], forms[k[begin]])
    return forms


def judge(run: FinishedRun, T_before: Floats, T_after: Floats, planes: PlaneMap, threads: int = 1) -> tuple[Sharpness, Sharpness]:
    """The sharpness of the points that took no part, before and after, on planes that were found before; LiDAR poses (N, 7)."""
    world = np.zeros((2, len(planes), 4, 4))
    poses = [(quaternion.to_matrix(T[:, :4]), T[:, 4:]) for T in (T_before, T_after)]
    for seen in sighted(run.points, T_before, planes, threads, judge=True):
        for side, (R, p) in enumerate(poses):
            moved = moved_clusters(seen.clusters, R[seen.scan], p[seen.scan] - planes.centres[seen.plane])
            add_weighed(seen.plane, moved, np.ones(len(moved)), world[side], np.zeros(len(planes)))
    variance = np.maximum(planes.thickness, _LEAST_SIGMA) ** 2
    return sharpness(world[0], variance), sharpness(world[1], variance)


def _usual(values: Floats, weights: Floats) -> float:
    """The weighted median."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])]) if len(values) and total[-1] > 0.0 else np.inf
