"""Discovery of topics, mounting and frames in a bag."""
