"""A recording, opened once: what is in it, and of all that may be the DVL's, a reference or an IMU's the columns."""
