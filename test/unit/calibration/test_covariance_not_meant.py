"""Variances of 1000 (m/s)² and more on all axes: invalid beside others that are measured, no claim in every message."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from io_fixtures import live, rewrite, run

import dvl_calib_ros
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.streams.screening import ALL_AXES, VERTICAL, measured_axes, screened_covariance
from dvl_calib_ros.cli.main import main

HUGE, SECONDS = 1e6, 60.0


def claiming(path: Path, variance: Callable[[int], float | None]) -> Path:
    """A run whose DVL claims these variances by the number of the message, None: the sensor's own."""
    count = 0

    def claim(topic: str, message):
        nonlocal count
        if topic == "dvl/twist":
            given, count = variance(count), count + 1
            if given is not None:
                message.twist.covariance = np.diag([given] * 6).ravel()
        return message

    return rewrite(path, claim, run(SECONDS))


def test_of_a_huge_variance_in_every_message_the_noise_is_measured(tmp_path):
    huge = dvl_calib_ros.replay(claiming(tmp_path / "huge", lambda _: HUGE))
    given = dvl_calib_ros.replay(claiming(tmp_path / "given", lambda _: None))
    counts = huge.replayed.result.counts["dvl"]
    assert counts["accepted"] == counts["received"] and not counts["invalid"]
    assert huge.replayed.result.parameters["use_message_covariance"] is False
    assert np.all(np.abs(np.subtract(huge.mounting.rpy_deg, given.mounting.rpy_deg)) < given.mounting.std_deg)


def test_without_a_reference_it_is_not_used_either(tmp_path):
    huge = dvl_calib_ros.replay(claiming(tmp_path / "huge", lambda _: HUGE), gnss_topic="none")
    assert huge.replayed.result.counts["dvl"]["accepted"] == huge.replayed.result.counts["dvl"]["received"]


def test_beside_variances_that_are_measured_it_is_invalid(tmp_path):
    mixed = dvl_calib_ros.replay(claiming(tmp_path / "mixed", lambda number: HUGE if number % 3 else None))
    counts = mixed.replayed.result.counts["dvl"]
    assert counts["accepted"] == -(-counts["received"] // 3)
    assert mixed.replayed.result.parameters["use_message_covariance"] is True


def test_what_doctor_says_is_what_replay_does(tmp_path, capsys):
    bag = claiming(tmp_path / "huge", lambda _: HUGE)
    assert main(["doctor", str(bag)]) == 0
    said = capsys.readouterr().out
    assert not said.startswith("no") and "claims 1e+03 m/s in every message, which is no information" in said


@pytest.mark.parametrize("believed", [True, False])
def test_live_and_replayed_the_same_samples_are_valid(tmp_path, believed):
    bag, parameters = claiming(tmp_path / "huge", lambda _: HUGE), Parameters(use_message_covariance=believed)
    counts = live(bag, parameters).counts["dvl"]
    assert counts["invalid"] == (counts["received"] if believed else 0)


@pytest.mark.parametrize("believed", [True, False])
@pytest.mark.parametrize("not_measured", [HUGE, -1.0])
def test_one_axis_that_is_not_measured_is_left_out_whatever_is_believed(believed, not_measured):
    found = screened_covariance(np.diag([0.01, 0.01, not_measured]), believed)
    assert found.valid and found.unmeasured == VERTICAL


def test_flags_on_all_axes_are_no_claim_of_a_variance():
    assert screened_covariance(np.diag([-1.0] * 3), False).unmeasured == ALL_AXES
    assert screened_covariance(np.diag([np.inf] * 3), False).valid is False


def test_messages_that_measure_nothing_say_nothing_of_an_axis():
    velocity, horizontal = np.ones((5, 3)), np.array([ALL_AXES] * 3 + [VERTICAL] * 2, dtype=np.uint8)
    assert measured_axes(velocity, horizontal, "auto") == (True, True, True)
    assert measured_axes(velocity, np.full(5, VERTICAL, dtype=np.uint8), "auto") == (True, True, False)
