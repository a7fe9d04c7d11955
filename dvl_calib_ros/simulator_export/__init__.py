"""Settings of other simulators, written from what was found of a DVL."""
