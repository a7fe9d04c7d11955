"""Calibration models as data (docs/models.md, "The models").

A model is one `base.Model` entry of `published`, `own` or another package (`plugins`). No other code branches on its
name.
"""

from __future__ import annotations

from collections.abc import Mapping

from .base import N_MEASUREMENT, Linearised, Model, Needs, Nuisance
from .own import FULL, POSITIONS, UNAIDED
from .plugins import plugged_models
from .published import PUBLISHED

__all__ = [
    "BROKEN", "BY_VELOCITY", "FULL", "LINEAR_MODELS", "MODELS", "N_MEASUREMENT", "POSITIONS", "UNAIDED",
    "Linearised", "Model", "Needs", "Nuisance",
]  # fmt: skip

_OWN = {model.name: model for model in (*PUBLISHED, FULL, POSITIONS, UNAIDED)}
_PLUGGED, _PROBLEMS = plugged_models(_OWN)
MODELS: Mapping[str, Model] = _OWN | _PLUGGED
# Why models of other packages cannot be used.
BROKEN: tuple[str, ...] = tuple(_PROBLEMS)
# Models of the linear filter, updated per sample.
LINEAR_MODELS: tuple[Model, ...] = tuple(model for model in MODELS.values() if not model.estimator)
# Models that use velocities or no reference.
BY_VELOCITY: tuple[str, ...] = tuple(name for name, model in MODELS.items() if not model.from_positions)
