"""The published validation procedure, its studies, and cross-checks of recorded bags. Results are plain data."""
