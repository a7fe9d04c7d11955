"""Effects that a simulator lacks and a vehicle has: one class each, in one registry."""
