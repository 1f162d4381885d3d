from .direct_alignment import align_rgbd as align_rgbd
from .keyframe import Keyframe as Keyframe
from .tracking import Alignment as Alignment
from .tracking import track as track
