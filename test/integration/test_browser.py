"""Reports in a real browser: no error, nothing loaded, every figure there, nothing wider than the screen."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fleet_fixtures import write_dive
from io_fixtures import run
from report_fixtures import comparison, cross_checked, diagnosis, evaluation, replay_page

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.discovery.discovery import Given
from dvl_calib_ros.parallel import Workers
from dvl_calib_ros.present.diagnosis import COMPARED_EFFECTS
from dvl_calib_ros.present.document import Document, section, table_by
from dvl_calib_ros.present.page import write_document, write_report
from dvl_calib_ros.unpaired.results import ComparedEffect, ComparisonStatus, Lies

pytestmark = pytest.mark.slow

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PHONE, DESKTOP = (375, 740), (1280, 900)
A4_WIDTH = 695  # without margins, at 96 dpi


@pytest.fixture(scope="module")
def browser() -> Iterator:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    with sync_api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def reports(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("reports")
    hostile = folder / "<img src=x onerror=alert(1)>"
    hostile.mkdir()
    made = {"replay": replay_page(hostile)[0]}
    made |= {name: folder / f"{name}.html" for name in ("evaluation", "diagnosis")}
    made |= {name: folder / f"{name}.html" for name in ("comparison", "cross_check")}
    write_report(made["comparison"], comparison(hostile.name))
    write_report(made["cross_check"], cross_checked(hostile.name))
    write_report(made["evaluation"], evaluation())
    write_report(made["diagnosis"], diagnosis())
    return made


@pytest.fixture(params=["replay", "evaluation", "diagnosis"])
def report(request, reports) -> Path:
    return reports[request.param]


@pytest.fixture(params=["replay", "evaluation", "diagnosis", "comparison", "cross_check"])
def any_report(request, reports) -> Path:
    return reports[request.param]


def opened(browser, report: Path, size: tuple[int, int]):
    """The page in the browser, and whatever went wrong or was loaded from elsewhere."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    problems: list[str] = []
    page.on("console", lambda message: problems.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("dialog", lambda dialog: (problems.append(dialog.message), dialog.dismiss()))
    page.on("request", lambda request: problems.append(request.url) if request.url != report.as_uri() else None)
    page.goto(report.as_uri())
    page.wait_for_selector("html[data-explorable=ready]", state="attached")
    problems = [problem for problem in problems if not problem.startswith("data:")]
    return page, problems


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_a_report_opens_without_an_error_and_shows_every_figure_and_table_on_any_screen(browser, any_report, size):
    page, problems = opened(browser, any_report, size)
    assert problems == []
    images = page.evaluate(
        """() => [...document.images].map(i => {
             const chart = i.parentElement.querySelector('.chart .u-wrap');  // what stands in a picture's place
             const box = (chart ?? i).getBoundingClientRect();
             return [i.complete, i.naturalWidth, box.width, box.height, box.right, i.alt.length]; })"""
    )
    assert len(images) == any_report.read_text().count("<figure") >= 4
    for complete, natural_width, width, height, right, alt in images:
        assert complete and natural_width > 100 and alt > 10
        assert width > 250 and height > 60 and right <= size[0]
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    tables = page.evaluate(
        """() => [...document.querySelectorAll('.scroll')].map(e => [e.scrollWidth <= e.clientWidth,
             [...e.querySelectorAll('td')].every(td => td.dataset.heading !== undefined)])"""
    )
    assert tables and all(whole and headed for whole, headed in tables)
    page.close()


def test_the_summary_is_on_the_first_screen_of_a_phone(browser, report):
    page, _ = opened(browser, report, PHONE)
    box = page.locator(".verdict, .said").first.bounding_box()
    assert box["y"] + box["height"] < PHONE[1]
    page.close()


def test_long_names_of_effects_break_where_a_tablet_is_too_narrow(browser, tmp_path):
    sizes = {name: (-1.875, -1.903, -1.846) for name in ("x_m", "y_m", "z_m")}
    effect = ComparedEffect(
        "lever_arm", ComparisonStatus.MISSING, ("velocity_bias",), sizes, sizes, 1e-4, 72.5,
        Lies("y", 0.9, "accelerating", 0.8, (0.05, 0.2), 0.7),
    )  # fmt: skip
    path = tmp_path / "effects.html"
    write_document(path, Document("Effects", "", None, [], [section("", table_by(COMPARED_EFFECTS, [effect]))]))
    page = browser.new_page(viewport={"width": 820, "height": 900})
    page.goto(path.as_uri())
    assert page.evaluate("(e => e.scrollWidth <= e.clientWidth)(document.querySelector('.scroll'))")
    page.close()


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_no_number_on_a_tile_is_broken_from_its_unit(browser, reports, size):
    page, _ = opened(browser, reports["replay"], size)
    tiles = page.evaluate("[...document.querySelectorAll('.number')].map(e => [e.innerText, e.clientWidth])")
    assert tiles
    for text, width in tiles:
        assert width >= 150 and not re.search(r"\d (%|m|s)\b", text)  # a no-break space is between them
    page.close()


def test_a_page_is_dark_where_the_reader_wants_that_and_white_and_whole_on_paper(browser, any_report):
    page, _ = opened(browser, any_report, DESKTOP)

    def lightness(of: str = "body", what: str = "backgroundColor") -> float:
        colour = page.evaluate(f"getComputedStyle(document.querySelector('{of}')).{what}")
        return float(np.mean([int(each) for each in re.findall(r"\d+", colour)[:3]]))

    assert lightness() > 250
    page.emulate_media(color_scheme="dark")
    assert lightness() < 40 and lightness(what="color") > 200
    page.emulate_media(color_scheme="dark", media="print")
    assert lightness() > 250 and lightness(what="color") < 60
    page.set_viewport_size({"width": A4_WIDTH, "height": 1000})
    right = page.evaluate("[...document.querySelectorAll('table, img, pre')].map(e => e.getBoundingClientRect().right)")
    least = 5 if any_report.stem in ("comparison", "cross_check") else 10
    assert len(right) > least and max(right) <= A4_WIDTH
    page.close()


def test_on_a_phone_no_table_of_a_fleet_is_scrolled_and_every_value_has_its_heading(browser, tmp_path):
    pytest.importorskip("pyarrow", reason="pip install '.[fleet]'")
    from dvl_calib_ros.fleet_catalogue.update import run_fleet

    for day in range(2):
        write_dive(tmp_path / "dives" / "auv1" / f"dive{day}", day, seed=day)
    found = run_fleet([str(tmp_path / "dives")], tmp_path / "out", Parameters(), Given(), Workers(1))
    write_report(found.page, found)
    page, _ = opened(browser, found.page, PHONE)
    tables = page.evaluate(
        """() => [...document.querySelectorAll('.scroll')].map(e => [e.scrollWidth <= e.clientWidth,
             [...e.querySelectorAll('.scroll td')].map(
               td => getComputedStyle(td, '::before').content.replaceAll('"', '') || '-')])"""
    )
    assert len(tables) >= 2 and all(fits for fits, _ in tables)
    assert next(headings for _, headings in tables if headings)[2:5] == ["mounting", "seen from, °", "roll, °"]
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]
    page.close()


def test_one_cursor_shows_the_values_of_that_time_in_every_figure_of_the_run(browser, reports):
    page, problems = opened(browser, reports["replay"], DESKTOP)
    figures = page.locator("figure.explorable")
    assert figures.count() > 8
    legend = figures.first.locator(".u-legend").inner_text().split()
    assert legend and "–" not in legend and "time," not in legend  # at rest, what each line is and no value
    hover(page, figures.first, 0.5)
    times = page.locator("figure.explorable .u-legend tr:first-child .u-value").all_text_contents()
    shown = [float(text) for text in times if text != "–"]
    # of every figure that has a value there, the nearest sample's time
    assert len(shown) == figures.count() and max(shown) - min(shown) < 0.05 * max(shown)
    assert problems == []
    page.close()


def test_a_zoom_is_shared_and_escape_or_the_button_shows_the_whole_run_again(browser, reports):
    page, problems = opened(browser, reports["replay"], DESKTOP)
    figures = page.locator("figure.explorable")
    bar, last = page.locator(".zoom"), figures.last
    for leave in (lambda: page.keyboard.press("Escape"), lambda: bar.get_by_text("whole run").click()):
        assert bar.is_hidden()
        hover(page, figures.first, 0.25)
        page.mouse.down()
        hover(page, figures.first, 0.5)
        page.mouse.up()
        assert bar.is_visible()
        low, high = (float(word) for word in bar.locator("span").text_content().split() if word[0].isdigit())
        hover(page, last, 0.999)
        at_the_end = float(last.locator(".u-legend tr:first-child .u-value").text_content())
        assert low < at_the_end <= high * 1.02
        leave()
    assert bar.is_hidden() and problems == []
    page.close()


def test_the_cursor_moves_a_point_along_each_track_of_the_map(browser, tmp_path):
    report, replayed = replay_page(tmp_path, run(150.0))
    assert replayed.navigation is not None and replayed.navigation.on_a_map
    page, _ = opened(browser, report, (DESKTOP[0], 12_000))  # all on one screen: to scroll takes the mouse off
    points = page.locator(".map span")
    assert points.count() == 3 and not any(point.is_visible() for point in points.all())
    seen = []
    for share in (0.2, 0.7):
        hover(page, page.locator("figure.explorable").first, share)
        assert all(point.is_visible() for point in points.all())
        boxes, frame = [point.bounding_box() for point in points.all()], page.locator(".map").bounding_box()
        assert all(frame["x"] < box["x"] < frame["x"] + frame["width"] for box in boxes)
        seen.append([(box["x"], box["y"]) for box in boxes])
    assert all(first != second for first, second in zip(*seen, strict=True))
    slider = page.locator(".slider")
    at = slider.input_value()
    assert 0 < int(at) < int(slider.get_attribute("max"))  # it follows the cursor
    slider.fill("1")
    moved = [point.bounding_box() for point in points.all()]
    assert all((box["x"], box["y"]) != before for box, before in zip(moved, seen[-1], strict=True))
    page.close()


def hover(page, figure, share: float) -> None:
    """Put the mouse over a chart, at this share of its width."""
    area = figure.locator(".u-over")
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    page.mouse.move(box["x"] + share * box["width"], box["y"] + 0.3 * box["height"], steps=4)


def test_without_scripts_and_on_paper_the_pictures_are_shown(browser, reports):
    for options, media in (({"java_script_enabled": False}, "screen"), ({}, "print")):
        context = browser.new_context(**options)
        page = context.new_page()
        page.goto(reports["replay"].as_uri())
        page.emulate_media(media=media)
        images = page.locator("figure img")
        assert images.count() > 10 and all(image.is_visible() for image in images.all())
        assert not any(chart.is_visible() for chart in page.locator(".chart").all())
        context.close()
