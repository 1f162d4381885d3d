from .direct_alignment import Alignment as Alignment
from .direct_alignment import align_rgbd as align_rgbd
