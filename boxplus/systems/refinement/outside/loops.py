"""Loops that a run has closed, as measurements between keyframes; and which of them planes tell better.

A loop is a registration of points that refinement sees as well. Where the two stretches share planes, these say what the loop
said, only more exactly, and both together would count the same points twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded
from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.plane_voxels.plane_map import PlaneMap
from boxplus.residuals.relative_pose import RelativePose
from boxplus.systems.refinement.keyframes import Keyframes
from boxplus.systems.refinement.outside.evidence import RunLoops
from boxplus.systems.refinement.planes.sightings import KeyframeClusters

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BY_CHANCE = 1e-4  # probability that any loop of a sound run is named


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeLoops:
    """Loops between keyframes.

    Attributes:
        place, query: (L,) keyframes. residual: of their poses. is_told: (L,) whether planes that both stretches see tell more.
    """

    place: Ints
    query: Ints
    residual: RelativePose
    is_told: NDArray[np.bool_]


def contradicted(errors: Floats) -> NDArray[np.bool_]:
    """(L,) which loops lie beyond their covariance from where refining has put the visits.

    Of many sound loops some are far out by chance: a bound that one alone exceeds once in 10,000 times, a thousand of them would
    exceed in every tenth run. The bound is that of all of them together (Bonferroni).

    Args:
        errors: (L,) what they are off by [standard deviations].

    Example:
        >>> contradicted(np.array([1.0, 5.5])).tolist()
        [False, True]
        >>> bool(contradicted(np.array([5.5] + [2.0] * 999)).any())
        False

    Source: Dunn, Multiple Comparisons Among Means, JASA 1961.
    """
    return np.asarray(errors**2 > chi_square_exceeded(_BY_CHANCE / max(len(errors), 1), 6))


def between_keyframes(
    loops: RunLoops,
    time_ns: Ints,
    T_world_imu: Floats,
    keyframes: Keyframes,
    planes: PlaneMap,
    seen: KeyframeClusters,
    T_imu_lidar: Floats,
) -> KeyframeLoops:
    """Loops between the keyframes that have the frames of their local maps in them.

    Args:
        time_ns: (N,) of the scans, T_world_imu: (N, 7) theirs.
        seen: of `planes`, by keyframes.
    """
    scan = np.clip(np.searchsorted(time_ns, loops.time_ns), 0, len(time_ns) - 1)
    keyframe = keyframes.of_scan[scan]
    T_key = T_world_imu[keyframes.scan[keyframe]]
    T_key_map = se3.compose(se3.compose(se3.inverse(T_key), T_world_imu[scan]), loops.T_imu_map)
    a, b = loops.place, loops.query
    Z = se3.compose(se3.compose(T_key_map[a], loops.T_place_query), se3.inverse(T_key_map[b]))
    # An error on the right of T_place_query is one on the right of Z by the adjoint of the query's frame in its keyframe.
    back = se3.adjoint(se3.inverse(T_key_map[b]))
    information = np.swapaxes(back, 1, 2) @ loops.information @ back
    is_told = _told(loops, time_ns, T_world_imu, keyframes, keyframe[b], planes, seen, T_imu_lidar, information)
    return KeyframeLoops(keyframe[a], keyframe[b], RelativePose(Z, information=information), is_told)


def _told(
    loops: RunLoops,
    time_ns: Ints,
    T_world_imu: Floats,
    keyframes: Keyframes,
    query_keyframe: Ints,
    planes: PlaneMap,
    seen: KeyframeClusters,
    T_imu_lidar: Floats,
    information: Floats,
) -> NDArray[np.bool_]:
    """(L,) whether the planes that both stretches see have more information than the loop, in every direction."""
    T_key = T_world_imu[keyframes.scan]
    middle = 0.5 * (loops.time_ns[1:] + loops.time_ns[:-1])
    stretch = np.searchsorted(middle, time_ns[keyframes.scan])[seen.keyframe]
    T_lidar = se3.compose(T_key, np.broadcast_to(T_imu_lidar, T_key.shape))[seen.keyframe]
    weight = seen.clusters[:, 3, 3]
    result = np.zeros(len(loops), dtype=np.bool_)
    for k, (place, query) in enumerate(zip(loops.place.tolist(), loops.query.tolist(), strict=True)):
        own, there = (
            np.bincount(seen.plane[stretch == number], weight[stretch == number], len(planes)) for number in (query, place)
        )
        rows = np.flatnonzero((stretch == query) & (there[seen.plane] > 0.0))
        if not len(rows):
            continue
        # What the place knows of a plane, the query's clusters share as they have weight on it.
        plane = seen.plane[rows]
        share = np.minimum(1.0, there[plane] / own[plane])
        T = T_key[query_keyframe[k]]
        H = _information(
            seen.clusters[rows] * share[:, None, None],
            se3.compose(se3.inverse(T), T_lidar[rows]),
            planes.planes[plane, :3] @ quaternion.to_matrix(T[:4]),
        )
        result[k] = np.linalg.eigvalsh(H - information[k])[0] >= -1e-9 * np.trace(information[k])
    return result


def _information(clusters: Floats, T: Floats, normals: Floats) -> Floats:
    """(6, 6) of a body's pose, on its right, by clusters (M, 4, 4) in frames at T (M, 7) in it, on planes with normals (M, 3).

    A point p moves along n by nᵀ(w × p + v) = [p × n; n]ᵀ [w; v], which is linear in [p; 1].
    """
    matrix = np.zeros((len(T), 4, 4))
    matrix[:, :3, :3], matrix[:, :3, 3], matrix[:, 3, 3] = quaternion.to_matrix(T[:, :4]), T[:, 4:], 1.0
    J = np.zeros((len(T), 6, 4))
    J[:, :3, :3], J[:, 3:, 3] = -so3.hat(normals), normals
    J = J @ matrix
    return np.asarray(np.einsum("nia,nab,njb->ij", J, clusters, J))
