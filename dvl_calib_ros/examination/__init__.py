"""Examination of a recording for calibration: stamps, gaps, frames, covariances, bottom lock, motion."""
