"""Frames, statistics, the Kalman filter and the sample types."""
