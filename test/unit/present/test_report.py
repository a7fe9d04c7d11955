"""Reports: what stands in them is what was found, whatever the data; nothing in a bag becomes markup."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import sys
import zlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from command_line import fail, in_fresh_process, succeed
from io_fixtures import run, steady_run, write_bag
from report_fixtures import FEW, Page, assert_described, drawn, evaluation, recorded, replay_page
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.bag_replay.replay import KEPT_STATES, KEPT_VELOCITIES, Recorder, Thinned, replay
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import BY_VELOCITY, MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ReferenceSample
from dvl_calib_ros.calibration.results.mounting_quantities import not_shown, quantities
from dvl_calib_ros.calibration.results.results import Result
from dvl_calib_ros.files.urdf import numbers
from dvl_calib_ros.present.figure_style import MODEL_STYLES, MapTrack, TimeAxis, explorable, new_figure
from dvl_calib_ros.present.page import plain, write_report
from dvl_calib_ros.present.replay import replayed as document_of
from dvl_calib_ros.present.replay_figures import ModelLine, _hull, estimate_over_time, held_out_errors
from dvl_calib_ros.verdict.kinds import Severity

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A report of a replay, and what was replayed."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        drawn(monkeypatch)  # they take most of the time; `evaluated` has them
        path, replayed = replay_page(tmp_path_factory.mktemp("report"), models=BY_VELOCITY)
    return Page(path), replayed


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory) -> Page:
    path = tmp_path_factory.mktemp("evaluation") / "evaluation.html"
    write_report(path, evaluation())
    return Page(path)


# ------------------------------------------------------------------ what it says


def test_the_verdict_on_the_selected_model_comes_first_with_its_reasons(made):
    page, replayed = made
    verification = replayed.result.verifications[replayed.result.selected]
    start = page.text.index(verification.verdict.value)
    assert start < page.text.index(verification.reasons[0].full_sentence) < page.text.index("Estimates")


def test_the_held_out_errors_of_every_model_are_shown(made):
    page, replayed = made
    for name, verification in replayed.result.verifications.items():
        error = verification.held_out
        numbers = [f"{value:.4f}" for value in (error.uncorrected, error.corrected, error.predicted)]
        assert page.row(name)[1:] == [*numbers, str(error.samples), verification.verdict.value]


def test_without_verification_the_report_says_so(tmp_path, made, monkeypatch):
    drawn(monkeypatch)
    replayed = made[1]
    unverified = replace(replayed, result=replace(replayed.result, verifications={}))
    write_report(tmp_path / "report.html", document_of(unverified, [tmp_path], FEW))
    text = Page(tmp_path / "report.html").text
    assert "not verified" in text and "Held-out" not in text


def test_the_table_holds_every_models_estimates_in_degrees_and_per_cent(made):
    page, replayed = made
    for name, estimate in replayed.result.estimates.items():
        row = next(row for row in page.rows if row and row[0] == name and len(row) > 6)
        yaw = f"{np.degrees(estimate.state[2]):+.2f} ± {np.degrees(estimate.std[2]):.2f}".replace("-", "−")
        assert row[3].startswith(yaw)
        assert row[-4:-2] == [str(estimate.used), str(estimate.gated)]


def test_the_mounting_stands_large_on_top_as_a_user_mounts_it(made):
    page, replayed = made
    summary = page.text[: page.text.index("Recorded")].replace("−", "-")
    found = quantities(replayed.result)
    assert {each.name for each in found} >= {"roll", "pitch", "yaw", "scale"}
    for each in found:
        assert f"{each.in_unit(each.value)} ± {each.in_unit(each.std)} (1σ)" in summary
    assert "φ" not in summary and "from above" in summary and "from starboard" in summary


def test_an_angle_of_zero_is_written_as_zero():
    assert plain([math.pi, 6.16e-33, -1e-17]) == "3.14159 0 0" and numbers([6.16e-33, 0.5]) == "0 0.5"


def test_after_a_reject_there_is_no_mounting_and_no_drift_that_it_would_be_worth(tmp_path, monkeypatch):
    drawn(monkeypatch)
    bag = write_bag(tmp_path / "bag", run())
    replayed = recorded(bag, mounting_rpy=(0.0, 0.0, 0.3))
    assert replayed.result.verifications[replayed.result.selected].verdict is Severity.REJECT
    write_report(tmp_path / "report.html", document_of(replayed, [bag], FEW))
    text = Page(tmp_path / "report.html").text
    first = text[: text.index("Estimates")]
    assert "reject" in first and "configured" not in first and "DVL on the vehicle" not in first
    assert "ready to paste" not in text and "Effect on navigation" not in text


def test_warnings_of_models_that_were_not_chosen_are_folded_away(tmp_path, made, monkeypatch):
    drawn(monkeypatch)
    own = f"{made[1].result.selected}: says something"
    replayed = replace(made[1], notes=[own, "M7: is not the one", "all: of everything"])
    write_report(tmp_path / "report.html", document_of(replayed, [tmp_path], FEW))
    html = (tmp_path / "report.html").read_text()
    folded = html[html.index("<details>") : html.index("</details>")]
    assert "not chosen (1)" in folded and "M7: is not the one" in folded
    assert own not in folded and "all: of everything" not in folded


def test_the_static_transform_can_be_pasted(made):
    assert "ros2 run tf2_ros static_transform_publisher --x 0 --y 0 --z 0 --qx" in made[0].text


def test_warnings_are_shown(tmp_path, monkeypatch):
    drawn(monkeypatch)
    samples = [sample for sample in run() if isinstance(sample, DvlSample)]
    path, replayed = replay_page(tmp_path, samples)
    text = Page(path).text
    (lead,) = [found for found in replayed.findings if found.code == "BAG_NO_IMU"]
    assert text.count(lead.says) == 1 and lead.remedy in text and lead.code in text  # before all else, and once
    others = [note for note in replayed.notes if note != str(lead)]
    assert others and all(note in text for note in others)


def test_nothing_is_drawn_over_the_time_of_a_single_sample(tmp_path, monkeypatch):
    figures = drawn(monkeypatch)
    replay_page(tmp_path, [sample for sample in run() if isinstance(sample, DvlSample)][:2])
    assert len(figures) == 2  # samples by model, selection


@pytest.mark.slow
def test_every_figure_has_alternative_text_and_labelled_axes(tmp_path, monkeypatch):
    figures = drawn(monkeypatch)
    page = Page(replay_page(tmp_path, models=BY_VELOCITY)[0])
    path = tmp_path / "evaluation.html"
    write_report(path, evaluation())
    images = [*page.images(), *Page(path).images()]
    assert len(figures) > 25
    assert_described(images, figures)


def test_models_can_be_told_apart_and_look_the_same_everywhere():
    assert set(MODEL_STYLES) == set(MODELS)
    assert len(set(MODEL_STYLES.values())) == len(MODELS)


@pytest.mark.slow
def test_the_same_data_gives_the_same_figures(tmp_path):
    pages = []
    for path in (tmp_path / "once.html", tmp_path / "again.html"):
        write_report(path, evaluation(each=None, held_out=(), coverage=(), convergence=()))
        pages.append(Page(path))
    assert pages[0].images() == pages[1].images() != []


# ------------------------------------------------------------------ self-contained and safe


def test_the_page_loads_nothing_and_runs_only_its_own_two_scripts(made, evaluated):
    for page in (made[0], evaluated):
        names = [tag for tag, _ in page.tags]
        assert not {*names} & {"iframe", "object", "form"}
        assert names.count("script") == 2
        sources = [value for _, attributes in page.tags for key, value in attributes.items() if key in ("src", "href")]
        assert sources and all(source.startswith("data:") for source in sources)
        policy = next(attributes["content"] for tag, attributes in page.tags if "http-equiv" in attributes)
        scripts = re.findall(r"<script>(.*?)</script>", page.source, re.DOTALL)
        hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
        allowed = [part.split() for part in policy.split("; ") if part.startswith("script-src")]
        assert "default-src 'none'" in policy and allowed == [["script-src", *(f"'sha256-{each}'" for each in hashes)]]


@pytest.mark.slow
def test_nothing_in_a_bag_becomes_markup(tmp_path):
    """Pictures and all."""
    folder = tmp_path / "<script>alert(1)<"
    folder.mkdir()
    path, replayed = replay_page(folder, dvl_frame='x"><img src=x onerror=alert(2)>')
    assert replayed.dvl_frame.startswith('x">')
    page = Page(path)
    assert [tag for tag, _ in page.tags].count("script") == 2
    assert all(image["src"].startswith("data:image/svg+xml;base64,") for image in page.images())
    assert "<script>alert(1)<" in page.text and "onerror=alert(2)" in page.text


def test_names_of_trajectories_are_text_in_tables_and_figures(evaluated):
    assert "T$1$<b>" in evaluated.text and "T99 is <i>missing</i>" in evaluated.text
    assert not {"b>", "i"} & {tag for tag, _ in evaluated.tags}
    figures = [base64.b64decode(image["src"].split(",")[1]) for image in evaluated.images()]
    assert not any(b"mathdefault" in figure for figure in figures)


def test_the_data_of_an_explorable_figure_is_what_the_figure_draws():
    seconds = np.arange(3000)
    time = TimeAxis(SECOND * seconds)
    value = np.where(seconds == 7, np.nan, np.sin(seconds / 300.0))
    figure = estimate_over_time(
        time, SECOND * seconds, [ModelLine("full", value, 0.5 + 0.0 * value)], "full", "roll, °"
    )
    plot = json.loads(zlib.decompress(base64.b64decode(explorable(figure))))
    (line,), (sleeve,) = plot["lines"], plot["sleeves"]
    assert (line["name"], plot["y_label"], plot["x_label"]) == ("full", "roll, °", "time from the start, min")
    assert 500 <= len(line["x"]) == len(line["y"]) <= 1500 and len(sleeve["x"]) > 500
    expected = np.interp(60.0 * np.array(line["x"]), seconds, np.sin(seconds / 300.0))
    np.testing.assert_allclose(np.array(line["y"], dtype=float), expected, atol=1e-3)
    np.testing.assert_allclose(np.subtract(sleeve["high"], sleeve["low"]), 1.0, atol=1e-3)


def test_the_points_of_a_track_lie_where_the_map_shows_them():
    figure, axes = new_figure()
    (line,) = axes.plot([0.0, 4.0, 8.0], [0.0, 2.0, 2.0], color="#1f6fb2")
    axes.add_line(MapTrack(line, "a run", np.array([0.0, 1.0, 2.0])))
    axes.set_xlim(0.0, 8.0)
    axes.set_ylim(0.0, 4.0)
    plot = json.loads(zlib.decompress(base64.b64decode(explorable(figure))))
    box = axes.get_position()
    assert plot["times"] == [0.0, 1.0, 2.0] and plot["run"] == "time a run"
    (track,) = plot["tracks"]
    np.testing.assert_allclose(track["x"], 100.0 * (box.x0 + box.width * np.array([0.0, 0.5, 1.0])), rtol=1e-3)
    np.testing.assert_allclose(track["y"], 100.0 * (1.0 - box.y0 - box.height * np.array([0.0, 0.5, 0.5])), rtol=1e-3)


def test_a_figure_that_is_not_over_time_has_no_data_for_the_script():
    assert explorable(held_out_errors(["full"], *np.ones((3, 1)))) == ""


# ------------------------------------------------------------------ unusual data


def test_a_bag_without_gnss_has_no_residuals(tmp_path, monkeypatch):
    drawn(monkeypatch)
    samples = [sample for sample in run() if not isinstance(sample, ReferenceSample)]
    page = Page(replay_page(tmp_path, samples)[0])
    assert "Too few of them have a reference for residuals" in page.text
    assert "Residual" not in page.text and "Models with GNSS" not in page.text and "Models without GNSS" in page.text


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_a_report_of_hardly_any_samples(tmp_path, count):
    page = Page(replay_page(tmp_path, steady_run(count))[0])
    assert f"{count} of the DVL" in page.text and len(page.images()) > 1


def test_the_hours_between_two_bags_are_cut_out():
    morning = np.arange(0, 100) * SECOND
    stamps = np.concatenate([morning, morning + 80_000 * SECOND])
    axis = TimeAxis(stamps)
    assert axis(stamps)[-1] < 210.0 and len(axis.breaks) == 1 and "cut out" in axis.label
    assert (np.diff(axis(stamps)) > 0.0).all()
    whole = TimeAxis(morning)
    assert not len(whole.breaks) and np.allclose(whole(morning), np.arange(100))


@pytest.mark.parametrize(("seconds", "unit"), [(300, ", s"), (3_000, ", min"), (30_000, ", h")])
def test_time_has_a_fitting_unit(seconds, unit):
    axis = TimeAxis(np.linspace(0, seconds * SECOND, 1000).astype(np.int64))
    assert axis.label.endswith(unit) and 1.0 < axis([seconds * SECOND])[0] <= 600.0


# ------------------------------------------------------------------ recorder


def test_recording_does_not_change_the_estimates(tmp_path):
    bag = write_bag(tmp_path / "bag", run())
    plain, with_history = replay([bag], Parameters()).result, recorded(bag).result
    for name, estimate in plain.estimates.items():
        other = with_history.estimates[name]
        assert (estimate.used, estimate.gated) == (other.used, other.gated)
        np.testing.assert_allclose(other.state, estimate.state, atol=1e-12)
        np.testing.assert_allclose(other.covariance, estimate.covariance, atol=1e-12)


@pytest.mark.slow
def test_the_history_ends_with_the_result_and_holds_what_the_models_saw(tmp_path):
    replayed = recorded(write_bag(tmp_path / "bag", run()))
    history, result = replayed.history, replayed.result
    for name, estimate in result.estimates.items():
        np.testing.assert_allclose(history.models[name].state[-1], estimate.state, atol=1e-12)
        np.testing.assert_allclose(history.models[name].std[-1], estimate.recording_std, atol=1e-12)
    assert len(history.dvl_ns) == result.counts["dvl"]["usable"]
    assert len(history.paired_ns) == result.counts["pairing"]["paired"]
    assert history.reference_velocity.shape == (len(history.paired_ns), 3)


@pytest.mark.parametrize("expected", [0, 7, 1000, 10**6])
@pytest.mark.parametrize("length", [5, 1000, 12_345])
def test_a_series_of_any_length_is_thinned_evenly(length, expected):
    series = Thinned(100, expected)
    for start in range(0, length, 77):
        series.add(np.arange(start, min(start + 77, length)))
    (rows,) = series.columns(())
    assert 1 <= len(rows) <= 100
    assert len(set(np.diff(rows))) <= 1
    if length >= expected:
        assert len(rows) >= min(length, 50)


@pytest.mark.slow
def test_a_long_recording_takes_no_more_memory_than_a_short_one(tmp_path):
    history = recorded(write_bag(tmp_path / "bag", steady_run(2000))).history
    assert KEPT_STATES // 2 <= len(history.stamps_ns) <= KEPT_STATES + 1
    assert KEPT_VELOCITIES // 2 <= len(history.dvl_ns) <= KEPT_VELOCITIES


def test_after_a_restart_the_history_starts_anew():
    recorder = Recorder(Parameters())
    calibrator = Calibrator(
        Parameters(), block_size=8, on_rows=recorder.take, on_restart=recorder.start, trace=recorder.trace
    )
    first = steady_run(100)
    later = [sample._replace(stamp_ns=sample.stamp_ns + 1_000 * SECOND) for sample in steady_run(300)]
    for sample in [*later, *first]:
        if isinstance(sample, ReferenceSample):
            calibrator.feed_reference(sample)
        else:
            calibrator.feed_dvl(sample)
    calibrator.finish()
    history = recorder.history(calibrator, calibrator.result().estimates)
    assert calibrator.restarts == 1
    for stamps in (history.stamps_ns, history.dvl_ns, history.paired_ns):
        assert first[0].stamp_ns <= min(stamps) and max(stamps) <= first[-1].stamp_ns


# ------------------------------------------------------------------ command


def test_replay_writes_a_report_and_keeps_the_old_one(tmp_path, monkeypatch, capsys):
    drawn(monkeypatch)
    bag = write_bag(tmp_path / "bag", run())
    report = tmp_path / "report.html"
    report.write_text("old")
    succeed(capsys, "replay", bag, "--report", report, "--models", "M7")
    assert (tmp_path / "report.html.bak").read_text() == "old"
    page = Page(report)
    shown = {row[0] for row in page.rows if row and row[0] in MODELS}
    assert shown == {"M7", "full"}  # what was asked for, and the selected one


def test_without_the_plot_library_the_message_says_what_to_install(tmp_path, capsys, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("dvl_calib_ros.present")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    bag = write_bag(tmp_path / "bag", run())
    assert "pip install matplotlib jinja2" in fail(capsys, "replay", bag, "--report", tmp_path / "report.html")


def test_a_replay_without_report_imports_no_plots(tmp_path):
    bag = write_bag(tmp_path / "bag", run())
    statement = f"from dvl_calib_ros.cli.main import main; main(['replay', {str(bag)!r}])"
    assert in_fresh_process(statement, ["matplotlib", "jinja2", "dvl_calib_ros.present.page"]) == []


# ------------------------------------------------------------------ evaluation


def test_the_summary_of_an_evaluation_names_the_best_of_each_kind(evaluated):
    best_free = next(name for name, model in MODELS.items() if not model.aided)
    assert "best with GNSS 0.0300 m/s M1, 75 % less than uncalibrated" in evaluated.text
    assert re.search(f"best without GNSS [0-9.]+ m/s {best_free}, ", evaluated.text)


def test_a_score_stands_beside_the_published_one_coloured_by_its_deviation(evaluated):
    html = evaluated.source
    assert re.search('<td[^>]* class="good"[^>]*>0.0300<small>0.0301 ×1.00</small></td>', html)
    assert ' class="bad"' in html  # M2, far from the 0.10 of the made-up publication
    last = list(MODELS)[-1]
    assert evaluated.row(last)[2:4] == ["–", "–"]  # no attitude there: neither the set nor the mean


def test_own_trajectories_are_not_compared_with_the_published_figures(tmp_path, monkeypatch):
    drawn(monkeypatch)
    path = tmp_path / "evaluation.html"
    write_report(path, evaluation(own_generator=True))
    page = Page(path)
    assert "simulated" in page.text and "×" not in page.text and "Rings: published" not in page.text


def test_an_evaluation_without_studies_has_no_empty_sections(tmp_path):
    path = tmp_path / "evaluation.html"
    bare = evaluation(each=None, held_out=(), coverage=(), convergence=())
    write_report(path, bare)
    text = Page(path).text
    for section in ("Can the uncertainty", "each run", "Held-out"):
        assert section not in text


@pytest.mark.parametrize("place", [(0.8, 0.0, -0.35), (0.0, 0.0, 0.0)])
def test_no_letter_of_an_axis_of_the_dvl_stands_on_the_title_of_an_axis_of_the_figure(place):
    nominal, found = (rotation_from_rpy(np.radians([roll, 0.0, 45.0])) for roll in (180.0, 178.0))
    figure = _hull((0, 2, "up"), nominal, found, place, False)
    figure.canvas.draw()
    axes = figure.axes[0]
    letters = [each for each in axes.texts if each.get_text() in ("x", "y", "z")]
    assert letters
    for each in letters:
        box = each.get_window_extent()
        assert axes.bbox.y0 <= box.y0 and box.y1 <= axes.bbox.y1


@cache
def straight(yaw: int) -> Result:
    """`full` on a straight leg, whose vehicle does not roll, with a DVL that is mounted with this yaw (degrees)."""
    rpy = (0.0, 0.0, float(np.radians(yaw)))
    run = MatchedRun("straight", 60.0, dvl_std=0.01, gnss_std=0.01, mounting_rpy=rpy)
    result = calibrate(make_samples(run), Parameters(mounting_rpy=rpy), models=("full",)).result()
    return replace(result, selected="full")


@pytest.mark.parametrize("yaw", [0, 30, 45, 90, 180])
def test_an_axis_that_is_not_shown_is_the_vehicles_where_the_angle_of_that_name_is_shown(yaw):
    shown = {each.name: each.shown for each in quantities(straight(yaw))}
    named = " and ".join(not_shown(straight(yaw)).values()).split(" and ")
    assert ("roll" in named, "the vehicle's roll axis" in named) == (not shown["roll"], shown["roll"])
    assert ("pitch" in named) == (not shown["pitch"])
    assert set(named) - set(shown) <= {"the vehicle's roll axis"}  # the words of the table


def test_of_a_dvl_mounted_across_it_is_the_pitch_that_a_straight_leg_does_not_show():
    shown = {each.name: each.shown for each in quantities(straight(90))}
    assert shown["roll"] and not shown["pitch"]
    assert not {each.name: each.shown for each in quantities(straight(0))}["roll"]


def test_a_scale_across_is_not_asked_for():
    missing = {entry.axis for entry in straight(0).estimate.observability if entry.missing}
    named = " and ".join(not_shown(straight(0)).values()).split(" and ")
    assert "scale across" in missing and "scale across" not in named and "roll" in named
