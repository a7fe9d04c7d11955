"""A document is laid out once: a terminal, a page and a data frame show the same words and numbers."""

from __future__ import annotations

import io
import math
import re
import sys
from html import unescape

import pytest
from report_fixtures import comparison as compared
from rich.console import Console

import dvl_calib_ros.api  # noqa: F401  results learn from it how they are laid out
from dvl_calib_ros.effects.registry import EFFECTS
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.present.comparison import comparison
from dvl_calib_ros.present.document import Answer, Cell, Document, Section, Sentence, Table, Where, section, table_by
from dvl_calib_ros.present.numbers import intervals, number, two, with_std
from dvl_calib_ros.present.page import breakable, write_document
from dvl_calib_ros.present.terminal import shown
from dvl_calib_ros.verdict.kinds import Severity

TABLE = Table(("", "n"), [("row", Cell("1.5", "bad", "beside"))])
MADE = Document(
    title="A <title>",
    subtitle="of \x1b[31mtwo",
    answer=Answer("off", Severity.MARGINAL, ["The [bold]first[/]\x07.", "The second."]),
    warnings=["a <warning>"],
    sections=[
        Section("Both", [Sentence("Said to both.", soft=True), TABLE]),
        Section("Page", [Sentence("For the page.")], Where.PAGE),
        Section("Terminal", [Sentence("For the terminal.")], Where.TERMINAL),
        Section("Empty", []),
    ],
    parameters={"min_speed": 0.3},
)


def at_terminal(document: Document) -> str:
    out = Console(file=io.StringIO(), width=200)
    for each in shown(document):
        out.print(each)
    return out.file.getvalue()


def on_page(document: Document, tmp_path) -> str:
    write_document(tmp_path / "page.html", document)
    text = re.sub(r"<(style|script|title).*?</\1>", "", (tmp_path / "page.html").read_text(), flags=re.DOTALL)
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", text)).split())


def test_what_both_show_is_the_same_and_what_one_shows_is_not_at_the_other(tmp_path):
    terminal, page = " ".join(at_terminal(MADE).split()), on_page(MADE, tmp_path)
    for words in ("The [bold]first[/]", "The second.", "Said to both.", "Both", "row", "1.5", "beside"):
        assert words in terminal and words in page, words
    assert "For the page." in page and "For the page." not in terminal
    assert "For the terminal." in terminal and "For the terminal." not in page
    assert "Empty" not in terminal and "Empty" not in page
    assert "\x07" not in terminal and "A <title>" in page and "min_speed" in page


def test_a_comparison_has_the_same_numbers_at_a_terminal_and_on_a_page(tmp_path):
    document = comparison(compared("it"))
    cells = [cell for table in document.tables.values() for row in table.rows for cell in row]
    terminal, page = at_terminal(document), on_page(document, tmp_path)
    assert len(cells) > 50
    for cell in cells:
        assert cell in terminal and " ".join(cell.split()) in page, cell


def test_a_table_is_a_data_frame():
    pandas = pytest.importorskip("pandas")
    frame = TABLE.frame()
    assert isinstance(frame, pandas.DataFrame) and frame.loc[0, "n"] == 1.5


def test_a_column_of_numbers_with_a_deviation_is_two_of_floats_and_one_of_words_is_left():
    pytest.importorskip("pandas")
    rows = [("a", "−1.50 ± 0.25", "3", "7 of 9", "2.0 ?"), ("b", Cell("–", "off"), "–", "–", "1.0")]
    frame = Table(("", "yaw, °", "n", "χ²", "δk"), rows).frame()
    assert list(frame.columns) == ["", "yaw, °", "yaw, ° ±1σ", "n", "χ²", "δk", "δk shown"]
    assert list(frame["δk"]) == [2.0, 1.0] and list(frame["δk shown"]) == [False, True]
    assert frame["yaw, °"][0] == -1.5 and frame["yaw, ° ±1σ"][0] == 0.25 and frame["n"][0] == 3.0
    assert frame[["yaw, °", "n"]].isna().iloc[1].all() and list(frame["χ²"]) == ["7 of 9", "–"]


def test_tables_below_one_heading_are_numbered_and_one_that_is_shown_twice_counts_once():
    other = Table(("", "m"), [("row", "2")])
    sections = [
        section("One", TABLE, where=Where.TERMINAL), section("One", TABLE, other, where=Where.PAGE),
        section("", Table(("k",), [("1",)])),
    ]  # fmt: skip
    made = Document("Title", "", None, (), sections)
    assert list(made.tables) == ["One", "One (2)", "One (3)"] and made.tables["One (2)"] is other


def test_results_give_their_tables_as_data_frames_by_their_headings(monkeypatch):
    pytest.importorskip("pandas")
    result = compared("monday.yaml")
    frames = result.tables()
    assert list(frames)[:2] == ["Calibrations", "Differences, the later less the earlier"]
    assert list(frames["Calibrations"][""]) == ["monday.yaml", "tuesday.yaml", "wednesday.yaml"]
    assert frames["Calibrations"]["yaw, °"].iloc[-1] == pytest.approx(math.degrees(0.012), abs=0.006)
    assert frames["Calibrations"]["yaw, ° ±1σ"].iloc[0] == pytest.approx(math.degrees(0.001), abs=0.006)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pip install pandas"):
        result.tables()


@pytest.mark.parametrize(("value", "said"), [(1.005, "1.00"), (-0.001, "0.00"), (-2.5, "−2.50"), (float("nan"), "–")])
def test_numbers_have_no_minus_before_zero_and_a_dash_where_there_is_none(value, said):
    assert number(value) == said
    assert with_std(value, float("nan")) == "–"


def test_a_table_is_a_row_for_each_object_by_what_its_columns_hold_of_it():
    made = table_by({"n": str, "square": lambda n: Cell(str(n * n), "text")}, [2, 3], ("note",))
    assert made.rows == [["2", Cell("4", "text")], ["3", Cell("9", "text")]]
    assert made.head == ["n", Cell("square", "text")]  # a text's heading is aligned as it is
    assert made.notes == ("note",)


def test_a_topic_is_broken_between_its_parts_only():
    assert breakable("/a50/dvl_data") == "/<wbr>a50/<wbr>dvl_<wbr>data"
    assert breakable("<b> _ /") == "&lt;b&gt; _ /"


def test_sizes_are_said_in_units_that_people_use():
    values = (0.0421, 0.03, 0.05)
    assert intervals({"sin_rad": values}, EFFECTS["heading_error"]) == "sin 2.4° (1.7 to 2.9)"
    assert intervals({"seconds": values}, EFFECTS["dvl_time_offset"]) == "42 ms (30 to 50)"
    assert intervals({"x_m": (-0.238, -0.287, -0.188)}, EFFECTS["lever_arm"]) == "x −0.24 m (−0.29 to −0.19)"
    assert two(2.86479) == "2.9" and two(100.0) == "100" and two(0.00872665) == "0.0087"
    assert intervals({"seconds": (1.5, 1.0, 2.0)}, EFFECTS["dvl_time_offset"]) == "1.5 s (1.0 to 2.0)"
    assert intervals({"x_mps": values, "y_mps": (0.0, 0.0, math.inf)}, EFFECTS["velocity_bias"]) == (
        "x 42 mm/s (30 to 50); y 0.00 m/s (0.00 to ∞)"
    )
    assert intervals({"ratio": values}, EFFECTS["sound_speed_moved"]) == "ratio 4.2 % (3.0 to 5.0)"
    assert intervals({"share": values}) == "share 0.042 (0.030 to 0.050)"
    assert intervals({}) == "–"


def test_every_effect_says_what_to_do_about_it():
    assert [name for name, effect in EFFECTS.items() if not effect.remedy] == []
