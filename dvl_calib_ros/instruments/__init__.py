"""Settings of DVLs and autopilots, and the protocol that sends them to an instrument."""
