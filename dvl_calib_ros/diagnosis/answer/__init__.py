"""The answer of a diagnosis: validation, closure, location, intervals, compensation."""
