"""Atomic writing of files, reading with a size limit, and YAML as ROS 2 parses it."""
