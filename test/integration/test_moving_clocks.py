"""A clock that leaps or drifts within a recording: named alike by doctor, replay and diagnose, and never in the arm."""

from __future__ import annotations

import heapq

import pytest
from io_fixtures import rewrite

import dvl_calib_ros as dc
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

ARM, AT_S = -0.6, 170.0


def bag_of(folder, topic, drift=0.0, leap=0.0, hz=5.0):
    """Figures of eight; stamps of a topic get later. A drift takes ten minutes to show, a leap less."""
    arm = injection(f"lever_arm:x_m={ARM}")
    errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
    seconds, rates = 600.0 if drift else 400.0, {"dvl_rate": hz, "gnss_rate": hz, "imu_rate": 4.0 * hz}
    made = simulate(Scenario("figure8", seconds, 3, errors, gnss_std=0.05, effects=(arm,), **rates))
    first_ns = made.dvl[0].stamp_ns

    def change(name, message):
        if name.lstrip("/") == topic:
            stamp_ns = 10**9 * message.header.stamp.sec + message.header.stamp.nanosec
            since_s = 1e-9 * (stamp_ns - first_ns)
            stamp_ns += round(1e9 * (drift * since_s + leap * (since_s > AT_S)))
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        return message

    samples = heapq.merge(made.dvl, made.gnss, made.imu, key=lambda sample: sample.stamp_ns)
    return rewrite(folder / "bag", change, samples)


def said(command, bag, capsys):
    main([command, str(bag)])
    printed = capsys.readouterr()
    return " ".join((printed.out + printed.err).split())


@pytest.mark.slow
def test_a_reference_whose_clock_leaps_is_named_by_all_and_not_accepted(tmp_path, capsys):
    words = "the reference's clock steps ahead by 1.0"
    bag = bag_of(tmp_path, "gnss/twist", leap=1.0, hz=2.0)  # a diagnosis takes as long as there are samples
    for command in ("doctor", "diagnose"):
        assert words in said(command, bag, capsys)
    replayed = said("replay", bag, capsys)
    assert words in replayed and "reject" in replayed.lower()


@pytest.mark.slow
def test_a_dvl_whose_clock_drifts_is_named_and_calibrated_with_it_taken_off(tmp_path, capsys):
    words = "the DVL's clock drifts by"
    bag = bag_of(tmp_path, "dvl/twist", drift=1e-3)
    assert words in said("doctor", bag, capsys)
    found = dc.replay(bag, history=False)
    assert any(words in each for each in found.found) and found.verdict != "reject"
    assert found.replayed.result.estimates["full"].lever_arm((0.0, 0.0, 0.0))[0] == pytest.approx(ARM, abs=0.1)
