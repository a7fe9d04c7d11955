"""Every measured figure of README.md and docs/, and the pictures: made by a command, stored, rendered, checked.

A *measurement* (`registry.py`) is a function that returns values by name; they are stored in NAME.json beside this file
with the command, commit, date, load and a tolerance each. A *block* is a template (`blocks/NAME.md`, Python's format
strings over the stored values) that stands on a page between its marks; `pages.py` writes it there.
"""

from __future__ import annotations

from .command import main

__all__ = ["main"]
