"""The report of a diagnosis: the answer first, held-out numbers, pictures that show what was measured."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import fail, succeed
from io_fixtures import run, write_bag
from report_fixtures import Page, assert_described, diagnosis, drawn

from dvl_calib_ros.calibration.assessment.dead_reckoning import Drift
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.diagnosis.answer.gap_closure import Gap
from dvl_calib_ros.diagnosis.answer.plotted_series import RegressorPlot
from dvl_calib_ros.diagnosis.answer.results import Diagnosis, DiagnosisVerdict, FoundEffect, diagnosis_document
from dvl_calib_ros.diagnosis.diagnose import diagnose
from dvl_calib_ros.present import diagnosis_pictures
from dvl_calib_ros.present.diagnosis import rms
from dvl_calib_ros.present.diagnosis_pictures import spectrum
from dvl_calib_ros.present.page import write_report
from dvl_calib_ros.verdict.reasons import finding

pytestmark = pytest.mark.slow  # a diagnosis and its figures take seconds each


TWIN_RMS = rms(diagnosis().series.twins[0].without)


def page_of(folder, found: Diagnosis) -> Page:
    path = folder / "diagnosis.html"
    write_report(path, found)
    return Page(path)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Page:
    return page_of(tmp_path_factory.mktemp("diagnosis"), diagnosis())


def positions(text: str, *parts: str) -> list[int]:
    return [text.index(part) for part in parts]


# ------------------------------------------------------------------ what it says


def test_the_answer_comes_first_then_which_effects_where_what_is_left_and_what_to_fly(page):
    found = diagnosis()
    order = positions(
        page.text, "ambiguous", found.sentence, "x 0.30 m (0.25 to 0.35)", "To do for lever_arm", "42.1 mm/s",
        "Which effects", "Where the gap lies", "Recorded against the simulated twin", "Residual",
        found.next_manoeuvre, "The noise",
    )  # fmt: skip
    assert order == sorted(order)


def test_held_out_gap_before_and_after_and_the_closure_stand_large(page):
    start = page.text[: page.text.index("Where the gap lies")]
    for shown in ("42.1 mm/s", "35.3 mm/s", "98 %", "91 % to 100 %", "34.6 mm/s", "7.0 mm/s", "claim 30.0 mm/s"):
        assert shown in start


def test_an_effect_whose_sizes_may_be_zero_is_not_offered_for_applying(tmp_path, monkeypatch):
    drawn(monkeypatch)
    for low, is_offered in ((0.1, True), (-0.1, False)):
        arm = FoundEffect("lever_arm", (), {"x_m": (0.5, low, 0.9)}, 0.85, 1e-9)
        series = diagnosis().series
        traced = replace(series, traces={"lever_arm": series.traces["lever_arm"]})
        offered = page_of(tmp_path, diagnosis(effects=(arm,), series=traced))
        assert ("To do for lever_arm" in offered.text) == is_offered


def test_what_the_gap_costs_is_said_in_metres_per_kilometre(tmp_path, monkeypatch):
    drawn(monkeypatch)
    found = diagnosis()
    costly = replace(found, gap=replace(found.gap, drift=(Drift(21.4, 0.0), Drift(3.26, 0.0))))
    said = "Drift per straight km, noise included: 21 m (2.1 %), 3.3 m (0.33 %) with the effects."
    assert said in page_of(tmp_path, costly).text
    assert diagnosis_document(costly)["gap"]["drift_m_per_km"] == {"before": 21.4, "after": 3.26}


def test_effects_that_cannot_be_told_apart_are_named_together_and_none_is_preferred(page):
    assert page.row("lever_arm or sideslip")[1:3] == ["85 %", "< 0.001"]
    assert "cannot distinguish lever_arm from sideslip" in page.text


def test_sizes_that_this_data_cannot_show_are_marked_against_those_worth_knowing(page):
    assert re.search('<td[^>]* class="text good"[^>]*>x 0.110 m</td>', page.source)  # 0.3 m would be worth knowing of
    assert re.search('<td[^>]* class="text far"[^>]*>z 0.900 m</td>', page.source)


def test_places_noise_and_untestable_effects_have_their_tables(page):
    assert page.row("y (to port)")[1:] == ["turning", "0 to 150", "0 to 2.5", "70 %", "< 0.001"]
    assert page.row("outliers")[2] == "share 0.020 (0.010 to 0.030)"
    assert page.row("water_lock") == ["water_lock", "attitude"]


def test_the_calibration_beside_the_effects_has_its_uncertainty(page):
    assert "misalignment x +1.00 ± 0.10°, y −2.00 ± 0.20°, z +3.00 ± 0.30°; scale error x +1.00 ± 0.10 %" in page.text


def test_what_is_left_says_what_it_follows_if_it_follows_anything(tmp_path, page, monkeypatch):
    drawn(monkeypatch)
    assert "Nothing in it follows motion or time" in page.text
    found = diagnosis()
    rest = replace(found.series.rest, log_p=-50.0)
    unknown = replace(found, verdict=DiagnosisVerdict.UNKNOWN, series=replace(found.series, rest=rest))
    said = finding("REST_FOLLOWS", about="turn rate").full_sentence.removesuffix(".")
    assert f"{said} (p < 0.001)" in page_of(tmp_path, unknown).text


def test_without_an_effect_there_is_one_residual_and_no_before_and_after(tmp_path, monkeypatch):
    drawn(monkeypatch)
    found = diagnosis()
    series = replace(found.series, traces={})
    nothing = replace(
        found, verdict=DiagnosisVerdict.NO_GAP,
        reasons=(finding("NO_GAP", noise=1.0, visible=2, tested=3),),
        effects=(), where=(), series=series,
        gap=Gap(0.001, 0.001, 0.03, float("nan"), (float("nan"), float("nan"))),
    )  # fmt: skip
    page = page_of(tmp_path, nothing)
    # the regimes; of two recordings three axes over time, and four more; and what is left
    assert len(page.images()) == 1 + 2 * 7 + 1
    assert page.row("first")[1:4] == ["all of the run", "100 %", f"{TWIN_RMS:.4f}"]
    for absent in ("before", "Which effects", "Closed", "Where the gap lies", "nan"):
        assert absent not in page.text


def test_data_that_says_nothing_gives_a_page_without_numbers_and_pictures(tmp_path):
    nan = float("nan")
    found = diagnosis(
        verdict=DiagnosisVerdict.INSUFFICIENT_EXCITATION,
        reasons=(finding("GAP_TOO_SHORT", samples=3, seconds=4.0, wanted=60.0),),
        gap=Gap(nan, nan, nan, nan, (nan, nan)),
        effects=(), noise=(), where=(), untestable={}, minimum_detectable={}, series=None,
    )  # fmt: skip
    page = page_of(tmp_path, found)
    assert page.images() == [] and page.rows == []
    assert (
        "insufficient excitation No gap can be measured in this recording: 3 samples" in page.text
        and "nan" not in page.text
    )
    assert found.next_manoeuvre in page.text


# ------------------------------------------------------------------ pictures


def test_every_figure_has_alternative_text_and_labelled_axes(tmp_path, monkeypatch):
    figures = drawn(monkeypatch)
    images = page_of(tmp_path, diagnosis()).images()
    assert len(figures) >= 13
    assert_described(images, figures)


def test_the_gap_of_a_regime_is_what_lies_there_beyond_the_noise():
    series = diagnosis().series
    turning = series.regimes["turning"]
    held = series.held_out
    expected = np.sqrt((held.before**2 - held.floor)[turning].sum(axis=1).mean())
    value, low, high = diagnosis_pictures._gap(held.before, held.floor, held.block, turning)
    assert value == pytest.approx(expected) and low < expected < high
    assert diagnosis_pictures._gap(held.after, held.floor, held.block, turning) == (0.0, 0.0, 0.0)


def test_the_spectrum_of_white_noise_is_flat_at_its_density():
    twin = diagnosis().series.twins[0]
    rng = np.random.default_rng(0)
    n = 20_000
    long = replace(twin, time=0.2 * np.arange(n), segments=(slice(0, n),))
    frequency, density = spectrum(long, rng.normal(0.0, 0.1, (n, 2)))
    expected = 0.1 * np.sqrt(2.0 * 2.0 * 0.2)  # the variance of two axes, spread evenly from 0 to 2.5 Hz
    above = frequency > 0.01
    assert frequency[-1] <= 2.5 and np.abs(density[above] / expected - 1.0).max() < 0.3


def test_what_is_left_is_shown_against_what_it_follows_with_means_and_their_errors(page):
    assert "Residual to port, against turn rate" in page.text
    at = np.linspace(-1.0, 1.0, 3000)
    left = 0.01 * at + np.random.default_rng(1).normal(0.0, 0.02, 3000)
    where, mean, std, error = RegressorPlot("turn rate, °/s", "x", at, left).groups()
    assert np.abs(mean - 0.01 * where).max() < 4.0 * error.max()
    assert std == pytest.approx(0.02, rel=0.2) and error == pytest.approx(0.02 / np.sqrt(200.0), rel=0.2)


# ------------------------------------------------------------------ from a bag


def test_the_series_are_those_that_the_gap_was_measured_on(tmp_path):
    bag = tmp_path / "lever"
    main(["simulate", str(bag), "--duration", "200", "--gnss-std", "0.03", "--effect", "lever_arm:x_m=0.5"])
    found = diagnose([bag], Parameters(), with_series=True)
    held = found.series.held_out
    n = len(found.series.time)
    for residual, gap in ((held.before, found.gap.before), (held.after, found.gap.after)):
        assert np.sqrt((residual**2).sum() / n) == pytest.approx(gap)
    assert set(found.series.traces) == {effect.name for effect in found.effects} == {"lever_arm"}
    page = page_of(tmp_path, found)
    assert page.row("lever_arm") and "lever_arm, to port" in page.text

    (twin,) = found.series.twins
    without, with_effects = (rms(each) for each in (twin.without, twin.with_effects))
    assert with_effects == pytest.approx(found.gap.after, rel=0.1) and without > 1.08 * with_effects
    assert rms(twin.without[twin.regimes["turning"]]) > 1.1 * rms(twin.without[twin.regimes["straight"]])
    assert twin.regimes.keys() == found.series.regimes.keys()


@pytest.mark.parametrize("effect", [(), ("--effect", "velocity_bias:x_mps=0.15")])
def test_one_noise_stands_on_a_page_and_its_twin_shows_a_gap_where_there_is_one(tmp_path, effect):
    """Of a reference five times slower than the DVL: between its samples it has no noise of its own."""
    bag = tmp_path / "slow"
    slow = "--duration 300 --dvl-rate 5 --gnss-rate 1 --gnss-std 0.03"
    main(["simulate", str(bag), *slow.split(), *effect])
    found = diagnose([bag], Parameters(), with_series=True)
    (twin,) = found.series.twins
    noise, left = np.sqrt((twin.noise**2).sum()), rms(twin.without)
    assert noise == pytest.approx(found.gap.noise_floor, rel=1e-9)
    assert left == pytest.approx(found.gap.before, rel=1e-9)
    assert [each.name for each in found.effects] == (["velocity_bias"] if effect else [])
    assert left > 1.05 * noise if effect else left == pytest.approx(noise, rel=0.02)


def test_the_command_writes_the_report_and_collects_series_only_for_it(tmp_path, capsys, monkeypatch):
    asked = []

    def answer(*_, with_series, **__):
        asked.append(with_series)
        return diagnosis()

    monkeypatch.setattr("dvl_calib_ros.diagnosis.diagnose.diagnose", answer)
    report, bag = tmp_path / "report.html", write_bag(tmp_path / "bag", run(6.0))
    succeed(capsys, "diagnose", bag, "--report", report)
    succeed(capsys, "diagnose", bag)
    assert asked == [True, False]
    assert diagnosis().sentence in Page(report).text
    assert "does not exist" in fail(capsys, "diagnose", bag, "--report", tmp_path / "none" / "report.html")
    assert len(asked) == 2  # refused before the work
