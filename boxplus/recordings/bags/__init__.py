"""ROS 1 and ROS 2 bags and MCAP: containers, messages, and what their first seconds show."""
