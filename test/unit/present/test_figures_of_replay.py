"""Figures of a replay: what they show is legible."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy
from dvl_calib_ros.present.replay_figures import _hull


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
