"""What is said of data, configurations and results: reasons by code, their sentences and remedies in tables."""
