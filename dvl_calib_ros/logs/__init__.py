"""Logs of instruments and autopilots, and trajectories as CSV or NPY, read as samples."""
