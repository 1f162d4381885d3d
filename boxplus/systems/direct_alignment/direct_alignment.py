"""Direct alignment of two images, one of them with depth: the pose that makes grey values agree (docs/residuals/photometric.md).

Source: Steinbrücker, Sturm and Cremers, Real-Time Visual Odometry from Dense RGB-D Images, ICCV-W 2011; and those of
`tracking.py`, which does it.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from boxplus.cameras.pinhole import Pinhole
from boxplus.optimization.losses import Huber, Loss
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_alignment.tracking import Alignment, track


def align_rgbd(
    image_1: Image | ArrayLike,
    depth_1: ArrayLike,
    image_2: Image | ArrayLike,
    camera: Pinhole,
    *,
    T_21: ArrayLike = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    levels: int = 5,
    points: int | None = 5000,
    loss: Loss | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-5,
    search_deg: float = 0.0,
) -> Alignment:
    """Align image 1, which has depth, to image 2: `track` to a `Keyframe` that is used once.

    Args:
        image_1, image_2: grey values (H, W), or colours, of the same camera.
        depth_1: (H, W) z in camera 1 [m]; 0 or NaN where there is none.
        camera: intrinsics of both images.
        T_21, max_iterations, tolerance, search_deg: as in `track`.
        levels: of the pyramid, each half the resolution of the one before.
        points: about as many pixels a level at most, those of the steepest gradient in square cells; None for all, which is
            about a tenth more accurate and takes ten times as long.
        loss: of e/σ; by default `Huber(1.345)`.

    Raises:
        InputError: images or depth of another shape or not finite, too many levels, fewer than 100 pixels with depth.

    Example:
        >>> camera, v = bp.Pinhole(100.0, 100.0, 63.5, 47.5), np.linspace(0.0, 20.0, 129)
        >>> wall = 100.0 + 40.0 * np.sin(v[None, :]) + 40.0 * np.cos(v[:96, None])
        >>> found = bp.align_rgbd(wall[:, :-1], np.full((96, 128), 2.0), wall[:, 1:], camera)
        >>> found.status, found.T_21[4:].round(2) + 0.0  # 2 m / 100 px to the left
        ('converged', array([-0.02,  0.  ,  0.  ]))
    """
    keyframe = Keyframe.prepare(image_1, depth_1, camera, levels=levels, points=points)
    robust = Huber(1.345) if loss is None else loss
    return track(
        keyframe, image_2, T_21=T_21, loss=robust, max_iterations=max_iterations, tolerance=tolerance, search_deg=search_deg
    )
