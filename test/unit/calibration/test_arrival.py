"""One rule for which clock is off by when messages arrived: of doctor, replay, discovery and the node."""

from __future__ import annotations

import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import Stream
from dvl_calib_ros.calibration.registration.clock_domains import arrival_offset, limit_s

DVL, REFERENCE, IMU = Stream.DVL, Stream.REFERENCE, Stream.IMU
P = Parameters()


@pytest.mark.parametrize(
    ("ahead", "found"),
    [
        ({DVL: 0.0, REFERENCE: 18.0, IMU: 0.1}, [(REFERENCE, 18.0)]),
        ({DVL: -7.0, REFERENCE: 0.0, IMU: 0.1}, [(DVL, -7.0)]),
        ({DVL: 0.0, REFERENCE: 18.0, IMU: 18.1}, [(DVL, -18.0)]),
        ({DVL: 0.0, REFERENCE: -37.0}, [(REFERENCE, -37.0)]),
        ({DVL: 0.0, REFERENCE: 30.0, IMU: -30.0}, [(REFERENCE, 30.0), (IMU, -30.0)]),
        ({DVL: 0.0, REFERENCE: 4.0, IMU: -4.0}, []),
        ({DVL: 5.0}, []),
    ],
)
def test_the_stream_that_is_alone_is_named(ahead, found):
    assert [(each.stream, pytest.approx(each.ahead)) for each in arrival_offset(ahead, P)] == found


def test_what_the_parameters_take_off_is_no_fault_and_neither_is_late_arrival():
    told = P.replace(reference_time_offset=18.0)
    assert arrival_offset({DVL: 0.0, REFERENCE: 18.0}, told) == []
    assert arrival_offset({DVL: 0.0, REFERENCE: 0.0}, told) == []
    assert [each.ahead for each in arrival_offset({DVL: 0.0, REFERENCE: -18.0}, told)] == [-36.0]


def test_what_is_not_known_so_well_is_said_later():
    beyond = limit_s(P) + 3.0
    assert arrival_offset({DVL: 0.0, IMU: beyond}, P) and not arrival_offset({DVL: 0.0, IMU: beyond}, P, 5.0)
