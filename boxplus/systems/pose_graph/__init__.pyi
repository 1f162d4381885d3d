from .pose_graph import PoseGraphConfig as PoseGraphConfig
from .pose_graph import PoseGraphResult as PoseGraphResult
from .pose_graph import optimize_pose_graph as optimize_pose_graph
