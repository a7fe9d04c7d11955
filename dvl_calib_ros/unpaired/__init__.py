"""A vehicle's recordings against those of a simulator, from other motions: what the simulator's DVL lacks."""
