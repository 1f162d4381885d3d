"""Residuals of several cameras on one body, each with a model and a place of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats, as_numbers
from boxplus.cameras.model import CameraModel
from boxplus.errors import InputError
from boxplus.residuals.camera.image_residual import ImageResidual
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.whitening import Whitening


def on_rig(
    kind: Callable[[CameraModel, NDArray[np.float64]], ImageResidual],
    cameras: Sequence[CameraModel],
    camera_of: ArrayLike,
    measured: ArrayLike,
    *,
    image_velocity: ArrayLike | None = None,
    time_offset_s: ArrayLike = 0.0,
    sigma: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    information: ArrayLike | None = None,
) -> list[tuple[OnBody, NDArray[np.intp]]]:
    """What the cameras of a rig measured, as one residual group for each camera that saw something.

        for seen, n in on_rig(InverseDepthReprojection, cameras, camera_of, pixels, sigma=1.0):
            problem.add_residuals(
                seen, bodies[anchor_of[n]], mountings[anchor_camera_of[n]], bodies[frame_of[n]], mountings[camera_of[n]],
                points[point_of[n]],
            )

    Args:
        kind: `Reprojection`, `InverseDepthReprojection`, `LineReprojection`, or any function of a camera and what it measured.
        cameras: of the rig.
        camera_of: (N,) which of them measured each row.
        measured: (N, 2) pixels or (N, 4) segments [px].
        image_velocity, time_offset_s: as for `OnBody`; (N, 2) or (N, 4) [px/s], number or (N,) [s].
        sigma, covariance, information: of a measurement, as in `Whitening.of` for all N; none stands for 1 px.

    Returns:
        for every camera that measured something its residuals and the rows (M,) of `measured` that they are.

    Raises:
        InputError: shapes that do not match, a camera that is not in the rig, or what `kind` and `OnBody` refuse.

    Example:
        >>> rig = [bp.Pinhole(500.0, 500.0, 320.0, 240.0), bp.Pinhole(480.0, 480.0, 320.0, 240.0)]
        >>> pixels = [[320.0, 240.0], [310.0, 240.0], [300.0, 240.0]]
        >>> groups = bp.residuals.on_rig(bp.residuals.Reprojection, rig, camera_of=[0, 1, 0], measured=pixels)
        >>> [rows.tolist() for seen, rows in groups]  # a group for each camera
        [[0, 2], [1]]
    """
    every = as_floats(measured, "measured")
    of = as_numbers(camera_of, "camera_of")
    if every.ndim != 2 or of.shape != (len(every),) or of.dtype.kind not in "iu":
        raise InputError(
            "measured (N, k) and camera_of (N,), integers",
            f"shapes {every.shape} and {of.shape} of {of.dtype}",
            "give one row for each",
        )
    outside = (of < 0) | (of >= len(cameras))
    if outside.any():
        n = int(np.argmax(outside))
        raise InputError(f"cameras from 0 to {len(cameras) - 1}", f"{of[n]} in row {n}", "give every camera of the rig")
    whitening = Whitening.of(2, len(every), sigma=sigma, covariance=covariance, information=information)
    velocity = None if image_velocity is None else as_floats(image_velocity, "image_velocity")
    if velocity is not None and velocity.shape != every.shape:
        raise InputError(f"image_velocity of shape {every.shape}", f"shape {velocity.shape}", "give one row for each measurement")
    cut = as_floats(time_offset_s, "time_offset_s")
    if cut.shape not in ((), of.shape):
        raise InputError(f"time_offset_s, a number or {of.shape}", f"shape {cut.shape}", "give one for each measurement")
    found = []
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(of == number)
        if not len(rows):
            continue
        seen = kind(camera, every[rows])
        rows = rows[getattr(seen, "kept", slice(None))]  # lines may leave some out
        seen.whitening = whitening.rows(rows)
        if velocity is None:
            found.append((OnBody(seen), rows))
        else:
            at = np.broadcast_to(cut, of.shape)[rows]
            found.append((OnBody(seen, image_velocity=velocity[rows], time_offset_s=at), rows))
    return found
