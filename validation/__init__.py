"""What is claimed of this package, measured again: `python -m validation`. Not installed."""
