"""Estimators of models that no per-sample filter solves: lever arm and delay (full), displacements (positions)."""
