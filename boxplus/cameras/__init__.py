"""Camera models: projection of points into pixels and its derivatives."""

from boxplus.cameras.distortion import Distortion, Radial, RadialTangential
from boxplus.cameras.pinhole import Pinhole

__all__ = ["Distortion", "Pinhole", "Radial", "RadialTangential"]
