"""Registration: clock offsets, mounting, lever arm and scale from the data of DVL, reference and IMU."""
