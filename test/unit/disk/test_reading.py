"""What is read whole is a file of the size of its kind; nothing else is waited for, or read to find out."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path

import pytest
from command_line import fail
from io_fixtures import run, write_bag

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.disk.text_files import LARGEST_FILE, read_file
from dvl_calib_ros.errors import InputError

# Every option and argument that takes a file which is read whole
USES = [
    ["replay", "bag", "--params", "FILE"], ["replay", "bag", "-p", "initial_calibration:=FILE"],
    ["apply", "FILE"], ["apply", "FILE", "--launch", "out"], ["compare", "FILE", "bag"],
    ["export", "gazebo", "FILE", "-o", "out"], ["simulate", "out", "--diagnosis", "FILE"],
    ["import", "FILE", "-o", "out"], ["import", "T.csv", "--gnss", "FILE", "-o", "out"],
    ["apply", "good.yaml", "--params", "FILE", "--force"], ["apply", "good.yaml", "--urdf", "FILE", "-o", "out"],
]  # fmt: skip


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reading")
    bag = write_bag(folder / "bag", run(10.0))
    assert main(["replay", str(bag), "-p", "model:=M3", "--save", str(folder / "good.yaml")]) == 0
    (folder / "T.csv").write_text("0,1.5,0,0\n")
    return folder


@pytest.fixture
def folder(original, tmp_path, monkeypatch) -> Path:
    shutil.copytree(original, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def pipe() -> None:
    os.mkfifo("odd")


def socket_file() -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("odd")


def device() -> None:
    os.symlink("/dev/zero", "odd")


def a_folder() -> None:
    os.mkdir("odd")


def large() -> None:
    with open("odd", "wb") as file:
        file.truncate(1 << 40)


@pytest.mark.parametrize("make", [pipe, socket_file, device, a_folder, large])
@pytest.mark.parametrize("words", USES, ids=" ".join)
def test_what_is_no_file_or_too_large_is_refused_by_every_command_at_once(folder, capsys, words, make):
    if make is large and words[0] == "import":
        pytest.skip("a log of an instrument may be large")
    make()
    capsys.readouterr()
    expected = "no recordings in it" if make is a_folder and words[:2] == ["import", "FILE"] else "odd"
    assert expected in fail(capsys, *("odd" if word == "FILE" else word.replace("FILE", "odd") for word in words))
    assert not os.path.lexists("out")


def test_a_bag_whose_metadata_is_a_pipe_is_read_without_it(folder):
    (folder / "bag" / "metadata.yaml").unlink()
    os.mkfifo(folder / "bag" / "metadata.yaml")
    with BagReader([folder / "bag"]) as reader:
        assert sum(reader.message_counts.values()) > 100
        assert "no usable metadata.yaml" in " ".join(reader.notes)


def test_the_largest_file_is_read_and_one_byte_more_is_refused(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(LARGEST_FILE))
    assert len(read_file(path, "text")) == LARGEST_FILE
    path.write_bytes(bytes(LARGEST_FILE + 1))
    with pytest.raises(InputError, match="too large for a text, which has 4 MB at most"):
        read_file(path, "text")


@pytest.mark.parametrize("name", ["missing", "missing/x", "a\0b", "x" * 300])
def test_a_name_of_nothing_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"no such text|cannot be read as text"):
        read_file(tmp_path / name, "text")
