"""Properties that hold for whatever comes, and a glance at what test/fuzz goes through at length."""

from __future__ import annotations

import contextlib
import io
import math
import random
import sys

import numpy as np
import pytest
from conftest import ROOT, searched
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import JAZZY

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import SCHEMA, ParameterError, Parameters
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.messages.drivers import IMU_TYPE, TWIST_TYPE
from dvl_calib_ros.messages.live_feed import MessageFeed

sys.path.insert(0, str(ROOT / "test" / "fuzz"))
from targets import TARGETS

TYPES = JAZZY.types
NUMBERS = st.floats() | st.sampled_from([0.0, -0.0, 1.5, -1.0, 5e-324, math.inf, math.nan])
STAMPS = st.tuples(
    st.integers(-(2**31), 2**31 - 1) | st.integers(1_700_000_000, 1_700_000_020), st.integers(0, 2**32 - 1)
)
TEXTS = st.text(max_size=20) | st.sampled_from(["[1, 2, 3]", "1e400", "{a: 1}", ".nan"])
ARGUMENTS = st.text(max_size=8) | st.sampled_from(["-p", "--params", "--models", "--json", "-o"])
FRAMES = st.sampled_from(["dvl_link", "base_link", "map", "ned", "", "\x00", "é/"]) | st.text(max_size=5)


@pytest.fixture(autouse=True, scope="module")
def no_node_is_left():
    """Neither its participant nor its domain are there for other tests of this process."""
    yield
    if "live" in TARGETS:
        sys.modules["live"].end()


@st.composite
def messages(draw):
    """A message of any stream with any content, as rosbags decodes it."""
    header = TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](*draw(STAMPS)), draw(FRAMES))
    vector = [TYPES["geometry_msgs/msg/Vector3"](*draw(st.tuples(NUMBERS, NUMBERS, NUMBERS))) for _ in range(2)]
    covariance = np.full(36, draw(NUMBERS))
    covariance[draw(st.integers(0, 35))] = draw(NUMBERS)
    if draw(st.booleans()):
        quaternion = TYPES["geometry_msgs/msg/Quaternion"](*draw(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS)))
        nine = covariance[:9]
        return "imu", TYPES[IMU_TYPE](header, quaternion, nine, vector[0], nine, vector[1], nine)
    twist = TYPES["geometry_msgs/msg/Twist"](*vector)
    inner = TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, covariance)
    return draw(st.sampled_from(["dvl", "reference"])), TYPES[TWIST_TYPE](header, inner)


@searched(25)
@given(st.lists(messages(), max_size=30))
def test_whatever_messages_come_every_one_is_counted_and_the_estimates_stay_finite(given_messages):
    calibrator = Calibrator(Parameters(gnss_frame="enu"))
    feed = MessageFeed(calibrator, lambda _: None)
    take = {"dvl": feed.dvl, "reference": feed.reference, "imu": feed.imu}
    for stream, message in given_messages:
        take[stream](message, 1)
    for stream in take:
        assert calibrator.counts[stream]["received"] == sum(name == stream for name, _ in given_messages)
    for estimate in calibrator.result().estimates.values():
        assert np.isfinite(estimate.state).all() and np.isfinite(estimate.covariance).all()


@searched(100)
@given(st.sampled_from(sorted(SCHEMA)), TEXTS)
def test_whatever_a_parameter_is_set_to_it_is_taken_or_refused_with_its_name(name, text):
    try:
        load_parameters(None, [f"{name}:={text}"])
    except (InputError, ParameterError) as error:
        assert name in str(error)


@searched(30)
@given(st.sampled_from(["replay", "salvage", "parameters", "import", "evaluate"]), st.lists(ARGUMENTS, max_size=5))
def test_whatever_is_typed_ends_with_success_or_one_line_and_exit_code_2(tmp_path_factory, command, arguments):
    # nothing that could start real work or write: the file that is read does not exist
    missing = str(tmp_path_factory.getbasetemp() / "missing")
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main([command, missing, *(argument.replace("/", "") for argument in arguments)])
        except SystemExit as stop:
            code = stop.code
    assert code in (0, 2)
    assert code == 0 or errors.getvalue().count("\n") == 1


@pytest.mark.spread(8)
@pytest.mark.parametrize("name", TARGETS)
def test_a_fuzz_target_takes_its_seeds_what_was_found_and_some_damage(name):
    target = TARGETS[name]
    source = random.Random(5)
    seeds = list(target.seeds())
    found = [path.read_bytes() for path in sorted((ROOT / "test" / "fuzz" / "found" / name).glob("*"))]
    for content in (*seeds, *found):
        target.run(content)
    for _ in range(target.damaged):
        content = bytearray(source.choice(seeds))
        for _ in range(source.randint(1, 4)):
            content[source.randrange(len(content))] = source.randrange(256)
        target.run(bytes(content[: source.randint(1, len(content))]))
