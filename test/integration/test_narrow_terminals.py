"""On a terminal of any width nothing is cut off: what is said at 300 columns is said at 80, 40 and 20."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import replayed, run, write_bag
from rich.console import Console
from rich.table import Table

from dvl_calib_ros.cli import common
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.cli.watch import View
from dvl_calib_ros.files.result_file import result_document, result_text
from dvl_calib_ros.node.listener import Status
from dvl_calib_ros.present.terminal import Folding

WIDTHS = [80, 20]


def numbers(text: str) -> Counter[str]:
    return Counter(re.findall(r"[-+]?\d[\d.]*", text))


def words(text: str) -> Counter[str]:
    return Counter(re.findall(r"[^\s│┃┏┓┗┛┡┩┴┳╇━─┼├┤└┘╸╺…]+", text))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two bags, and the result of the first."""
    folder = tmp_path_factory.mktemp("narrow")
    for name, seconds, later_ns in (("one", 15.0, 0), ("two", 16.0, 10**12)):
        write_bag(folder / name, [each._replace(stamp_ns=each.stamp_ns + later_ns) for each in run(seconds)])
    document = result_document(replayed(folder / "one").result)
    (folder / "result.yaml").write_text(result_text(document))
    return folder


COMMANDS = {
    "replay": ("replay", "one", "--verbose", "-p", "model:=M3"),
    "evaluate": ("evaluate", "one", "two", "--jobs", "1"),
    "apply": ("apply", "result.yaml"),
}


def said(monkeypatch, capsys, width: int, *arguments: str) -> str:
    monkeypatch.setattr(common, "_width", lambda _: width)
    assert main([*arguments]) == 0
    output = capsys.readouterr()
    assert "…" not in output.out + output.err
    return output.out + output.err


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_says_every_number_and_name_on_any_terminal(monkeypatch, capsys, folder, command):
    monkeypatch.chdir(folder)
    wide = said(monkeypatch, capsys, 300, *COMMANDS[command])
    for width in WIDTHS:
        narrow = said(monkeypatch, capsys, width, *COMMANDS[command])
        assert numbers(wide) - numbers(narrow) == Counter()
        missing = set(words(wide)) - set(words(narrow))
        of_names = {"model", "calibrated"}  # heads of columns of names, which a list has not
        assert [word for word in missing - of_names if len(word) < width] == []


def test_on_a_narrow_terminal_the_corrected_mounting_is_next_to_the_configured(monkeypatch, capsys, folder):
    monkeypatch.chdir(folder)
    lines = said(monkeypatch, capsys, 40, "replay", "one", "-p", "model:=M3").splitlines()
    (head,) = [line.split() for line in lines if "configured" in line and "corrected" in line]
    assert head == ["configured", "corrected"]


def on_a_terminal(folder: Path, columns: int, *arguments: str) -> list[str]:
    """The lines of a command on a terminal, as its user sees them, without colours and bars."""
    source, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", *arguments]
    asked = subprocess.Popen(command, cwd=folder, stdout=terminal, stderr=terminal, env={**os.environ, "TERM": "xterm"})
    os.close(terminal)
    seen = b""
    with contextlib.suppress(OSError):  # the terminal is closed with the command
        while part := os.read(source, 65536):
            seen += part
    os.close(source)
    assert asked.wait() in (0, 1)
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", seen.decode()).replace("\r\n", "\n")
    return [line.rpartition("\r")[2].rstrip() for line in plain.splitlines() if line and "━━" not in line]


def test_a_recording_too_short_to_diagnose_is_exit_code_1(monkeypatch, capsys, folder):
    monkeypatch.chdir(folder)
    assert main(["diagnose", "one"]) == 1
    assert capsys.readouterr().out.startswith("insufficient_excitation: ")


@pytest.mark.spread(1)
@pytest.mark.parametrize("command", ["replay", "doctor", "diagnose"])
def test_the_verdict_is_the_first_line_and_warnings_break_between_words(folder, command, monkeypatch, capsys):
    arguments = command, "two", "-p", "gnss_frame:=body"
    narrow = on_a_terminal(folder, 80, *arguments)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(common, "_width", lambda _: 500)
    assert main([*arguments]) in (0, 1)
    wide = capsys.readouterr()
    assert re.match(r"(accept|marginal|reject|yes|partly|no|insufficient_excitation): ", narrow[0])
    assert max(map(len, narrow)) <= 80
    assert set(words(" ".join(narrow))) == set(words(wide.out + wide.err))


def test_prose_of_apply_breaks_between_words_and_what_is_copied_stays_whole(folder):
    wide, narrow = (on_a_terminal(folder, columns, "apply", "result.yaml") for columns in (500, 80))
    assert all(len(line) <= 80 or line.startswith(("TF:", "URDF:")) for line in narrow)
    assert set(words(" ".join(narrow))) == set(words(" ".join(wide)))


VALUES = {
    "model": "full", "why": "auto: GNSS is available", "gnss": "GNSS is available", "convergence": "coarse",
    "phi_x [deg]": "0.8834", "std phi_x [deg]": "1.4004", "progress phi_x [%]": "25.0",
    "observed phi_x": "no (roll); needs turns or a figure eight", "delta_k_y [%]": "-10.1234",
    "std delta_k_y [%]": "0.5432", "progress delta_k_y [%]": "7.0", "observed delta_k_y": "yes",
    "heave [m/s]": "0.0012", "std heave [m/s]": "0.0200", "mean NIS": "2.104 of 3 (99 %: 2.829 .. 3.140)",
    "samples used": "158312", "samples gated": "24", "dvl invalid": "7",
}  # fmt: skip


def drawn(width: int) -> str:
    height = 24 if width >= 40 else 60
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None)
    console.print(View(Status(1, "the DVL dropped out 3 times", VALUES, 100.0), 100.0))
    return console.file.getvalue()


@pytest.mark.parametrize("width", [80, 71, 40, 20])
def test_the_live_view_shows_every_number_on_any_terminal(width):
    text = drawn(width)
    assert numbers(drawn(300).replace("± 1σ", "")) - numbers(text) == Counter()
    assert max(map(len, text.splitlines())) <= width


CELLS = st.one_of(
    st.floats(-1e4, 1e4).map(lambda value: f"{value:+.2f} ± {abs(value) / 7:.2f}"),
    st.integers(0, 10**6).map(str),
    st.sampled_from(["-", "", "full ◄", "[bold]M3[/]", "coarse", "turns, a box or a figure eight in calm water"]),
)


@given(data=st.data(), n_columns=st.integers(1, 9), n_rows=st.integers(0, 4), width=st.integers(20, 200))
def test_no_table_loses_a_number_at_any_width(data, n_columns, n_rows, width):
    def text_at(columns: int) -> str:
        console = Console(file=io.StringIO(), width=columns, color_system=None)
        console.print(Folding(table()))
        return console.file.getvalue()

    rows = [[data.draw(CELLS) for _ in range(n_columns)] for _ in range(n_rows)]
    justified = [data.draw(st.sampled_from(["left", "right"])) for _ in range(n_columns)]
    wrapped = [data.draw(st.booleans()) for _ in range(n_columns)]

    def table() -> Table:
        made = Table(title="3000 samples over 599.8 s", caption="± 1σ of 7 models")
        for at in range(n_columns):
            made.add_column(f"c{at}", justify=justified[at], no_wrap=wrapped[at])
        for row in rows:
            made.add_row(*row)
        return made

    narrow = text_at(width)
    assert max(map(len, narrow.splitlines()), default=0) <= width and "…" not in narrow
    heads = Counter({f"{at}": 99 for at in range(n_columns)})  # headers of columns come once per part, or per row
    assert numbers(text_at(2000)) - numbers(narrow) - heads == Counter()
