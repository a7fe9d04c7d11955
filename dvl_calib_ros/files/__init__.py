"""Files of results, parameters and mountings."""
