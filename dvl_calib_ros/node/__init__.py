"""The ROS 2 node. Its callbacks only convert messages and feed the calibrator."""
