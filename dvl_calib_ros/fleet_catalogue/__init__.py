"""A catalogue of many recordings, each calibrated once."""
