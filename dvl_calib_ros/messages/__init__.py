"""ROS messages to samples; rclpy's objects and rosbags' alike."""
