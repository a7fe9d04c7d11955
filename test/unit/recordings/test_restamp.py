"""Log times instead of stamps (restamp), where a clock is off by more than anything looks for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from driver_fixtures import A50, TWIST, Maker, write_driver_bag
from io_fixtures import estimates, run

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.messages.decode import MessageDecoder

HOUR_S, YEAR_2023_S = 3600, 1_700_000_000
SECONDS = 30.0


def write(path: Path, kind: str, ahead_s: int) -> Path:
    """A run whose DVL stamps so far ahead; messages are logged when they were measured."""

    def shift(message: Any) -> None:
        message.header.stamp.sec = max(message.header.stamp.sec + ahead_s, 1)

    return write_driver_bag(path, run(SECONDS), kind, changes=dict.fromkeys(range(1000), shift))


@pytest.mark.spread(2)
@pytest.mark.parametrize(
    ("kind", "ahead_s", "restamp"),  # read in columns, or one by one
    [
        (TWIST, HOUR_S, "log"), (A50, HOUR_S, "log"), (TWIST, -HOUR_S, "/dvl/twist"),
        (A50, -YEAR_2023_S, "dvl/twist,imu/data"),
    ],
)  # fmt: skip
def test_the_answer_is_that_of_a_clock_that_is_right(tmp_path, kind, ahead_s, restamp):
    right, wrong = estimates(write(tmp_path / "right", kind, 0)), write(tmp_path / "wrong", kind, ahead_s)
    assert estimates(wrong, restamp=restamp) == right != estimates(wrong)


def test_what_doctor_says_to_type_next_calibrates(tmp_path, capsys):
    bag = write(tmp_path / "bag", TWIST, HOUR_S)
    assert main(["doctor", str(bag)]) == 1
    said = capsys.readouterr().out
    assert said.startswith("no: ") and f"next  dvl-calib replay {bag} --restamp log --save" in said
    assert main(["replay", str(bag), "--restamp", "log"]) == 0
    assert not capsys.readouterr().out.startswith("reject")


def test_a_topic_that_is_not_there_is_named(tmp_path, capsys):
    bag = write(tmp_path / "bag", TWIST, 0)
    assert main(["replay", str(bag), "--restamp", "dvl/wist"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "restamp: no topic 'dvl/wist'" in said and "dvl/twist" in said


def test_live_the_time_of_reception_is_taken():
    sample = next(each for each in run(SECONDS) if isinstance(each, DvlSample))
    message = Maker().velocity(TWIST, sample)
    assert MessageDecoder(Parameters(restamp="log")).dvl(message, 7).stamp_ns == 7
    assert MessageDecoder(Parameters()).dvl(message, 7).stamp_ns == sample.stamp_ns
