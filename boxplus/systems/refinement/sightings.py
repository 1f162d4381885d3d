"""What scans see of planes: points are gone through once for each question, and none is kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_JUDGED = 5  # of so many points one takes no part and judges the result
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
    for k, R, p, points in _placed(run, T_lidar, judging=False):
        voxels.add(points, R, p, int(keyframes.of_scan[k]))
    planes = find_planes(voxels, config)
    world = np.zeros((2, len(planes), 4, 4))  # seen from behind, and from before
    facing = np.zeros((2, len(planes)))  # sum over points of the squared cosine of the angle at which the plane is seen
    latest, seen_by = np.full((2, len(planes)), -1), np.zeros((2, len(planes)))
    for k, R, p, points in _placed(run, T_lidar, judging=False):
        found, own = planes.clusters_of(points, R, p)
        at = planes.seen_from(p, found), found
        world[at] += _moved(own, R, p - planes.centres[found])
        seen_by[at] += latest[at] != keyframes.of_scan[k]
        latest[at] = keyframes.of_scan[k]
        mean = own[:, :3, 3] / own[:, 3:, 3]
        along = np.einsum("ki,ki->k", planes.planes[found, :3] @ R, mean) / np.linalg.norm(mean, axis=1)
        facing[at] += own[:, 3, 3] * along**2
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
    run: FinishedRun, T_lidar: Floats, keyframes: Keyframes, planes: PlaneMap, information: Floats
) -> KeyframeClusters:
    """What every keyframe sees with the scans around it, of the planes that two keyframes see."""
    relative = se3.compose(se3.inverse(T_lidar[keyframes.scan[keyframes.of_scan]]), T_lidar)
    R_key, p_key = quaternion.to_matrix(relative[:, :4]), relative[:, 4:]
    total, weights = np.zeros((len(planes), 4, 4)), weights_of_slices(run)
    keyframe: list[Ints] = []
    plane: list[Ints] = []
    clusters: list[Floats] = []
    counted: list[Floats] = []
    squares = np.zeros(len(planes))  # Σ w² of the points
    touched: list[Ints] = []  # planes of the keyframe that is gone through

    def close(number: int) -> None:
        seen = np.unique(np.concatenate(touched)) if touched else np.zeros(0, dtype=np.int64)
        touched.clear()
        keyframe.append(np.full(len(seen), number))
        plane.append(seen)
        clusters.append(total[seen] * information[seen, None, None])
        counted.append(squares[seen] / total[seen, 3, 3])
        total[seen], squares[seen] = 0.0, 0.0

    current = 0
    for k, R, p, points in _placed(run, T_lidar, judging=False):
        if keyframes.of_scan[k] != current:
            close(current)
            current = int(keyframes.of_scan[k])
        found, own = planes.clusters_of(points, R, p)
        total[found] += weights[k] * _moved(own, R_key[k], np.broadcast_to(p_key[k], (len(found), 3)))
        squares[found] += weights[k] ** 2 * own[:, 3, 3]
        touched.append(found)
    close(current)
    all_planes = np.concatenate(plane)
    often = (np.bincount(all_planes, minlength=len(planes)) >= 2)[all_planes] & (information[all_planes] > 0.0)
    return KeyframeClusters(
        np.concatenate(keyframe)[often],
        all_planes[often],
        np.concatenate(clusters)[often],
        np.concatenate(counted)[often],
    )


def scan_forms(run: FinishedRun, T_world_imu: Floats, T_imu_lidar: Floats, planes: PlaneMap, information: Floats) -> Floats:
    """Q (N, 13, 13) of every scan on the planes (P,), for `PoseQuadratic` about the poses' positions; none where it is zero."""
    R_L, p_L = quaternion.to_matrix(T_imu_lidar[:4]), T_imu_lidar[4:]
    forms, weights = np.zeros((len(run), 13, 13)), weights_of_slices(run)
    for k, R, p, points in _placed(run, lidar_poses(T_world_imu, T_imu_lidar), judging=False):
        found, own = planes.clusters_of(points, R, p)
        seen = information[found] > 0.0
        found = found[seen]
        body = _moved(own[seen], R_L, np.broadcast_to(p_L, (len(found), 3))) * (weights[k] * information[found, None, None])
        normals = planes.planes[found, :3]
        offsets = np.einsum("ki,ki->k", normals, T_world_imu[k, 4:] - planes.centres[found]) + planes.planes[found, 3]
        add_plane_forms(body, normals, offsets, forms[k])
    return forms


def judge(run: FinishedRun, T_before: Floats, T_after: Floats, planes: PlaneMap) -> tuple[Sharpness, Sharpness]:
    """The sharpness of the points that took no part, before and after, on planes that were found before; LiDAR poses (N, 7)."""
    world = np.zeros((2, len(planes), 4, 4))
    R_after, p_after = quaternion.to_matrix(T_after[:, :4]), T_after[:, 4:]
    for k, R, p, points in _placed(run, T_before, judging=True):
        found, own = planes.clusters_of(points, R, p)
        for side, (turn, shift) in enumerate(((R, p), (R_after[k], p_after[k]))):
            world[side, found] += _moved(own, turn, shift - planes.centres[found])
    variance = np.maximum(planes.thickness, _LEAST_SIGMA) ** 2
    return sharpness(world[0], variance), sharpness(world[1], variance)


def _placed(run: FinishedRun, T_lidar: Floats, *, judging: bool) -> Iterator[tuple[int, Floats, Floats, NDArray[np.float32]]]:
    """Scan by scan its number, R, p, and the points that take part, or those that judge."""
    R = quaternion.to_matrix(T_lidar[:, :4])
    for k, points in enumerate(run.points):
        if len(points):
            chosen = (np.arange(len(points)) % _JUDGED == 0) == judging
            yield k, R[k], T_lidar[k, 4:], np.ascontiguousarray(points[chosen])


def _usual(values: Floats, weights: Floats) -> float:
    """The weighted median."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])]) if len(values) and total[-1] > 0.0 else np.inf


def _moved(clusters: Floats, R: Floats, p: Floats) -> Floats:
    """Σ [x; 1][x; 1]ᵀ (k, 4, 4) of points moved to R x + p, with one p (k, 3) for each cluster."""
    T = np.zeros((len(clusters), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, p, 1.0
    moved: Floats = T @ clusters @ np.swapaxes(T, 1, 2)
    return moved
