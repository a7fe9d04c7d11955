"""The published validation procedure, its studies, and cross-checks of recorded bags; results are plain data."""
