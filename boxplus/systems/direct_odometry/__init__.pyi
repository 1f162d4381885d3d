from .config import DirectOdometryConfig as DirectOdometryConfig
from .depth.sensed_depth import StereoPair as StereoPair
from .direct_odometry import DirectOdometry as DirectOdometry
from .estimate import Estimate as Estimate
