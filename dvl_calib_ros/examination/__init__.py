"""What is in a recording, and whether it can calibrate: stamps, gaps, frames, covariances, locks, motion."""
