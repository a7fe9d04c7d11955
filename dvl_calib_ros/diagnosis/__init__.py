"""Where a recorded DVL differs from the simulated one, which effect causes it, and how much it explains."""
