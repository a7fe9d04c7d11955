"""Draws of calibration and effects from the joint posterior of a diagnosis, for domain randomisation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import InputError
from ..fit.cross_validation import predictive_gain_of
from ..fit.selection_criteria import robust_covariance
from ..model.hypothesis import Hypothesis
from .results import Diagnosis, diagnosis_document


def with_samples(diagnosis: Diagnosis, count: int, seed: int = 0) -> dict[str, Any]:
    """Return the document of a diagnosis with `samples`: draws of its calibration and effects.

    Equivalent effects are drawn by their pseudo-BMA weights, exp(-held-out deviance / 2). Raises InputError.
    """
    selection = diagnosis.selection
    if selection is None or diagnosis.covariance is None:
        raise InputError("nothing was fitted, so there is no posterior to draw from")
    fitter, fit, rng = selection.fitter, selection.fit, np.random.default_rng(seed)
    rivals = [fitter.fit_kept(rival, fit.noise) for each in selection.selected for rival in each.rivals]
    behind = np.array([0.0, *(predictive_gain_of(fitter.problem, rival, fit) for rival in rivals)])
    weights = np.exp(-0.5 * (behind - behind.min()))
    covariances = [diagnosis.covariance, *(robust_covariance(fitter.problem, rival)[0] for rival in rivals)]
    samples = []
    for index in rng.choice(len(weights), count, p=weights / weights.sum()).tolist():
        covariance = covariances[index]
        step = rng.multivariate_normal(np.zeros(len(covariance)), covariance, method="eigh")
        samples.append(_drawn([fit, *rivals][index].hypothesis.moved(step)))
    return diagnosis_document(diagnosis) | {"samples": samples}


def _drawn(hypothesis: Hypothesis) -> dict[str, Any]:
    """Return calibration and effects as in a diagnosis' document; values per recording are averaged."""
    effects = []
    for effect in hypothesis.effects:
        each = hypothesis.values[effect.name]
        means = {name: {"value": float(np.mean([values[name] for values in each]))} for name in each[0]}
        effects.append({"name": effect.name, "equivalent_to": [], "parameters": means})
    vectors = {"phi_rad": hypothesis.phi.tolist(), "delta_k": hypothesis.scale.tolist()}
    calibration = {
        name: {axis: {"value": value} for axis, value in zip("xyz", vector, strict=True)}
        for name, vector in vectors.items()
    }
    return {"effects": effects, "calibration": calibration}
