"""The calibration models as data (models.md, "The models").

A model is one entry of a table, in `published` or `own`; nothing outside its definition branches on its name. What an
entry says is `base.Model`.
"""

from __future__ import annotations

from collections.abc import Mapping

from .base import N_MEASUREMENT, Linearised, Model, Needs, Nuisance
from .own import OWN
from .published import PUBLISHED

__all__ = [
    "EXTENDED_BY", "LINEAR_MODELS", "MODELS", "N_MEASUREMENT", "WITH_HEADINGS", "Linearised", "Model", "Needs",
    "Nuisance",
]  # fmt: skip

MODELS: Mapping[str, Model] = {model.name: model for model in (*PUBLISHED, *OWN)}
# Those that are filtered sample by sample.
LINEAR_MODELS: tuple[Model, ...] = tuple(model for model in MODELS.values() if model.extends is None)
# The model that extends another, by the name of that.
EXTENDED_BY: Mapping[str, str] = {model.extends: name for name, model in MODELS.items() if model.extends is not None}
# The model that takes another's place once headings show the current, by the name of that.
WITH_HEADINGS: Mapping[str, str] = {
    model.instead_of: name for name, model in MODELS.items() if model.instead_of is not None
}
