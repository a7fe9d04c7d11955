"""Readers of logs of instruments and autopilots, and of trajectories as CSV or NPY."""
