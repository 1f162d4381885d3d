"""Any camera model, and what to say where only a pinhole will do."""

from __future__ import annotations

from boxplus.cameras.pinhole import Pinhole
from boxplus.cameras.wide_angle import DoubleSphere, Equidistant
from boxplus.errors import InputError

CameraModel = Pinhole | Equidistant | DoubleSphere
CAMERA_MODELS = (Pinhole, Equidistant, DoubleSphere)


def check_pinhole(camera: CameraModel, what: str) -> Pinhole:
    """The camera, if it is a pinhole; a lens of wide angle would be taken for one without a word.

    Raises:
        InputError: another model.
    """
    if isinstance(camera, Pinhole):
        return camera
    raise InputError(f"a Pinhole for {what}", type(camera).__name__, "undistort the images to those of a pinhole")
