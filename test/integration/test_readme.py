"""The README: files and tests that it names are there."""

from __future__ import annotations

import re

from conftest import ROOT


def test_files_that_the_readme_names_are_there_and_its_pictures_are_small():
    text = (ROOT / "README.md").read_text()
    pictures = [ROOT / name for name in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)]
    assert len(pictures) >= 3 and all(picture.stat().st_size < 150_000 for picture in pictures)
    named = re.findall(r"`((?:config|bags|test|\.ci|calibration|bags|files|messages|node|cli|effects)/[\w./]*)`", text)
    assert len(named) > 5
    roots = (ROOT, ROOT / "dvl_calib_ros")
    assert [name for name in named if not any((root / name).exists() for root in roots)] == []


def test_every_test_that_proves_a_promise_is_there():
    section = (ROOT / "README.md").read_text().partition("## What is promised")[2].partition("\n## ")[0]
    named = re.findall(r"`(test_\w+)(\.\.\.)?`", section)
    there = re.findall(
        r"^def (test_\w+)", "\n".join(path.read_text() for path in (ROOT / "test").rglob("test_*.py")), re.M
    )
    assert len(named) > 30
    assert [
        name for name, cut in named if not any(each == name or (cut and each.startswith(name)) for each in there)
    ] == []
