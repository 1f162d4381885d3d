"""Tied intrinsics: the same residual as with all of them, Jacobians, and a focal length that is found again."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from boxplus.cameras.distortion import Radial
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.camera.reprojection_intrinsics import ReprojectionIntrinsics
from boxplus.residuals.camera.reprojection_tied_intrinsics import ReprojectionTiedIntrinsics

CAMERA = Pinhole(500.0, 500.0, 320.0, 240.0, Radial(0.05, -0.02))
OFFSET = np.array([0.0, 0.0, 320.0, 240.0, 0.0, -0.02])
BASIS = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 1.0], [0.0, 0.0]])


def scene(count: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    T = SE3Left.boxplus(SE3Left.identity(), 0.3 * rng.standard_normal((count, 6)))
    return T, rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 8.0], (count, 3)), rng.uniform(0.0, 500.0, (count, 2))


def test_residual_and_jacobians():
    T, points, pixels = scene()
    tied, full = ReprojectionTiedIntrinsics(CAMERA, pixels, OFFSET, BASIS), ReprojectionIntrinsics(CAMERA, pixels)
    assert_allclose(tied.intrinsics([500.0, 0.05]), CAMERA.parameters, rtol=1e-15)
    assert_array_equal(tied.evaluate(T, points, [500.0, 0.05]), full.evaluate(T, points, CAMERA.parameters))
    report = check_jacobian(tied, T, points, np.tile([480.0, 0.1], (len(T), 1)))
    assert report.passed and report.invalid == 0 and report.largest_residual > 1.0, str(report)


def test_bad_bases_are_refused():
    pixels = np.zeros((1, 2))
    with pytest.raises(InputError, match=r"an offset \(6,\) and a basis \(6, m\)"):
        ReprojectionTiedIntrinsics(CAMERA, pixels, OFFSET[:4], BASIS[:4])
    with pytest.raises(InputError, match=r"basis of rank 2 – got rank 1"):
        ReprojectionTiedIntrinsics(CAMERA, pixels, OFFSET, BASIS[:, [0, 0]])
