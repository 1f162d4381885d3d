"""Camera models: projection of points into pixels and its derivatives."""

from boxplus.cameras.distortion import Distortion, Radial, RadialTangential
from boxplus.cameras.model import CameraModel
from boxplus.cameras.pinhole import Pinhole
from boxplus.cameras.wide_angle import DoubleSphere, Equidistant

__all__ = ["CameraModel", "Distortion", "DoubleSphere", "Equidistant", "Pinhole", "Radial", "RadialTangential"]
