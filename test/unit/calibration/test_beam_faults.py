"""What a faulty beam does to the verdict."""

from __future__ import annotations

import pytest

from dvl_calib_ros.calibration.checks.beam_faults import BeamFault, beam_warning
from dvl_calib_ros.verdict.kinds import Severity


@pytest.mark.parametrize(
    ("share", "off", "severities"),
    [(0.02, 0.025, []), (0.06, 0.025, [Severity.MARGINAL]), (0.047, 0.013, [])],
)
def test_a_significant_beam_whose_error_matters_is_a_doubt_about_the_calibration(share, off, severities):
    """Eight of twelve recordings with a beam that reads 6 % too much were accepted."""
    found = beam_warning(BeamFault(share, 0.01, 135.0, off))
    assert [each.severity for each in found] == severities
