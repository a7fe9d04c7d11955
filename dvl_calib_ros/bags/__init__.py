"""rosbag2 recordings, read and written; knows nothing of DVLs."""
