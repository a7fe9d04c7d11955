"""What is a recording, below folders and in object stores, and whose vehicle it is."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from dvl_calib_ros.errors import InputError
from dvl_calib_ros.fleet_catalogue.recording_entry import recordings_in, vehicle_pattern


def made(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder


def found(*places: Path | str) -> dict[str, int]:
    """Place of each recording below the first place -> how many files it has."""
    recordings, unread = recordings_in([str(place) for place in places])
    assert unread == []
    return {each.inside: len(each.files) for each in recordings}


def test_a_recording_is_what_replay_takes(tmp_path):
    place = made(
        tmp_path,
        "auv1/bag/metadata.yaml", "auv1/bag/bag_0.mcap", "auv1/bag/bag_1.mcap", "auv1/bag/deeper/x.mcap",
        "auv2/cut/cut_0.db3", "auv2/cut/cut_1.db3",
        "auv2/cut/notes.txt",
        "loose/monday.mcap", "loose/tuesday.db3", "loose/tuesday.db3-wal", "loose/packed.mcap.zstd",
        ".trash/bag.mcap", "video.mp4",
    )  # fmt: skip
    assert found(place) == {
        "auv1/bag": 3, "auv2/cut": 2, "loose/monday.mcap": 1, "loose/packed.mcap.zstd": 1, "loose/tuesday.db3": 2
    }  # fmt: skip


def test_a_place_may_be_the_recording_itself_and_each_counts_once(tmp_path):
    place = made(tmp_path, "a/bag/metadata.yaml", "a/bag/bag_0.mcap", "a/one.mcap")
    assert found(place / "a" / "bag") == {"": 2}
    assert found(place / "a" / "one.mcap") == {"one.mcap": 1}
    assert len(found(place, place / "a", f"file://{place}/a/one.mcap")) == 2


def test_links_are_followed_and_one_that_leads_back_ends(tmp_path):
    place = made(tmp_path / "place", "a/one.mcap")
    other = made(tmp_path / "other", "two.mcap")
    (place / "linked").symlink_to(other)
    (place / "a" / "back").symlink_to(place)
    assert found(place) == {"a/one.mcap": 1, "linked/two.mcap": 1}


def test_what_is_no_file_is_said_and_not_waited_for(tmp_path):
    place = made(tmp_path, "a/one.mcap")
    os.mkfifo(place / "a" / "pipe.mcap")
    (place / "a" / "gone.mcap").symlink_to("nowhere")
    recordings, unread = recordings_in([str(place)])
    assert [each.inside for each in recordings] == ["a/one.mcap"]
    assert len(unread) == 2 and "gone.mcap: No such file" in unread[0] and "pipe.mcap: is no file" in unread[1]


def test_the_vehicle_is_the_first_folder_below_the_place_or_what_a_pattern_finds(tmp_path):
    place = made(tmp_path / "dives", "auv1/2025/one.mcap", "two.mcap")
    by_folder = {each.inside: each.vehicle(None) for each in recordings_in([str(place)])[0]}
    assert by_folder == {"auv1/2025/one.mcap": "auv1", "two.mcap": "dives"}
    pattern = vehicle_pattern(r"/auv(\d)/")
    by_pattern = {each.inside: each.vehicle(pattern) for each in recordings_in([str(place)])[0]}
    assert by_pattern == {"auv1/2025/one.mcap": "1", "two.mcap": "unknown"}
    with pytest.raises(InputError, match=re.escape("--vehicle-from: '(' is no regular expression")):
        vehicle_pattern("(")


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("{}/nowhere", "no such folder"),
        ("{}", "no recording"),
        ("nostore://bucket/dives", "nostore"),
        ("memory://empty/dives", "cannot be listed|no recording"),
    ],
)
def test_a_place_that_is_none_is_said(tmp_path, place, said):
    if "://" in place:
        pytest.importorskip("fsspec")
    with pytest.raises(InputError, match=said):
        recordings_in([place.format(tmp_path)])
