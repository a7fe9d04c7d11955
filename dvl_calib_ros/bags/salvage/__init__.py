"""Readers that continue after damage in a recording."""
