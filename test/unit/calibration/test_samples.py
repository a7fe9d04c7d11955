"""Columns of samples: the same rows as live, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.numerics.samples import (
    Covariances,
    DvlSample,
    ImuSample,
    ReferenceSample,
    Stream,
    Streams,
    VelocityFrame,
    sample_block,
)


def test_rows_come_out_as_live_samples_in_their_order_of_arrival():
    dvl = sample_block(Stream.DVL, np.array([5, 9]), [[1, 2, 3], [4, 5, 6]], covariance=np.eye(3))
    reference = sample_block(Stream.REFERENCE, np.array([5]), [[7, 8, 9]], frames=VelocityFrame.NED)
    imu = sample_block(Stream.IMU, np.array([1, 6]), [[0, 0, 0, 1, *[np.nan] * 3], [*[np.nan] * 4, 1, 2, 3]])
    rows = [row for _, row in Streams(dvl, reference, imu).arriving_by_stamp().in_order()]
    assert rows[0] == ImuSample(1, (0, 0, 0, 1), None)
    assert rows[1] == ReferenceSample(5, (7, 8, 9), None, VelocityFrame.NED)
    assert isinstance(rows[2], DvlSample) and rows[2].velocity == (1, 2, 3)
    assert rows[3] == ImuSample(6, None, (1, 2, 3))
    assert rows[4].covariance is not None and rows[2].covariance is rows[4].covariance


def test_a_message_that_is_no_sample_is_a_row_with_its_reason():
    refused = np.array([0, 2], dtype=np.uint8)
    block = sample_block(
        Stream.DVL, np.array([5, 0]), np.ones((2, 3)), refused=refused, reasons=("wrong_frame", "no_bottom")
    )
    other = sample_block(Stream.DVL, np.array([9]), np.ones((1, 3)), refused=refused[1:] - 1, reasons=("flagged",))
    assert list(block.joined(other).samples()) == [DvlSample(5, (1, 1, 1)), "no_bottom", "flagged"]
    three = block.joined(other, block)
    assert list(three.samples()) == [*block.joined(other).samples(), *block.samples()] and len(three.reasons) == 3


def test_a_covariance_that_repeats_is_kept_once_and_given_back_in_every_row():
    values = np.array([1.0, 1.0, 2.0, np.nan, np.nan])[:, None, None] * np.eye(3)
    found = Covariances.of(values, 5)
    assert len(found.distinct) == 3
    np.testing.assert_array_equal(found.distinct[found.index], values)
    both = Covariances.none(1).joined(found)
    assert both.index.tolist() == [-1, 0, 0, 1, 2, 2]
    three = found.joined(Covariances.none(1), found)
    np.testing.assert_array_equal(three.distinct[three.index], np.concatenate([values, values[-1:], values]))
    assert three.index.tolist() == [0, 0, 1, 2, 2, -1, 3, 3, 4, 5, 5]


def test_columns_that_do_not_fit_together_are_refused():
    with pytest.raises(ValueError, match="covariance: expected"):
        sample_block(Stream.DVL, np.arange(3), np.ones((3, 3)), covariance=np.eye(2))
    with pytest.raises(ValueError, match="arrival has shape"):
        sample_block(Stream.DVL, np.arange(3), np.ones((3, 3)), arrival=np.arange(2))
