"""`dvl-calib compare`: result files and bags, exit codes, pictures, and one line for what cannot be compared."""

from __future__ import annotations

import copy
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command_line import fail
from report_fixtures import comparison, drawn
from yaml_text import parsed

import dvl_calib_ros as dc
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.present.comparison_figures import trend

SHORT = ("--trajectory", "box", "--duration", "120", "--gnss-std", "0.05")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Bags a, b of one mounting and c of one that is turned by 2.6°, d by 1.7°; result files (JSON, which is YAML)."""
    folder = tmp_path_factory.mktemp("compare")
    for seed, (name, yaw) in enumerate((("a", "2"), ("b", "2"), ("c", "4.6"), ("d", "3.7"))):
        bag = str(folder / name)
        assert main(["simulate", bag, *SHORT, "--seed", str(seed), "--misalignment", "1", "-1", yaw]) == 0
        assert main(["replay", bag, "--save", f"{bag}.yaml"]) == 0
    for day, name in enumerate("abcd"):
        document = parsed((folder / f"{name}.yaml").read_text())
        for key in document["time_span"]:
            document["time_span"][key] += day * 86_400_000_000_000
        (folder / f"{name}.yaml").write_text(json.dumps(document))
    return folder


def test_the_same_mounting_is_exit_code_0_and_a_moved_one_4_with_a_sentence(place, capsys):
    a, b, c = (str(place / f"{name}.yaml") for name in "abc")
    capsys.readouterr()
    assert main(["compare", a, b]) == 0
    assert capsys.readouterr().out.startswith("same: No movement found; smaller than")
    assert main(["compare", c, a, b]) == 4
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith("moved: The mounting has moved in yaw by") and "(c.yaml)" in said


def test_what_differs_by_some_three_sigma_is_suspicious_and_exit_code_3(place, tmp_path, capsys):
    out, page = tmp_path / "c.json", tmp_path / "c.html"
    asked = [str(place / "b.yaml"), str(place / "d.yaml"), "--json", str(out), "--report", str(page)]
    assert main(["compare", *asked]) == 3
    assert capsys.readouterr().out.startswith("suspicious: The mounting may have moved in yaw by")
    assert json.loads(out.read_text())["verdict"] == "suspicious"
    assert "suspicious" in page.read_text()


def test_sigma_and_angles_are_those_that_replay_prints_upside_down_and_across(tmp_path):
    """Of a DVL at 45 degrees roll and pitch of a URDF are neither of the vehicle's axes."""
    nominal, bag = ("3.14159265", "0", "0.78539816"), tmp_path / "a"
    words = ("--mounting-rpy", *nominal, "--misalignment", "1", "-1", "2", "--waves", "1", "6", "--seed", "1")
    assert main(["simulate", str(bag), *SHORT, *words]) == 0
    run = dc.replay(bag, history=False, mounting_rpy=[float(each) for each in nominal])
    run.save(tmp_path / "a.yaml")
    assert main(["simulate", str(tmp_path / "b"), *SHORT, *words[:-1], "2"]) == 0
    other = dc.replay(tmp_path / "b", history=False, mounting_rpy=[-float(nominal[0]), 0.0, float(nominal[2])])
    compared = [dc.compare(first, other).calibrations for first in (run, tmp_path / "a.yaml")]
    for own, again in compared:
        assert np.degrees(own.value[:3]) == pytest.approx(run.mounting.rpy_deg, abs=1e-9)
        assert own.shown[:3].all()
        printed = [*np.radians(run.mounting.std_deg), *run.mounting.xyz_std_m, run.mounting.scale_std_percent / 100.0]
        np.testing.assert_allclose(own.std[:7][own.shown[:7]], np.array(printed)[own.shown[:7]], rtol=1e-9)
        assert own.value[0] > 3.0 and again.value[0] > 3.0


def test_json_and_pictures_say_the_same(place, tmp_path, monkeypatch, capsys):
    out, page, png = tmp_path / "c.json", tmp_path / "c.html", tmp_path / "c.png"
    results = [str(place / f"{name}.yaml") for name in "abc"]
    with monkeypatch.context() as patch:
        drawn(patch)  # the page's are counted
        assert main(["compare", *results, "--json", str(out), "--report", str(page)]) == 4
    document = json.loads(out.read_text())
    assert document["same_mounting"] is False and len(document["pairs"]) == 3
    (moved,) = document["moved"]
    assert (moved["last_before"], moved["first_after"]) == ("b.yaml", "c.yaml")
    assert abs(moved["value"]["yaw"] - 0.0349) < 3 * moved["std"]["yaw"]
    text = page.read_text()
    assert document["says"][0] in text and text.count("<img") >= 2
    assert main(["compare", *results, "--report", str(png)]) == 4
    assert png.read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()
    for command, wrong in (("replay", png), ("compare", tmp_path / "c.pdf")):
        assert main([command, *results, "--report", str(wrong)]) == 2
        assert "a page (HTML); give a name that ends in .html" in capsys.readouterr().err
    assert png.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("hours_apart", [0.25, 9, 240, 24 * 500])
def test_dates_below_a_trend_do_not_run_into_each_other(monkeypatch, hours_apart):
    figures = drawn(monkeypatch)
    trend(comparison("monday.yaml", apart_s=round(3600 * hours_apart)))
    (axes,) = figures[0].axes
    figures[0].canvas.draw()
    low, high = axes.get_xlim()
    labels = [label for at, label in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True) if low <= at <= high]
    boxes = [label.get_window_extent() for label in labels]
    assert len(boxes) > 1
    assert all(before.x1 < after.x0 for before, after in pairwise(boxes))


def test_a_result_with_a_field_missing_or_without_samples_is_one_line(place, tmp_path, capsys):
    document = parsed((place / "b.yaml").read_text())
    for path, says in (
        (("time_span",), "damaged"), (("mounting", "corrected_rpy"), "damaged"), (("model",), "damaged"),
        (("parameters",), "damaged"),
    ):  # fmt: skip
        broken = copy.deepcopy(document)
        part = broken
        for key in path[:-1]:
            part = part[key]
        del part[path[-1]]
        bad = tmp_path / "broken.yaml"
        bad.write_text(json.dumps(broken))
        assert says in fail(capsys, "compare", place / "a.yaml", bad)
    for estimate in document["models"].values():
        estimate["used"] = 0
    document["used"] = 0
    empty = tmp_path / "empty.yaml"
    empty.write_text(json.dumps(document))
    assert "used no sample" in fail(capsys, "compare", place / "a.yaml", empty)


def test_one_alone_twice_the_same_and_a_file_that_is_not_there_are_one_line(place, tmp_path, capsys):
    a = place / "a.yaml"
    assert "one alone cannot be compared; name two" in fail(capsys, "compare", a)
    assert "cannot be compared with itself" in fail(capsys, "compare", a, a)
    (tmp_path / "copy.yaml").write_bytes(a.read_bytes())
    for other in (tmp_path / "copy.yaml", place / "a"):  # the bag that it is from
        assert "are the same calibration" in fail(capsys, "compare", place / "b.yaml", a, other)
    with pytest.raises(dc.InputError, match="same calibration"):
        dc.compare(a, tmp_path / "copy.yaml")
    assert "no such" in fail(capsys, "compare", a, tmp_path / "nothing.yaml")
    assert "a.yaml" in fail(capsys, "compare", a, place / "b.yaml", "--json", a)


@pytest.mark.parametrize("words", [("compare", "RESULT", "BAG"), ("simulate", "new", "--motion-of", "BAG")])
def test_what_is_missing_of_a_damaged_bag_is_said(place, tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    content = (place / "b" / "b.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: 9 * len(content) // 10])
    assert main([{"RESULT": str(place / "a.yaml"), "BAG": "cut.mcap"}.get(word, word) for word in words]) == 0
    errors = capsys.readouterr().err
    assert errors.count("cut.mcap: damaged or cut off") == 1 and "whole messages" in errors
