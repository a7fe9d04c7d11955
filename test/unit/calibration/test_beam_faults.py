"""What a faulty beam does to the verdict."""

from __future__ import annotations

import pytest

from dvl_calib_ros.calibration.checks.beam_faults import BeamFault, beam_warning
from dvl_calib_ros.verdict.kinds import Severity


@pytest.mark.parametrize(("share", "severities"), [(0.02, []), (0.06, [Severity.MARGINAL])])
def test_a_significant_beam_is_a_doubt_about_the_calibration(share, severities):
    """Eight of twelve recordings with a beam that reads 6 % too much were accepted."""
    found = beam_warning(BeamFault(share, 0.01, 135.0, 0.025))
    assert [each.severity for each in found] == severities
