from .odometry import LidarOdometry as LidarOdometry
