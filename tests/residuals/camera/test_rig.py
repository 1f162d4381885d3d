"""The residuals of a rig are those of its cameras."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import boxplus as bp
from boxplus import residuals

CAMERAS = [bp.Pinhole(400.0, 410.0, 320.0, 240.0), bp.Pinhole(300.0, 300.0, 300.0, 200.0), bp.Pinhole(500.0, 500.0, 0.0, 0.0)]
CAMERA_OF = np.array([1, 0, 0, 1, 0])
PIXELS = np.arange(10.0).reshape(5, 2)


def test_a_group_for_each_camera_that_saw_something() -> None:
    rng = np.random.default_rng(0)
    velocity, sigma, cut = rng.normal(size=(5, 2)), rng.uniform(0.5, 2.0, (5, 2)), rng.normal(size=5)
    x = [bp.BodyPose.random(rng, 5), bp.BodyPose.random(rng, 5), rng.normal(size=(5, 3)), rng.normal(size=(5, 1))]
    found = residuals.on_rig(
        residuals.Reprojection, CAMERAS, CAMERA_OF, PIXELS, image_velocity=velocity, time_offset_s=cut, sigma=sigma
    )
    assert [rows.tolist() for _, rows in found] == [[1, 2, 4], [0, 3]]
    for number, (seen, n) in enumerate(found):
        alone = residuals.OnBody(
            residuals.Reprojection(CAMERAS[number], PIXELS[n], sigma=sigma[n]), image_velocity=velocity[n], time_offset_s=cut[n]
        )
        np.testing.assert_array_equal(seen.evaluate(*(v[n] for v in x)), alone.evaluate(*(v[n] for v in x)))
        np.testing.assert_array_equal(seen.whitening.factors, alone.whitening.factors)
    (without, _), _ = residuals.on_rig(residuals.InverseDepthReprojection, CAMERAS, CAMERA_OF, PIXELS)
    assert "image_time_offset" not in without.roles and without.count == 3


def test_lines_that_are_left_out() -> None:
    segments = np.array([[0.0, 0, 9, 9], [0, 0, 0.1, 0], [5, 5, 50, 9], [1, 1, 1, 1], [3, 3, 8, 0]])
    with pytest.raises(bp.InputError, match="segments of 1 px and longer"):
        residuals.on_rig(residuals.LineReprojection, CAMERAS, CAMERA_OF, segments)
    found = residuals.on_rig(partial(residuals.LineReprojection, drop_short=True), CAMERAS, CAMERA_OF, segments)
    assert [(seen.count, rows.tolist()) for seen, rows in found] == [(2, [2, 4]), (1, [0])]


def test_refusals() -> None:
    with pytest.raises(bp.InputError, match="cameras from 0 to 1 – got 2 in row 3"):
        residuals.on_rig(residuals.Reprojection, CAMERAS[:2], [0, 1, 1, 2, 0], PIXELS)
    with pytest.raises(bp.InputError, match=r"measured \(N, k\) and camera_of \(N,\), integers – got shapes \(5, 2\) and \(4,\)"):
        residuals.on_rig(residuals.Reprojection, CAMERAS, CAMERA_OF[:4], PIXELS)
    with pytest.raises(bp.InputError, match=r"image_velocity of shape \(5, 2\) – got shape \(2,\)"):
        residuals.on_rig(residuals.Reprojection, CAMERAS, CAMERA_OF, PIXELS, image_velocity=[0.0, 1.0])
    with pytest.raises(bp.InputError, match=r"time_offset_s, a number or \(5,\) – got shape \(2,\)"):
        residuals.on_rig(residuals.Reprojection, CAMERAS, CAMERA_OF, PIXELS, image_velocity=PIXELS, time_offset_s=[0.0, 1.0])
