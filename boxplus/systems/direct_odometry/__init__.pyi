from .config import DirectOdometryConfig as DirectOdometryConfig
from .direct_odometry import DirectOdometry as DirectOdometry
from .estimate import Estimate as Estimate
from .sensed_depth import StereoPair as StereoPair
