"""Corners followed from image to image, through OpenCV, as bearings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.cameras import CameraModel

_CORNERS = 300
_WINDOW = (21, 21)
_LEVELS = 4
_THERE_AND_BACK_PX = 0.5
_FEWEST = 50


class Turned(NamedTuple):
    """How a camera turned between two images, and what shows it.

    Attributes:
        R_2_1: (3, 3) directions in the frame of the first image to that of the second.
        before, after: (N, 2) pixels of the corners that agree on it.
        followed: how many corners were followed.
    """

    R_2_1: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    followed: int


def follow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) of corners in the first image, and where they are in the second, those that are found again both ways."""
    cv2 = require("cv2", "which follows corners")
    none = np.zeros((0, 2))
    corners = cv2.goodFeaturesToTrack(first, _CORNERS, 0.01, 12.0)
    if corners is None:
        return none, none
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=_WINDOW, maxLevel=_LEVELS)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=_WINDOW, maxLevel=_LEVELS)
    close = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < _THERE_AND_BACK_PX
    kept = (found.ravel() == 1) & (returned.ravel() == 1) & close
    return corners.reshape(-1, 2)[kept].astype(np.float64), there.reshape(-1, 2)[kept].astype(np.float64)


def rotation_between(model: CameraModel, before: NDArray[np.float64], after: NDArray[np.float64]) -> Turned | int:
    """The rotation between two images by pixels (N, 2) of corners in both; where too few agree on one, how many there are."""
    cv2 = require("cv2", "which finds the essential matrix")
    rays_1, found_1 = model.unproject(before)
    rays_2, found_2 = model.unproject(after)
    found = found_1 & found_2
    followed = int(found.sum())
    if followed < _FEWEST:
        return followed
    a, b = np.ascontiguousarray(rays_1[found, :2]), np.ascontiguousarray(rays_2[found, :2])
    E, inliers = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=1.0 / model.fx)
    if E is None or E.shape != (3, 3) or inliers.sum() < 0.7 * followed:
        return followed
    agreed = inliers.ravel() == 1
    _, R, _, _ = cv2.recoverPose(E, a, b, np.eye(3), mask=inliers)
    return Turned(np.asarray(R, np.float64), before[found][agreed], after[found][agreed], followed)
