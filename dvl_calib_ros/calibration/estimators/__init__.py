"""Estimators of models that no per-sample filter solves: lever arm and delay (G2), displacements (D1)."""
