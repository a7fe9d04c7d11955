"""Bags over DDS, to and from: what the demo plays and shows, and what is recorded of a running system."""
