"""The calibration models as data (models.md, "The models").

A model is one entry of a table, in `published`, `own` or another package (`plugins`); nothing
outside its definition branches on its name. What an entry says is `base.Model`.
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
# What is wrong with models of other packages that cannot be used.
BROKEN: tuple[str, ...] = tuple(_PROBLEMS)
# Those that are filtered sample by sample.
LINEAR_MODELS: tuple[Model, ...] = tuple(model for model in MODELS.values() if not model.estimator)
# The model that takes another's place once headings show the current, by the name of that.
WITH_HEADINGS: Mapping[str, str] = {
    model.instead_of: name for name, model in MODELS.items() if model.instead_of is not None
}
# The model that goes by positions; '' for none.
WITH_POSITIONS: str = next((name for name, model in MODELS.items() if model.from_positions), "")
# Those that go by velocities, or by none.
BY_VELOCITY: tuple[str, ...] = tuple(name for name, model in MODELS.items() if not model.from_positions)
