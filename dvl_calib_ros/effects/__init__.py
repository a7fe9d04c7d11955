"""Effects that a vehicle has and a simulator lacks: one class each, in one registry."""
