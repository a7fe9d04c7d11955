"""Files of results, parameters, mountings and trajectories."""
