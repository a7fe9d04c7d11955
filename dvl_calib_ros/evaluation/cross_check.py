"""Cross-check of recorded bags: calibrate on each, correct every other one that has GNSS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ..bag_replay.replay import replay
from ..calibration.assessment.dead_reckoning import Navigation, dead_reckoned, navigation_document
from ..calibration.calibrator import Calibrator
from ..calibration.filters.build_observations import Observer
from ..calibration.models import BY_VELOCITY, MODELS, Needs
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.error_model import correction_matrix
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import AlignedBlock
from ..calibration.results.results import Estimate
from ..calibration.results.thinned_recording import Terms, ThinnedRecording
from ..discovery.discover import discover
from ..discovery.discovery import Given
from ..errors import InputError
from ..parallel import Workers, run_all
from ..recordings.recording import hold_the_same, open_recording
from ..recordings.topic_messages import Recorded
from ..verdict.answering import Answering
from ..version import __version__
from .results import Failure, Improvement, RunMoments, vrmse


@dataclass(frozen=True, repr=False)
class CrossCheck(Answering):
    """Velocity error (vector RMSE, m/s) of the DVL against GNSS on bags that were not used for calibration.

    The noise of GNSS is included.
    bags: (L,).
    models: (M,).
    n_paired: (L,) samples with a reference.
    uncorrected: (L,) by verifying bag.
    corrected: (L, M, L) by calibrating bag, model and verifying bag; nan on the bag itself, without paired samples, and
      for models without usable data. A model with lever arm and delay corrects both, with the delay estimated from the
      verifying bag if observable.
    selected: (L,) model of each calibrating bag for `navigation`.
    navigation: dead reckoning by (calibrating, verifying) bag.
    notes: messages of the replays.
    found: results of discovery.
    """

    bags: tuple[str, ...]
    models: tuple[str, ...]
    n_paired: tuple[int, ...]
    uncorrected: Array
    corrected: Array
    notes: tuple[str, ...]
    parameters: Mapping[str, Any]
    selected: tuple[str, ...] = ()
    navigation: Mapping[tuple[str, str], Navigation] = field(default_factory=dict)
    found: tuple[str, ...] = ()

    @property
    def improvement(self) -> Improvement:
        """Improvement by the best model, on bags that it was not calibrated on."""
        return Improvement.of(self.models, self.corrected.transpose(1, 0, 2), self.uncorrected)

    @property
    def verdict(self) -> str:
        """Answer: better, not_better or not_known."""
        return self.improvement.verdict

    @property
    def names(self) -> list[str]:
        """Names (L,) of the bags, without their folders."""
        return [Path(bag).name or bag for bag in self.bags]


@dataclass(frozen=True)
class _Replayed:
    """Replay of one bag. parameters: with the bag's discovered values, described in found.

    corrections: (M, 3, 3), nan for a model without samples.
    moments: of the paired samples, None without.
    delayed: by model with a lever arm and delay, if it claims any, its corrections.
    recording: all streams, thinned.
    selected: selected model and its corrections; None if it used nothing.
    dvl: its messages.
    failed: why there is no result.
    """

    parameters: Parameters
    corrections: Array
    found: tuple[str, ...] = ()
    moments: RunMoments | None = None
    n_paired: int = 0
    notes: tuple[str, ...] = ()
    delayed: Mapping[str, Terms] = field(default_factory=dict)
    recording: ThinnedRecording | None = None
    selected: tuple[str, Terms | None] = ("-", None)
    dvl: Recorded | None = None
    failed: tuple[str, ...] = ()


def cross_check(
    bags: Sequence[Path],
    parameters: Parameters,
    models: Sequence[str],
    given: Given,
    workers: Workers,
    on_progress: Callable[[float], None] = lambda _: None,
) -> CrossCheck:
    """Replay every bag and verify it on all others. given: named parameters and topics. Raises InputError."""
    if len(set(bags)) < len(bags):
        raise InputError(f"{', '.join(map(str, bags))}: a bag is named twice; it cannot be checked against itself")
    found = run_all(partial(_replay_or_nothing, parameters, tuple(models), given), bags, workers, on_progress)
    if not any(each.moments for each in found):
        if failed := [f"{bag}: {note}" for bag, each in zip(bags, found, strict=True) for note in each.failed]:
            raise InputError(f"no bag is left to check: {failed[0]}")
        raise InputError(f"{', '.join(map(str, bags))}: no sample has a reference to check against; set --gnss-topic")
    uncorrected = np.full(len(bags), np.nan)
    corrected = np.full((len(bags), len(models), len(bags)), np.nan)
    for verified, each in enumerate(found):
        if each.moments is None:
            continue
        uncorrected[verified] = vrmse(each.moments, each.parameters.rotation_dvl_from_body.T)
        for calibrated, other in enumerate(found):
            if calibrated != verified:
                corrected[calibrated, :, verified] = vrmse(each.moments, other.corrections)
                for name in set(other.delayed) & set(models):
                    terms = other.delayed[name]
                    corrected[calibrated, models.index(name), verified] = _delayed_rmse(each, terms, other.parameters)
    for (first, one), (second, other) in combinations(zip(bags, found, strict=True), 2):
        if one.dvl is not None and other.dvl is not None and hold_the_same(one.dvl, other.dvl):
            raise InputError(f"{first}, {second}: are one bag by two names; name others to check it on")
    return CrossCheck(
        bags=tuple(map(str, bags)),
        models=tuple(models),
        n_paired=tuple(each.n_paired for each in found),
        uncorrected=uncorrected,
        corrected=corrected,
        notes=tuple(
            f"{bag}: {note}" for bag, each in zip(bags, found, strict=True) for note in _notes_of(each, models)
        ),
        parameters=parameters.as_dict(),
        selected=tuple(each.selected[0] for each in found),
        navigation=_navigation(bags, found),
        found=tuple(f"{bag}: {'; '.join(each.found)}" for bag, each in zip(bags, found, strict=True) if each.found),
    )


def _notes_of(replayed: _Replayed, models: Sequence[str]) -> Iterator[str]:
    """Yield the notes on the requested models; if all are requested, only on the selected one."""
    requested = {replayed.selected[0]} if set(models) == set(BY_VELOCITY) else set(models)
    others = tuple(f"{name}: " for name in MODELS if name not in requested)
    yield from (note for note in (*replayed.failed, *replayed.notes) if not note.startswith(others))


def _with_own_delay(terms: Terms, verified: _Replayed) -> Terms:
    """Replace the delay by the verifying bag's, because each recording synchronises its clocks differently."""
    delayed = next(iter(verified.delayed.values()), None)
    return terms if delayed is None else terms._replace(time_offset=delayed.time_offset)


def _delayed_rmse(verified: _Replayed, terms: Terms, parameters: Parameters) -> float:
    """Return the velocity RMSE (m/s) on the verifying bag, with the delay corrected."""
    if verified.recording is None:
        return float("nan")
    every = np.arange(len(verified.recording.dvl.times))
    error = verified.recording.compared(every, _with_own_delay(terms, verified), parameters).error
    error = error[np.isfinite(error[:, 0])]
    return float(np.sqrt(np.mean((error**2).sum(axis=1)))) if len(error) else float("nan")


def _navigation(bags: Sequence[Path], found: Sequence[_Replayed]) -> Mapping[tuple[str, str], Navigation]:
    """Return the dead reckoning of every bag, corrected by every other bag's calibration.

    Keys are (calibrated bag, verified bag).
    """
    navigation = {}
    for calibrated, one in zip(bags, found, strict=True):
        for verified, other in zip(bags, found, strict=True):
            _, terms = one.selected
            if verified == calibrated or terms is None or other.recording is None:
                continue
            folds = np.zeros(len(other.recording.dvl.times), dtype=np.int64)
            # uncorrected: with the delay that the clocks really have
            reckoned = dead_reckoned(other.recording, folds, [_with_own_delay(terms, other)], one.parameters)
            if reckoned is not None:
                navigation[str(calibrated), str(verified)] = reckoned
    return navigation


def _replay_or_nothing(parameters: Parameters, models: Sequence[str], given: Given, bag: Path) -> _Replayed:
    """Replay one bag; an exception affects only this bag. Raises InputError if it cannot be read."""
    try:
        return _replay_one(parameters, models, given, bag)
    except InputError:
        raise
    except Exception as error:
        failed = f"failed, and is in none of the figures: {Failure.of(error, 'replay')}"
        return _Replayed(parameters, np.full((len(models), 3, 3), np.nan), failed=(failed,))


def _replay_one(named: Parameters, models: Sequence[str], given: Given, bag: Path) -> _Replayed:
    """Replay one bag. Return its corrections, the moments of its paired velocities, and what the cross-check needs.

    named: parameters given by the user, before discovery.
    models: names of the models whose correction matrices (3, 3) are collected; nan if a model used no sample.
    given: topics and parameters that discovery must keep.
    """
    opened = open_recording([bag], None, named)
    discovery = discover(opened, named, given)
    topics, parameters = discovery.topics, discovery.parameters
    observer = Observer(parameters)
    measured: list[Array] = []
    reference: list[Array] = []

    def keep_paired(block: AlignedBlock) -> None:
        seen = observer.observe(block.part(block.paired), Needs.REFERENCE, np.zeros(2))
        assert seen.reference_body is not None
        measured.append(seen.velocity_at_reference)
        reference.append(seen.reference_body)

    def forget() -> None:
        measured.clear()
        reference.clear()

    kept: list[ThinnedRecording] = []

    def keep_recording(calibrator: Calibrator) -> None:
        if calibrator.recording is not None:
            kept.append(calibrator.recording[0])

    replayed = replay(opened, parameters, topics, on_rows=keep_paired, on_restart=forget, on_finished=keep_recording)
    corrections = np.full((len(models), 3, 3), np.nan)
    for index, name in enumerate(models):
        estimate = replayed.result.estimates[name]
        if estimate.used:
            rotation = parameters.rotation_dvl_from_body
            corrections[index] = correction_matrix(estimate.misalignment, estimate.scale, rotation)
    n_paired = sum(map(len, measured))
    moments = RunMoments.of(np.concatenate(measured), np.concatenate(reference)) if n_paired else None
    result = replayed.result
    delayed = {
        name: _terms(result.estimates[name])
        for name in dict.fromkeys([*models, result.selected])
        if (found := result.estimates[name]).used and any(found.state_of(beyond) for beyond in BEYOND)
    }
    selected = result.selected, _terms(result.estimate) if result.estimate.used else None
    return _Replayed(
        parameters, corrections, discovery.found, moments, n_paired, (*discovery.doubts, *replayed.notes), delayed,
        recording=kept[0] if kept else None, selected=selected,
        dvl=opened.recorded(topics.found_in(opened.types).dvl, parameters),
    )  # fmt: skip


# states of lever arm and delay
BEYOND = ("lever_arm_x", "lever_arm_y", "lever_arm_z", "time_offset")


def _terms(estimate: Estimate) -> Terms:
    """Return the corrections by an estimate."""
    errors = MODELS[estimate.model].error_terms_from_state @ estimate.state
    *arm, delay = (estimate.state_of(name) for name in BEYOND)
    return Terms(errors, np.array(arm), delay)


def cross_check_document(check: CrossCheck) -> dict[str, Any]:
    """Return the JSON of `evaluate --json` for bags; m/s."""
    by_bag = partial(zip, check.bags, strict=True)
    return {
        "verdict": check.verdict,
        "uncorrected": dict(by_bag(check.uncorrected.tolist())),
        "corrected": {
            calibrated: {
                model: {bag: value for bag, value in by_bag(row.tolist()) if bag != calibrated}
                for model, row in zip(check.models, rows, strict=True)
            }
            for calibrated, rows in by_bag(check.corrected)
        },
        "paired": dict(by_bag(check.n_paired)),
        "selected": dict(by_bag(check.selected)),
        "navigation": {
            calibrated: {
                bag: navigation_document(check.navigation.get((calibrated, bag)))
                for bag in check.bags
                if bag != calibrated
            }
            for calibrated in check.bags
        },
        "notes": list(check.notes),
        "parameters": dict(check.parameters),
        "version": __version__,
    }
