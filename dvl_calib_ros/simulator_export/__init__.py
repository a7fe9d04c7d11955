"""What was found of a DVL, as the settings of other simulators: one description, one writer for each of them."""
