"""Pictures of a replay: estimates over time, velocities, use of the samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from ..bag_replay.replay import Replayed
from ..bag_replay.run_history import ModelHistory, RunHistory
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.results.results import Result
from . import replay_figures as figures
from .error_terms import ANGLES, ANY_SCALE, SCALES, Term, scale_terms, state_of
from .figure_data import TimeAxis
from .figure_style import Picture, picture

# use of DVL samples, by model
FATES: Mapping[str, Callable[[Result, str], int]] = {
    "used": lambda result, name: result.estimates[name].used,
    "gated": lambda result, name: result.estimates[name].gated,
    "not given": lambda result, name: max(
        0, result.counts["dvl"]["usable"] - result.estimates[name].used - result.estimates[name].gated
    ),
    "slow or turning": lambda result, _: sum(
        result.counts["dvl"][fate] for fate in ("slow", "turning", "no_turn_rate")
    ),
}


def estimate_pictures(result: Result, history: RunHistory, models: Sequence[str]) -> Iterable[Picture]:
    """Draw the estimates of some models over time, and their innovations."""
    time = TimeAxis(history.stamps_ns)
    for term in (*ANGLES, *_scales_shown(models)):
        lines = [
            _line(name, history.models[name], term)
            for name in models
            if MODELS[name].error_terms_from_state[term.row].any()
        ]
        if lines:
            final = ", ".join(f"{line.model} {line.value[-1]:+.2f} ± {line.std[-1]:.2f}" for line in lines)
            yield picture(
                f"{term.in_words} ± 1σ", f"{term.name} over time; at the end, in {term.unit.strip()}: {final}",
                figures.estimate_over_time, time, history.stamps_ns, lines, result.selected,
                f"{term.name}, {term.unit.strip()}",
            )  # fmt: skip
    nis = {name: history.models[name].nis for name in models}
    yield picture(
        "Innovations (NIS)", "Mean normalised innovation squared over time; 1 is expected",
        figures.innovations_over_time, time, history.stamps_ns, nis, result.selected,
        caption="Running mean. The model expects 1 (line): above it the σ is too small, below too large.",
    )  # fmt: skip


def _scales_shown(models: Sequence[str]) -> list[Term]:
    """Return one figure for the scale, or one per axis if a model has more than one scale error."""
    if any(len(scale_terms(MODELS[name])) > 1 for name in models):
        return list(SCALES)
    return [ANY_SCALE]


def _line(name: str, history: ModelHistory, term: Term) -> figures.ModelLine:
    index = state_of(MODELS[name], term)
    return figures.ModelLine(name, term.factor * history.state[:, index], term.factor * history.std[:, index])


def velocity_pictures(replayed: Replayed, history: RunHistory) -> list[Picture]:
    """Draw velocity and, with a reference, residual, per body axis."""
    time = TimeAxis(history.stamps_ns)
    parameters = Parameters.from_mapping(replayed.result.parameters)
    t = parameters.rotation_dvl_from_body
    correction = replayed.result.estimate
    before, after = history.dvl_velocity @ t, correction.corrected_velocity(history.dvl_velocity, t)
    pictures = [
        picture(
            f"Velocity {where}", f"DVL velocity {where} before and after correction, and the reference, m/s",
            figures.velocity_over_time, time, history.dvl_ns, before[:, axis], after[:, axis], history.paired_ns,
            history.reference_velocity[:, axis], f"velocity {where}, m/s",
        )
        for axis, where in enumerate(parameters.body_axes)
    ]  # fmt: skip
    navigation = replayed.navigation
    if navigation is not None:
        pictures += [
            picture(
                f"Residual {where}", f"DVL minus GNSS {where}, before and after correction, m/s",
                figures.residual_over_time, time, navigation.stamps_ns, -navigation.error_before[:, axis],
                -navigation.error_after[:, axis], f"DVL − GNSS {where}, m/s",
            )
            for axis, where in enumerate(parameters.body_axes)
        ]  # fmt: skip
    return pictures


def data_pictures(result: Result, history: RunHistory, shown: Sequence[str]) -> list[Picture]:
    """Draw the use of the samples, and the selected model over time."""
    time = TimeAxis(history.stamps_ns)
    fates = {fate: [count(result, name) for name in shown] for fate, count in FATES.items()}
    ends = [*(segment.from_ns for segment in result.segments[1:]), result.last_ns]
    segments = [(each.model, each.from_ns, end) for each, end in zip(result.segments, ends, strict=False)]
    switches = ", ".join(dict.fromkeys(name for name, _, _ in segments)) or "none"
    return [
        picture(
            "Samples by model", "How many DVL samples each model used, gated or was not given",
            figures.samples_by_fate, list(shown), fates,
            caption="Not given: without the GNSS velocity or attitude it needs, or in the window of its prior.",
        ),
        picture(
            "Selected model and GNSS", f"Which model was selected over time: {switches}; and when GNSS was there",
            figures.selection_over_time, time, segments, history.stamps_ns, history.paired_share,
            caption="GNSS: dark where DVL samples had a GNSS velocity at their time.",
        ),
    ]  # fmt: skip
