"""Calibration models as data (docs/models.md, "The models").

A model is one `base.Model` entry of `published`, `own` or another package (`plugins`). No other code branches on its
name.
"""

from __future__ import annotations

from collections.abc import Mapping

from .base import N_MEASUREMENT, Linearised, Model, Needs, Nuisance
from .own import D1, FULL, WITHOUT_REFERENCE
from .plugins import plugged_models
from .published import PUBLISHED

__all__ = [
    "BROKEN", "BY_VELOCITY", "LINEAR_MODELS", "MODELS", "N_MEASUREMENT", "WITH_HEADINGS",
    "WITH_POSITIONS", "Linearised", "Model", "Needs", "Nuisance",
]  # fmt: skip

_OWN = {model.name: model for model in (*PUBLISHED, FULL, *WITHOUT_REFERENCE, D1)}
_PLUGGED, _PROBLEMS = plugged_models(_OWN)
MODELS: Mapping[str, Model] = _OWN | _PLUGGED
# Why models of other packages cannot be used.
BROKEN: tuple[str, ...] = tuple(_PROBLEMS)
# Models of the linear filter, updated per sample.
LINEAR_MODELS: tuple[Model, ...] = tuple(model for model in MODELS.values() if not model.estimator)
# Replacement of a model once the headings make the current observable, by the name of the replaced model.
WITH_HEADINGS: Mapping[str, str] = {
    model.instead_of: name for name, model in MODELS.items() if model.instead_of is not None
}
# Name of the model that uses positions, or ''.
WITH_POSITIONS: str = next((name for name, model in MODELS.items() if model.from_positions), "")
# Models that use velocities or no reference.
BY_VELOCITY: tuple[str, ...] = tuple(name for name, model in MODELS.items() if not model.from_positions)
