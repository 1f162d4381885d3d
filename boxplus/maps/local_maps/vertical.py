"""The vertical of a place that no accelerometer was at, from what is built and grown there. Derivation: docs/slam.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree.tree import IkdTree
from boxplus.maps.plane_fit import planes_through
from boxplus.maps.tiles.voxel_thinning import first_per_voxel

Floats = NDArray[np.float64]

_SAMPLES = 3000  # points that a plane is fitted at
_VOXEL = 0.25  # m, of the points that are looked at: those of a finer map are too near each other to tell a plane from noise
_NEIGHBOURS = 40  # that a plane is fitted to, at most: 0.8 m around, where noise of 3 cm leaves it flat
_FEWEST_NEIGHBOURS = 10
_REACH = 1.0  # m, of them
_FLAT = 0.1  # thickness of a plane's points against their width, at most
_FEWEST = 100  # planes
_AGREE = np.deg2rad(5.0)  # of a plane with the direction that is found
_SHARE = 0.35  # of planes that agree, at least: of planes of any direction 12 to 23 % do, where people build 96 %
_DETERMINED = 0.1  # of all planes: what has to hold the direction about the axis that holds it least
_CONE = np.deg2rad(45.0)  # about the guess: beyond it, another axis of a building would be as good
_STEP = np.deg2rad(1.5)  # between directions that are tried
_COARSE, _FINE = np.deg2rad(4.0), np.deg2rad(1.0)  # by which a surface may be off: among directions tried, and at the best
_STEPS = 20
_FAVOUR = 0.05  # of all surfaces: what the guess counts against the rim of the cone, where they leave a direction open


def find_vertical(points: NDArray[np.float32], guess: Floats) -> Floats | None:
    """(3,) unit direction within 45° of a guess that most surfaces are level with, or upright along; None where they show none.

    That takes planes at 100 places, a third of them level or upright to 5°, and among these floors, or walls that face different
    ways: walls that all face one way leave open how far up leans along them. A slope under all that is seen passes for level.

    Args:
        points: (N, 3) [m].
        guess: (3,) unit, roughly up.
    """
    normals = _normals(points)
    if len(normals) < _FEWEST:
        return None
    up = _best_of_cone(normals, guess)
    for _ in range(_STEPS):
        # Of a wall (u·n)² is the squared sine of what it is off by, of a floor 1 − (u·n)².
        is_floor, off = _off(normals, up)
        _, axes = _holding(normals, is_floor, 1.0 / (1.0 + off / _FINE**2) ** 2)
        better = axes[:, 0] * (1.0 if axes[:, 0] @ up > 0.0 else -1.0)
        if better @ guess < np.cos(_CONE):  # walls alone that all face the same way, or up is beyond the cone
            return None
        up, before = better, up
        if up @ before > 1.0 - 1e-14:
            break
    is_floor, off = _off(normals, up)
    agrees = (off < np.sin(_AGREE) ** 2).astype(np.float64)
    holding, _ = _holding(normals, is_floor, agrees)
    is_shown = agrees.mean() >= _SHARE and holding[1] - holding[0] >= _DETERMINED * len(normals)
    return np.asarray(up) if is_shown else None


def _normals(points: NDArray[np.float32]) -> Floats:
    """(M, 3) unit normals where points lie on a plane."""
    points = np.ascontiguousarray(points[first_per_voxel(points, _VOXEL)])
    if len(points) < _FEWEST_NEIGHBOURS:
        return np.zeros((0, 3))
    chosen = points[:: max(len(points) // _SAMPLES, 1)].astype(np.float64)
    found = IkdTree(points, rebuild="inplace").nearest(chosen, _NEIGHBOURS, max_distance=_REACH)
    enough = found.counts >= _FEWEST_NEIGHBOURS
    planes = planes_through(found.points[enough], found.counts[enough])
    return np.asarray(planes.normals[planes.thickness_sq < _FLAT**2 * planes.width_sq])


def _off(normals: Floats, up: Floats) -> tuple[NDArray[np.bool_], Floats]:
    """(M,) whether each is rather a floor than a wall; (M,) squared sine of what it is off by."""
    along = _along(normals, up) ** 2
    return along > 0.5, np.minimum(along, 1.0 - along)


def _holding(normals: Floats, is_floor: NDArray[np.bool_], weight: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues, ascending, and eigenvectors of the sum over walls less that over floors; the first vector fits best."""
    signed = np.where(is_floor, -weight, weight)
    values, axes = np.linalg.eigh(np.einsum("n,na,nb->ab", signed, normals, normals))
    return np.asarray(values), np.asarray(axes)


def _along(normals: Floats, up: Floats) -> Floats:
    """(M,) components along a direction; written out, as a product of matrices adds up as the number of its threads has it."""
    return np.asarray(normals[:, 0] * up[0] + normals[:, 1] * up[1] + normals[:, 2] * up[2])


def _best_of_cone(normals: Floats, guess: Floats) -> Floats:
    """The direction on a grid about the guess that most normals are along or across."""
    across = np.eye(3)[int(np.argmin(np.abs(guess)))]
    x = np.cross(guess, across) / np.linalg.norm(np.cross(guess, across))
    y = np.cross(guess, x)
    steps = np.arange(-_CONE, _CONE + 0.5 * _STEP, _STEP)
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    tilt = np.hypot(a, b)
    a, b, tilt = a[tilt <= _CONE], b[tilt <= _CONE], tilt[tilt <= _CONE]
    far = np.sinc(tilt / np.pi)  # sin(tilt) / tilt
    tried = np.cos(tilt)[:, None] * guess + far[:, None] * (a[:, None] * x + b[:, None] * y)
    score = np.empty(len(tried))
    for k, up in enumerate(tried):
        along = _along(normals, up) ** 2
        score[k] = np.exp(-0.5 * np.minimum(along, 1.0 - along) / _COARSE**2).sum()
    return np.asarray(tried[int(np.argmax(score - _FAVOUR * len(normals) * tilt / _CONE))])
