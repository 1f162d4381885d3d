from .config import VioConfig as VioConfig
from .estimate import VioEstimate as VioEstimate
from .odometry import VisualInertialOdometry as VisualInertialOdometry
from .rig import Rig as Rig
from .start.start import Start as Start
