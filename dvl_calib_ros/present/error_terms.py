"""Error terms in displayed units, and the models' estimates of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..calibration.models import MODELS, Model
from ..calibration.numerics.frames import Array
from ..calibration.results.results import Estimate, Result
from .document import Table
from .numbers import with_std


class Term(NamedTuple):
    """Displayed error term. row: index in φ (3) and δk (3). factor: from SI."""

    row: int
    name: str
    in_words: str
    unit: str
    factor: float


_DEGREE = math.degrees(1.0)
ANGLES = (
    Term(0, "φx", "Misalignment about x", "°", _DEGREE),
    Term(1, "φy", "Misalignment about y", "°", _DEGREE),
    Term(2, "φz", "Misalignment about z", "°", _DEGREE),
)
SCALES = (
    Term(3, "δk x", "Scale error along x", " %", 100.0),
    Term(4, "δk y", "Scale error along y", " %", 100.0),
    Term(5, "δk z", "Scale error along z", " %", 100.0),
)
ANY_SCALE = Term(3, "δk", "Scale error", " %", 100.0)


def _error_terms(estimate: Estimate) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return φ (3) and δk (3), their standard deviations, and whether the model estimates them; each (6,)."""
    terms = MODELS[estimate.model].error_terms_from_state
    variance = np.diag(terms @ estimate.covariance @ terms.T)
    return terms @ estimate.state, np.sqrt(variance), np.asarray(terms.any(axis=1))


def state_of(model: Model, term: Term) -> int:
    """Return the index of the state of an error term."""
    return int(np.argmax(model.error_terms_from_state[term.row]))


def scale_terms(model: Model) -> list[Term]:
    """Return the scale terms with their own state: a common δk, or one per axis."""
    terms = [term for term in SCALES if model.error_terms_from_state[term.row].any()]
    if len(terms) == 3 and len({state_of(model, term) for term in terms}) == 1:
        return [ANY_SCALE._replace(in_words="Scale error, all axes")]
    return terms


def estimate_table(result: Result, models: Sequence[str]) -> Table:
    """Return one row per model, the selected one marked."""
    per_axis = any(len(scale_terms(MODELS[name])) > 1 for name in models)
    terms = (*ANGLES, *(SCALES if per_axis else (ANY_SCALE,)))
    rows = []
    for name in models:
        estimate = result.estimates[name]
        nis = f"{estimate.mean_nis / MODELS[name].n_measurement:.2f}" if estimate.used else "–"
        cells = _cells(estimate, terms)
        rows.append((name, *cells, str(estimate.used), str(estimate.gated), nis, estimate.convergence.value))
    return Table(
        ("model", *(f"{term.name}, {term.unit.strip()}" for term in terms), "used", "gated", "NIS/m", "convergence"),
        rows,
        marked=list(models).index(result.selected),
        dense=True,
        notes=(
            "± is the model's 1σ; ? is not observable in this data; – is not estimated. φ and δk are "
            "in the DVL's frame. NIS/m: mean normalised innovation squared per measured component, about 1 when the "
            "noise is as assumed, above when σ is too small.",
        ),
    )


def _cells(estimate: Estimate, terms: Sequence[Term]) -> list[str]:
    """Return error terms with ±1σ; – if the model has none, ? if not observable."""
    model = MODELS[estimate.model]
    value, std, estimated = _error_terms(estimate)
    cells = []
    for term in terms:
        if not estimated[term.row]:
            cells.append("–")
            continue
        mark = "" if estimate.observability[state_of(model, term)].observed else " ?"
        is_one = model.scale_axes and term is ANY_SCALE and not estimated[4:].any()
        axis = " (x)" if is_one else ""
        cells.append(with_std(*(term.factor * each[term.row] for each in (value, std)), signed=True) + axis + mark)
    return cells
