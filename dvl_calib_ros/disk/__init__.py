"""Files on disk: read whole and of a size that they have, written whole or not at all, YAML as ROS 2 takes it."""
