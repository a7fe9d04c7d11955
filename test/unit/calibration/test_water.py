"""The speed of sound in water, and what a scale is said to come from."""

from __future__ import annotations

import json
import math
import re

import pytest

from dvl_calib_ros.calibration.checks.speed_of_sound import (
    Water,
    cause,
    cause_of_setting,
    speed_of_sound,
    water_document,
    water_of_document,
)

SEA = {"temperature": 12.1, "salinity": 35.0}


def mackenzie(t: float, s: float, z: float) -> float:
    """Mackenzie (1981), another fit to other measurements; 25 to 40 PSU."""
    return (
        1448.96 + 4.591 * t - 5.304e-2 * t**2 + 2.374e-4 * t**3 + 1.340 * (s - 35.0) + 1.630e-2 * z + 1.675e-7 * z**2
        - 1.025e-2 * t * (s - 35.0) - 7.139e-13 * t * z**3
    )  # fmt: skip


@pytest.mark.parametrize("temperature", [2.0, 12.1, 29.0])
@pytest.mark.parametrize("salinity", [30.0, 40.0])
@pytest.mark.parametrize("depth", [0.0, 900.0])
def test_the_speed_of_sound_is_that_of_another_equation(temperature, salinity, depth):
    expected = mackenzie(temperature, salinity, depth)
    assert speed_of_sound(temperature, salinity, depth) == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize(
    ("temperature", "measured"), [(0.0, 1402.39), (10.0, 1447.27), (20.0, 1482.34), (30.0, 1509.13)]
)
def test_in_fresh_water_it_is_as_measured(temperature, measured):
    """Pure water, Del Grosso and Mader (1972)."""
    assert speed_of_sound(temperature, 0.0) == pytest.approx(measured, abs=1.0)


def test_a_salinity_that_nobody_measured_is_anything_from_fresh_to_the_saltiest():
    known, unknown = Water(**SEA).speed, Water(temperature=12.1).speed
    assert known.least < speed_of_sound(12.1, 35.0) < known.most < known.least + 9.0
    assert unknown.least < speed_of_sound(12.1, 0.0) and speed_of_sound(12.1, 40.0) < unknown.most
    assert Water(temperature=12.1, temperature_error=2.0).speed.least < unknown.least
    assert Water(temperature=50.0).speed is None and Water(temperature=4.0, depth=4000.0).speed is None


@pytest.mark.parametrize(
    ("water", "scale", "said", "not_said"),
    [
        # 0.62 % of 1506.6 m/s are 1497.3, which is that water's
        ({**SEA, "used": 1506.6}, 0.0062, "That explains the scale: set the speed of sound to 1497.3 m/s.", "if"),
        ({"temperature": 12.1, "used": 1506.6}, 0.0062, "if the salinity is 32 to 38 PSU", "other cause"),
        ({**SEA, "used": 1500.0}, 0.02, "% (2σ): the DVL used", "explains the scale"),
        ({**SEA, "used": 1500.0}, 0.02, "%; the rest has another cause", "set the speed"),
        ({**SEA, "used": 1500.0}, 0.0002, "The setting agrees with the scale that was found.", "set the speed"),
        (SEA, 0.0062, "explains the scale if the DVL was set to 150", "used"),
        ({"used": 1500.0}, 0.0062, "Set to 1490.8 m/s, it would read right.", "water"),
    ],
)  # fmt: skip
def test_a_scale_is_said_in_its_cause_and_no_more_than_is_known(water, scale, said, not_said):
    found = cause(Water(**water), scale, 0.0005)
    assert said in found.sentence and not_said not in found.sentence
    assert found.sentence.startswith(f"Scale {100.0 * scale:+.2f} ± 0.10 % (2σ)")
    assert len(f"speed of sound  {found.brief}") <= 80
    setting = re.search(r"[Ss]et (?:the speed of sound )?to ([\d.]+) m/s", found.sentence)
    assert math.isnan(found.setting) if setting is None else f"{found.setting:.1f}" == setting[1]


def test_where_the_recording_tells_nothing_nothing_is_said():
    for water in (None, Water(), Water(temperature=math.nan, salinity=35.0)):
        assert cause(water, 0.006, 0.0005) is None and cause_of_setting(water) is None
    assert cause_of_setting(Water(used=1500.0)) is None and cause_of_setting(Water(**SEA)) is None


def test_before_the_motion_shows_a_scale_the_setting_is_held_against_the_water():
    right, wrong = (cause_of_setting(Water(**SEA, used=used)) for used in (1497.0, 1530.0))
    assert right.sentence.endswith("They agree.") and math.isnan(right.setting)
    assert "makes a scale of +1." in wrong.sentence and wrong.sentence.startswith("The DVL used")
    assert wrong.setting == pytest.approx(speed_of_sound(12.1, 35.0), abs=0.1)
    assert math.isnan(cause_of_setting(Water(temperature=12.1, used=1600.0)).setting)  # a range of 50 m/s
    assert all(len(f"speed of sound  {each.brief}") <= 80 for each in (right, wrong))


def test_as_data_what_is_not_known_is_null():
    assert water_document(Water(temperature=4.0))["dvl_speed_of_sound"] is None
    written = water_document(Water(**SEA, used=1500.0))
    again = water_of_document(json.loads(json.dumps(written)))
    assert again == Water(**SEA, used=1500.0) and water_document(water_of_document(water_document(Water()))) == (
        water_document(Water())
    )
    assert written["scale_explained"] == pytest.approx(
        [1500.0 / each - 1.0 for each in written["speed_of_sound"][::-1]]
    )
