"""The peers by name, and what each of them says of bags, as the trial asks."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from dvl_calib_ros.calibration.models.parameters import Parameters

from ..trial.run import Answerer, Document
from .answers import searched
from .needed import needed

# name: the library that it needs, and what it is
PEERS: Mapping[str, tuple[str, str]] = {
    "evidence": ("dynesty", "Bayesian evidence over sets of at most two effects, nested sampling (dynesty)"),
    "bic": ("scipy", "all sets of at most two effects by nonlinear least squares, Bayes's information criterion"),
    "sparse": ("pysindy", "sparse regression on what a calibration leaves (pysindy's STLSQ)"),
    "correlation": ("scipy", "correlation of what a calibration leaves with each effect"),
}


def ask(name: str, paths: Sequence[Path], parameters: Parameters) -> Document:
    """The answer of a peer. Raises InputError."""
    module = importlib.import_module(f"{__package__}.{name}")
    known = searched.cache_info().hits
    document: Document = module.diagnose(paths, parameters)
    shared = searched.cache_info().hits - known
    return {**document, "shared_cpu_s": searched(tuple(paths), parameters).cpu_s} if shared else document


def peers(names: Sequence[str]) -> dict[str, Answerer]:
    """Peers as answerers of a trial. Raises InputError where a library is not installed."""
    for name in names:
        needed(PEERS[name][0])
    return {name: partial(ask, name) for name in names}
