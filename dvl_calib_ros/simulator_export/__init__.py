"""Export of a diagnosed DVL as settings of other simulators."""
