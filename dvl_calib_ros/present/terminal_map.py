"""A map of a track for the terminal: two by four dots in each character (Braille), a colour for each track."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..calibration.assessment.dead_reckoning import Navigation

if TYPE_CHECKING:
    from rich.text import Text

    from ..calibration.numerics.frames import Array
    from ..calibration.numerics.samples import Index

# Of the first character of Unicode's Braille, and the bits of its dots by row and column
_BLANK = 0x2800
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
WIDEST, HIGHEST = 56, 14
_INDENT = "  "


def terminal_map(navigation: Navigation, width: int) -> Text:
    """The reference, the DVL's track as mounted and the corrected one, north up; the later lies on top."""
    from rich.text import Text

    tracks = (
        (navigation.reference, "bright_black", "reference"),
        (navigation.track_before, "red", "as mounted"),
        (navigation.track_after, "blue", "corrected"),
    )
    every = np.concatenate([track for track, _, _ in tracks])
    low, high = every.min(axis=0), every.max(axis=0)
    columns = max(min(WIDEST, width - 2 * len(_INDENT)), 8)
    # metres per dot, the same along both axes
    scale = max(float((high - low)[0]) / (2 * columns - 1), float((high - low)[1]) / (4 * HIGHEST - 1), 1e-9)
    n_columns = int((high - low)[0] / scale) // 2 + 1
    n_rows = int((high - low)[1] / scale) // 4 + 1
    dots, colours = np.zeros((n_rows, n_columns), dtype=int), np.full((n_rows, n_columns), "", dtype=object)
    for track, colour, _ in tracks:
        x, y = _drawn(track, low, scale)
        y = 4 * n_rows - 1 - y
        np.bitwise_or.at(dots, (y // 4, x // 2), _DOTS[y % 4, x % 2])
        colours[y // 4, x // 2] = colour
    text = Text()
    for row, shade in zip(dots, colours, strict=True):
        text.append(_INDENT)
        for dot, colour in zip(row, shade, strict=True):
            text.append(chr(_BLANK + dot) if dot else " ", style=colour or None)
        text.append("\n")
    text.append(_INDENT)
    for _, colour, name in tracks:
        text.append("━ ", style=colour)
        text.append(f"{name}  ")
    text.append(f"(north up, {scale * 2 * n_columns:.0f} m across)\n")
    return text


def _drawn(track: Array, low: Array, scale: float) -> tuple[Index, Index]:
    """Dots (K,) east and north of a track whose points are joined."""
    place = (track - low) / scale
    steps = np.abs(np.diff(place, axis=0)).max(axis=1, initial=0.0)
    count = np.maximum(np.ceil(steps).astype(int), 1)
    first = np.repeat(np.arange(len(count)), count)
    part = (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)) / np.repeat(count, count)
    joined = place[:-1][first] + part[:, None] * np.diff(place, axis=0)[first]
    x, y = np.concatenate([joined, place[-1:]]).astype(np.intp).T
    return x, y
