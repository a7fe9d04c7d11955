"""The ROS 2 node: callbacks convert and feed, nothing else."""
