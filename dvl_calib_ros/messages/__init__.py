"""Conversion of ROS messages to samples, for the message objects of rclpy and rosbags."""
