"""The vertical of a place that no accelerometer was at, from what is built and grown there. Derivation: docs/slam.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree.tree import IkdTree

Floats = NDArray[np.float64]

_SAMPLES = 3000  # points that a plane is fitted at
_NEIGHBOURS = 10
_REACH = 1.0  # m, of them
_FLAT = 0.1  # thickness of a plane's points against their width, at most
_FEWEST = 100  # planes
_CONE = np.deg2rad(45.0)  # about the guess: beyond it, another axis of a building would be as good
_STEP = np.deg2rad(1.5)  # between directions that are tried
_COARSE, _FINE = np.deg2rad(4.0), np.deg2rad(1.0)  # by which a surface may be off: among directions tried, and at the best
_STEPS = 20
_FAVOUR = 0.05  # of all surfaces: what the guess counts against the rim of the cone, where they leave a direction open


def find_vertical(points: NDArray[np.float32], guess: Floats) -> Floats:
    """(3,) unit direction within 45° of a guess that most surfaces are level with, or upright along.

    Args:
        points: (N, 3) [m]; with few planes among them the guess is all there is.
        guess: (3,) unit, roughly up.
    """
    normals = _normals(points)
    if len(normals) < _FEWEST:
        return guess
    up = _best_of_cone(normals, guess)
    for _ in range(_STEPS):
        # Of a wall (u·n)² is the squared sine of what it is off by, of a floor 1 − (u·n)².
        along = _along(normals, up)
        is_floor = along**2 > 0.5
        off = np.where(is_floor, 1.0 - along**2, along**2)
        weight = np.where(is_floor, -1.0, 1.0) / (1.0 + off / _FINE**2) ** 2
        _, axes = np.linalg.eigh(np.einsum("n,na,nb->ab", weight, normals, normals))
        better = axes[:, 0] * (1.0 if axes[:, 0] @ up > 0.0 else -1.0)
        if better @ guess < np.cos(_CONE):  # walls alone, all of which face the same way
            break
        up, before = better, up
        if up @ before > 1.0 - 1e-14:
            break
    return np.asarray(up)


def _normals(points: NDArray[np.float32]) -> Floats:
    """(M, 3) unit normals where points lie on a plane."""
    if len(points) < _NEIGHBOURS:
        return np.zeros((0, 3))
    chosen = points[:: max(len(points) // _SAMPLES, 1)].astype(np.float64)
    found = IkdTree(points, rebuild="inplace").nearest(chosen, _NEIGHBOURS, max_distance=_REACH)
    near = found.points[found.counts == _NEIGHBOURS]
    near = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.swapaxes(near, 1, 2) @ near)
    is_flat = spread[:, 0] < _FLAT**2 * spread[:, 1]
    return np.asarray(axes[is_flat, :, 0])


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
