"""Diagnosis of the gap between a recorded and a simulated DVL: its causes and their shares."""
