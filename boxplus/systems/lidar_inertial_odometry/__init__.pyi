from .config import LioConfig as LioConfig
from .estimate import Estimate as Estimate
from .estimate import Prediction as Prediction
from .estimate import Status as Status
from .estimate import WeakDirection as WeakDirection
from .odometry import LidarInertialOdometry as LidarInertialOdometry
