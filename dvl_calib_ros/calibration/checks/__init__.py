"""Checks of instruments against themselves and each other."""
