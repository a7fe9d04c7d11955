"""What a faulty beam does to the verdict."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.checks.beam_faults import N_EFFECTS, BeamFault, beam_warning, most_significant
from dvl_calib_ros.calibration.numerics.block_covariance import TimeBlocks
from dvl_calib_ros.verdict.kinds import Severity


@pytest.mark.parametrize(
    ("share", "off", "severities"),
    [(0.036, 0.025, []), (0.04, 0.025, [Severity.REJECT]), (0.047, 0.013, [])],
)
def test_a_significant_beam_whose_error_matters_rejects_the_calibration(share, off, severities):
    """Eight of twelve recordings with a beam that reads 6 % too much were accepted."""
    found = beam_warning(BeamFault(share, 0.01, 135.0, off), 0.01)
    assert [each.severity for each in found] == severities


def test_lasting_noise_makes_a_beam_less_significant():
    """A right survey was rejected for a beam of 21 %, as its residual lasted for a minute."""
    n, information = 20 + N_EFFECTS, 400.0

    def found(noise: float) -> BeamFault:
        blocks = TimeBlocks()
        for each in 8 * (-1.0, 1.0):
            vector = np.zeros((1, n))
            vector[0, 21] = information * (0.1 + noise * each)
            blocks.add(information * np.eye(n)[None], vector, 1.0)
        beam = most_significant(blocks, np.eye(20), np.zeros(20), np.array([1.0, 0.0, 0.0]))
        assert beam is not None
        return beam

    white, lasting = found(0.0), found(0.3)
    assert white.share == pytest.approx(0.1) and white.std == pytest.approx((16.0 * information) ** -0.5, rel=0.01)
    assert lasting.share == pytest.approx(0.1) and lasting.std > 0.3 / 4.0


def test_a_scale_that_grows_with_speed_is_no_beam():
    """A scale of 8 % per m/s was named as a beam of 41 %."""
    n = 20 + N_EFFECTS
    blocks, vector = TimeBlocks(), np.zeros((1, n))
    vector[0, 21], vector[0, -1] = 3.0, 4.0
    blocks.add(np.eye(n)[None], vector, 1.0)
    assert most_significant(blocks, np.eye(20), np.zeros(20), np.array([1.0, 0.0, 0.0])) is None
