"""Recordings, read once: their topics, and the columns of topics that may be a DVL's, a reference or an IMU's."""
