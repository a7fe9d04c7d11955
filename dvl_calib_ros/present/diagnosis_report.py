"""The report of a diagnosis: `dvl-calib diagnose --report out.html`.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from ..diagnosis.results import Diagnosis, FoundEffect, Verdict
from ..diagnosis.series import DiagnosisSeries
from ..effects.registry import EFFECTS
from . import diagnosis_figures as figures
from .document import Cell, Table, signed
from .page import write_page
from .series import running_mean
from .style import Picture, picture
from .time_axis import CUT_FROM_S, TimeAxis
from .twin_section import followed_picture, twin_context

BODY_AXES = {"x": "ahead", "y": "to port", "z": "up"}
# Class of the style sheet for each verdict
KINDS = {
    Verdict.NO_GAP: "accept",
    Verdict.KNOWN: "accept",
    Verdict.AMBIGUOUS: "marginal",
    Verdict.INSUFFICIENT_EXCITATION: "marginal",
    Verdict.UNKNOWN: "reject",
}
NOISE_MEANING = {
    "outliers": "samples far outside the noise, as a share",
    "stale_samples": "samples that repeat the one before, as a share",
    "noise_inflation": "the noise is larger than reported, or grows with speed or turn rate",
    "reported_covariance": "how the noise follows covariances that differ by sample: 1 as claimed, 0 not at all",
    "coloured_reference_noise": "the noise has a memory",
}
# Lines over time are means over this share of the run, and over so many seconds at least
WINDOW_SHARE, WINDOW_S = 1.0 / 50.0, 5.0
# An axis of an effect's trace is drawn if it holds this share of its energy
AXIS_SHARE = 0.1
RESAMPLES = 500
MAX_PLACES = 12


def write_diagnosis_report(path: Path, diagnosis: Diagnosis) -> None:
    """Write the report of a diagnosis, with pictures if it has its series. Raises InputError if that cannot be."""
    write_page(path, "diagnosis.html", _context(diagnosis))


def _context(d: Diagnosis) -> dict[str, Any]:
    series = d.series
    pictures = (
        {"regimes": [], "traces": [], "twins": [], "twin_table": None, "followed": []}
        if series is None
        else _pictures(d, series)
    )
    return {
        "title": "Sim-to-real gap of the DVL",
        "subtitle": "" if series is None else ", ".join(series.recordings),
        "written": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "verdict": {
            "word": d.verdict.value.replace("_", " "),
            "kind": KINDS[d.verdict],
            "sentence": d.sentence,
            "found": [_found(effect) for effect in d.effects],
        },
        "numbers": list(_numbers(d)),
        "facts": [] if series is None else _facts(series),
        "notes": d.notes,
        "where": _where_table(d) if d.where else None,
        "effects": _effect_table(d) if d.effects else None,
        "closures": [_closures(d)] if d.effects and math.isfinite(d.gap.closure) else [],
        **pictures,
        "left": _left(d),
        "alternatives": [_alternative(effect) for effect in d.effects if effect.equivalent_to],
        "next_manoeuvre": d.next_manoeuvre,
        "untestable": _untestable_table(d) if d.untestable else None,
        "detectable": _detectable_table(d) if d.minimum_detectable else None,
        "noise": _noise_table(d) if d.noise else None,
    }


# ------------------------------------------------------------------ summary


def _found(effect: FoundEffect) -> str:
    names = " or ".join((effect.name, *effect.equivalent_to))
    return f"{names}: {'; '.join(_parameters(effect))}"


def _parameters(effect: FoundEffect) -> list[str]:
    units = _units(effect.name)
    return [f"{name} {_interval(*values)} {units.get(name, '')}".strip() for name, values in effect.parameters.items()]


def _units(effect: str) -> dict[str, str]:
    """Units by parameter; of an effect that was found with another library than the installed one, none."""
    return {spec.name: spec.unit for spec in EFFECTS[effect].parameters} if effect in EFFECTS else {}


def _interval(value: float, low: float, high: float) -> str:
    return f"{_three(value)} ({_three(low)} to {_three(high)})"


def _three(value: float) -> str:
    """Three significant digits."""
    if math.isinf(value):
        return "∞"
    text = f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:#.3g}".rstrip(".")
    return text.replace("-", "−")


def _per_cent(share: float) -> str:
    return f"{100.0 * share:.0f} %".replace("-", "−") if math.isfinite(share) else "–"


def _mm(value: float) -> str:
    return f"{1e3 * value:.1f} mm/s"


def _numbers(d: Diagnosis) -> Iterable[dict[str, str]]:
    gap = d.gap
    if not math.isfinite(gap.before):
        return
    yield {"name": "Error", "value": _mm(gap.before), "note": "held-out rms, noise included"}
    if d.effects:
        low, high = gap.interval
        yield {"name": "With the effects", "value": _mm(gap.after), "note": "held-out rms, noise included"}
        yield {
            "name": "Closed",
            "value": _per_cent(gap.closure),
            "note": f"of the gap beyond the noise, {_per_cent(low)} to {_per_cent(high)} (95 %)",
        }
    claimed = "" if gap.reported is None else f"; the messages claim {_mm(gap.reported)}"
    yield {"name": "Noise", "value": _mm(gap.noise_floor), "note": f"as high frequencies show it{claimed}"}
    yield {"name": "Not explained", "value": _mm(gap.not_explained), "note": "left beyond the noise"}


def _facts(series: DiagnosisSeries) -> list[tuple[str, str]]:
    lengths = [float(np.ptp(series.time[series.recording_of == i])) for i in range(len(series.recordings))]
    angle_std, scale_std = np.split(series.calibration_std, 2)
    angles = _with_std(np.degrees(series.phi), np.degrees(angle_std), "°")
    scales = _with_std(100.0 * series.scale, 100.0 * scale_std, " %")
    held = "whole recordings in turn" if len(series.recordings) > 1 else "a fifth of the run in turn"
    return [
        ("Recordings", ", ".join(f"{n} ({s:.0f} s)" for n, s in zip(series.recordings, lengths, strict=True))),
        ("Samples compared", f"{len(series.time)}, on the axes {''.join(_axes(series))}"),
        ("Held out", held),
        ("Calibration beside", f"misalignment {angles}; scale error {scales} (1σ)"),
    ]


def _axes(series: DiagnosisSeries) -> dict[str, str]:
    """Axes that the reference measures, with what they are called."""
    return {axis: where for (axis, where), measured in zip(BODY_AXES.items(), series.measured, strict=True) if measured}


def _with_std(values: Array, std: Array, unit: str) -> str:
    triples = zip("xyz", values, std, strict=True)
    return ", ".join(f"{axis} {signed(value)} ± {sigma:.2f}{unit}" for axis, value, sigma in triples)


def _left(d: Diagnosis) -> str:
    gap, series = d.gap, d.series
    if not math.isfinite(gap.after):
        return "Not known: this data says nothing of the gap."
    amount = (
        f"{_mm(gap.after)} rms, noise of {_mm(gap.noise_floor)} included, on held-out data: {_mm(gap.not_explained)} "
        "are not explained."
    )
    if series is None:
        return amount
    rest = series.rest
    if rest.found:
        return f"{amount} It still follows {rest.about} (p = {_p(math.exp(rest.log_p))})."
    return f"{amount} Nothing in it follows motion or time more than chance would (p = {_p(math.exp(rest.log_p))})."


def _p(p: float) -> str:
    return f"{p:.2g}" if p >= 1e-300 else "below 1e-300"


def _alternative(effect: FoundEffect) -> str:
    return f"This data cannot tell {effect.name} from {' or '.join(effect.equivalent_to)}; each explains it as well."


# ------------------------------------------------------------------ tables


def _where_table(d: Diagnosis) -> Table:
    rows = [
        (
            f"{place.axis} ({BODY_AXES[place.axis]})", place.regime, "{:.0f} to {:.0f}".format(*place.segment_s),
            "{:.2g} to {:.2g}".format(*place.band_hz), _per_cent(place.share), _p(place.p),
        )
        for place in d.where[:MAX_PLACES]
    ]  # fmt: skip
    notes = ["Share: of the gap's energy. Places overlap: only the axes over all of the run add up."]
    if len(d.where) > MAX_PLACES:
        notes.append(f"The first {MAX_PLACES} of {len(d.where)} places; --json holds all.")
    return Table(("axis", "regime", "time, s", "band, Hz", "share", "p, adjusted"), rows, notes=notes)


def _effect_table(d: Diagnosis) -> Table:
    rows = [
        (
            " or ".join((effect.name, *effect.equivalent_to)), _per_cent(effect.closure), _p(effect.p),
            Cell("; ".join(_parameters(effect)), "text"),
        )
        for effect in d.effects
    ]  # fmt: skip
    return Table(
        ("effect", "closes alone", "p, adjusted", Cell("parameters (95 %)", "text")),
        rows,
        notes=(
            "The calibration is refitted with every effect. p is adjusted for all effects that were tried. "
            "Of names joined by “or”, the parameters are those of the first.",
        ),
    )


def _untestable_table(d: Diagnosis) -> Table:
    return Table(
        ("not testable", Cell("needs", "text")), [(name, Cell(needs, "text")) for name, needs in d.untestable.items()]
    )


def _detectable_table(d: Diagnosis) -> Table:
    rows: list[tuple[str | Cell, ...]] = []
    for name, sizes in d.minimum_detectable.items():
        specs = {spec.name: spec for spec in EFFECTS[name].parameters} if name in EFFECTS else {}
        for i, (parameter, size) in enumerate(sizes.items()):
            spec = specs.get(parameter)
            unit = "" if spec is None else f" {spec.unit}"
            worth = "–" if spec is None else f"{spec.typical:g}{unit}"
            kind = "text" if spec is None else "text good" if size <= spec.typical else "text far"
            rows.append((name if i == 0 else "", Cell(f"{parameter} {_three(size)}{unit}", kind), worth))
    return Table(
        ("effect", Cell("smallest size found", "text"), "worth knowing of"),
        rows,
        notes=(
            "The size that this data would show four times in five at the level of the tests; green where that is no "
            "more than the size worth knowing of.",
        ),
    )


def _noise_table(d: Diagnosis) -> Table:
    rows = [
        (
            finding.name, Cell(NOISE_MEANING.get(finding.name, ""), "text"),
            Cell("; ".join(f"{name} {_interval(*values)}" for name, values in finding.parameters.items()), "text"),
            _p(finding.p),
        )
        for finding in d.noise
    ]  # fmt: skip
    return Table(("finding", Cell("meaning", "text"), Cell("parameters (95 %)", "text"), "p, adjusted"), rows)


# ------------------------------------------------------------------ pictures


def _pictures(d: Diagnosis, series: DiagnosisSeries) -> dict[str, Any]:
    stamps_ns = _stamps(series)
    time = TimeAxis(stamps_ns)
    points = _window(series)
    before, after = series.held_out.before, series.held_out.after
    residuals = {"before": before, "after": after} if d.effects else {"residual": before}
    return {
        "regimes": [_regimes(series, residuals)],
        "traces": [
            {"title": effect.name, "pictures": list(_trace_pictures(effect.name, series, time, stamps_ns, points))}
            for effect in d.effects
            if series.traces[effect.name].any()
        ],
        **twin_context(series.twins, _axes(series), bool(d.effects)),
        "followed": [] if series.followed is None else [followed_picture(series.followed, _axes(series))],
    }


def _stamps(series: DiagnosisSeries) -> Array:
    """(M,) ns: the recordings one after the other, far enough apart for the axis to cut out what is between them."""
    apart = CUT_FROM_S + float(series.time.max()) * len(series.recordings)
    return np.asarray(1e9 * (series.time + series.recording_of * (series.time.max() + apart)), dtype=np.int64)


def _window(series: DiagnosisSeries) -> int:
    """Samples in a running mean."""
    interval = float(np.median(np.diff(series.time)))
    return max(3, round(WINDOW_S / interval), round(WINDOW_SHARE * len(series.time)))


def _regimes(series: DiagnosisSeries, residuals: Mapping[str, Array]) -> Picture:
    names = ["all of the run", *series.regimes]
    masks = [np.ones(len(series.time), dtype=bool), *series.regimes.values()]
    floor, block = series.held_out.floor, series.held_out.block
    gaps = {
        name: np.array([_gap(residual, floor, block, mask) for mask in masks]) for name, residual in residuals.items()
    }
    alt = "; ".join(
        f"{regime}: " + ", ".join(f"{name} {_mm(gaps[name][i, 0])}" for name in gaps) for i, regime in enumerate(names)
    )
    return picture(
        "Gap by regime of motion", alt, figures.gap_bars, names, gaps,
        caption="Held out."
        + (" Slow and fast: the lowest and the highest third of the speeds." if "slow" in series.regimes else ""),
    )  # fmt: skip


def _gap(
    residual: Array, floor: Array, block: NDArray[np.integer[Any]], mask: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Gap (m/s) in a part of the samples and its 95 per cent interval, by a bootstrap over blocks."""
    excess = np.bincount(block[mask], (residual**2 - floor)[mask].sum(axis=1), minlength=block.max() + 1)
    counts = np.bincount(block[mask], minlength=block.max() + 1)
    at = np.random.default_rng(0).integers(0, len(counts), (RESAMPLES, len(counts)))
    resampled = excess[at].sum(axis=1) / np.maximum(counts[at].sum(axis=1), 1)
    low, high = np.percentile(resampled, [2.5, 97.5])
    value, low, high = np.sqrt(np.maximum([excess.sum() / counts.sum(), low, high], 0.0)).tolist()
    return value, low, high


def _closures(d: Diagnosis) -> Picture:
    alone = ", ".join(f"{effect.name} {_per_cent(effect.closure)}" for effect in d.effects)
    return picture(
        "Closure", f"Share of the gap closed: {alone}; together {_per_cent(d.gap.closure)}",
        figures.closure_bars, [effect.name for effect in d.effects], np.array([e.closure for e in d.effects]),
        (d.gap.closure, *d.gap.interval), caption="Line: 95 % interval, by a bootstrap over blocks of time.",
    )  # fmt: skip


def _trace_pictures(
    name: str, series: DiagnosisSeries, time: TimeAxis, stamps_ns: Array, points: int
) -> Iterable[Picture]:
    trace = series.traces[name]
    measured = series.held_out.after + trace
    energy = (trace**2).sum(axis=0)
    smooth = [float(np.nansum(running_mean(stamps_ns, each, points)[1] ** 2)) for each in trace.T]
    for name_of_axis, where in _axes(series).items():
        axis = "xyz".index(name_of_axis)
        if smooth[axis] > AXIS_SHARE * sum(smooth):
            lines = {"measured": measured[:, axis], name: trace[:, axis]}
            yield picture(
                f"{name}, {where}", f"Measured trace {where} beside the trace of {name}, running mean in mm/s",
                figures.over_time, time, stamps_ns, lines, points, f"{where}, mm/s",
            )  # fmt: skip
    drawn = energy > AXIS_SHARE * energy.sum()
    yield picture(
        f"Measured against {name}", f"Means of what was measured in groups of what {name} adds, with 95 % intervals",
        figures.measured_against_effect, trace[:, drawn].ravel(), measured[:, drawn].ravel(),
        caption="Points on the line: what was measured is what the effect adds.",
    )  # fmt: skip
