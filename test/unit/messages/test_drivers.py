"""Velocities of real drivers: the same data in every message type, and no sample that its driver knows to be bad."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import searched
from documentation import section
from driver_fixtures import (
    A50,
    A50_DEFINITIONS,
    MARINE,
    ODOMETRY,
    TWIST,
    TWIST_STAMPED,
    TYPES,
    Maker,
    as_plain,
    forget_definitions,
    write_driver_bag,
)
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import estimates, mcap_bytes, raw, replayed, run, steady_run, write_bag
from rosbags.rosbag2 import StoragePlugin

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_quaternion, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.messages.drivers import DVL_TYPES, VELOCITY_TYPES, driver_table, velocity_type
from dvl_calib_ros.messages.field_map import recognised
from dvl_calib_ros.messages.live_feed import MessageFeed
from dvl_calib_ros.recordings.topics import Topics

SECOND = 10**9
MAKERS = {version: Maker(version) for version in A50_DEFINITIONS}
COVARIANCE = np.array([[0.04, 0.01, 0.02], [0.01, 0.05, 0.03], [0.02, 0.03, 0.06]])
PLAUSIBLE = DvlSample(SECOND, (1.5, 0.2, -0.1), COVARIANCE)


class Feed:
    """A feed of one type with what it has said."""

    def __init__(self, kind: str, **parameters) -> None:
        self.kind = kind
        self.calibrator = Calibrator(Parameters(dvl_type=kind, **parameters))
        self.said: list[str] = []
        self.feed = MessageFeed(self.calibrator, self.said.append)

    def take(self, message):
        return self.feed.dvl(as_plain(message), 0)

    @property
    def counts(self) -> dict[str, int]:
        return self.calibrator.counts["dvl"]


def message(kind: str, sample: DvlSample = PLAUSIBLE, frame_id: str = "dvl_link", version: str = "first"):
    return MAKERS[version].velocity(kind, sample, frame_id)


def without_covariance(samples):
    return [s._replace(covariance=None) if isinstance(s, DvlSample) else s for s in samples]


def set_velocity(message, velocity) -> None:
    linear = next(getattr(message, name) for name in ("velocity", "vector", "twist") if hasattr(message, name))
    while hasattr(linear, "twist"):
        linear = linear.twist
    linear = getattr(linear, "linear", linear)
    linear.x, linear.y, linear.z = velocity


# ---------------------------------------------------------------- the same data


@pytest.fixture(scope="module")
def bare():
    return without_covariance(run(20.0))


@pytest.fixture(scope="module")
def expected(bare, tmp_path_factory):
    return estimates(write_bag(tmp_path_factory.mktemp("expected") / "bag", bare))


@pytest.mark.spread(3)
@pytest.mark.parametrize("kind", TYPES)
def test_the_same_data_gives_the_same_estimates_in_every_type(kind, bare, expected, tmp_path):
    bag = write_driver_bag(tmp_path / "bag", bare, kind)
    assert estimates(bag) == expected
    assert replayed(bag).dvl_type == kind


@pytest.mark.spread(2)
@pytest.mark.parametrize(
    ("kind", "version"), [(ODOMETRY, "first"), (MARINE, "first"), (A50, "covariance"), (A50, "fixed sizes")]
)
def test_a_covariance_counts_the_same_in_every_type_that_has_one(kind, version, tmp_path):
    samples = [s._replace(covariance=COVARIANCE) if isinstance(s, DvlSample) else s for s in run(20.0)]
    bag = write_driver_bag(tmp_path / "bag", samples, kind, maker=MAKERS[version])
    assert estimates(bag) == estimates(write_bag(tmp_path / "standard", samples))


@pytest.mark.spread(3)
@pytest.mark.parametrize("kind", [TWIST_STAMPED, ODOMETRY])
@pytest.mark.parametrize("frame", VelocityFrame)
def test_a_reference_may_come_as_twist_or_odometry_in_any_frame(kind, frame, tmp_path):
    samples = [s._replace(covariance=None) if isinstance(s, ReferenceSample) else s for s in run(20.0, frame)]
    bag = write_driver_bag(tmp_path / "bag", samples, TWIST, kind)
    assert estimates(bag) == estimates(write_bag(tmp_path / "standard", samples))


def test_an_odometry_reference_is_in_its_child_frame_whatever_its_header_says():
    feed = Feed(TWIST, gnss_type=ODOMETRY)
    sample = ReferenceSample(SECOND, (1.0, 0.0, 0.0))
    assert feed.feed.reference(message(ODOMETRY, sample, "base_link"), 0).frame is VelocityFrame.BODY
    assert feed.feed.reference(message(ODOMETRY, sample, ""), 0) is None  # the header says odom
    assert "gnss_frame" in feed.said[0]


# ---------------------------------------------------------------- axes


def test_a_mounting_that_is_upside_down_with_data_that_are_turned_is_asked_about_once():
    feed = Feed(MARINE, mounting_rpy=(math.pi, 0.0, 0.0))
    for second in range(1, 4):
        feed.take(message(MARINE, PLAUSIBLE._replace(stamp_ns=second * SECOND)))
    assert len(feed.said) == 1 and "set dvl_axes to flu" in feed.said[0]
    for quiet in (Feed(MARINE), Feed(MARINE, mounting_rpy=(math.pi, 0.0, 0.0), dvl_axes="flu")):
        quiet.take(message(MARINE))
        assert not quiet.said


def test_a_mounting_in_the_urdf_of_the_drivers_own_frame_does_as_well_with_axes_flu(tmp_path):
    bag = write_driver_bag(tmp_path / "bag", steady_run(100), MARINE)
    turned = replayed(bag).result.estimate
    as_it_is = replayed(bag, dvl_axes="flu", mounting_rpy=(math.pi, 0.0, 0.0)).result.estimate
    flip = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(
        as_it_is.rotation_body_from_dvl(flip), turned.rotation_body_from_dvl(np.eye(3)) @ flip, atol=1e-9
    )


def test_the_transform_of_the_result_is_of_the_drivers_frame_and_the_mounting_of_what_is_calibrated(tmp_path):
    bag = write_driver_bag(tmp_path / "bag", steady_run(100), MARINE)
    options = ["-p", "model:=M3", "-p", "dvl_position:=told", "--save", str(tmp_path / "result.yaml")]
    assert main(["replay", str(bag), *options]) == 0
    mounting = load_yaml(tmp_path / "result.yaml", "result file")["mounting"]
    words = mounting["static_transform_publisher"].split()
    frame = rotation_from_quaternion([float(words[words.index(f"--{name}") + 1]) for name in ("qx", "qy", "qz", "qw")])
    calibrated = rotation_from_rpy(mounting["corrected_rpy"])
    np.testing.assert_allclose(frame, calibrated @ np.diag([1.0, -1.0, -1.0]), atol=1e-8)
    assert mounting["dvl_data_axes"] == "frd"


# ---------------------------------------------------------------- invalid data


def beams(*valid):
    return lambda m: setattr(m, "beams", [SimpleNamespace(valid=each) for each in valid])


BAD = {
    "marine flag": (MARINE, lambda m: setattr(m, "beam_velocities_valid", False), "flagged_invalid"),
    "marine two beams": (MARINE, lambda m: setattr(m, "num_good_beams", 2), "few_beams"),
    "marine water": (MARINE, lambda m: setattr(m, "velocity_mode", 2), "water_track"),
    "marine unset mode": (MARINE, lambda m: setattr(m, "velocity_mode", 0), "unknown_mode"),
    "marine altitude -1": (MARINE, lambda m: vars(m).update(altitude=-1.0, beam_ranges_valid=False), "no_bottom"),
    "marine altitude nan": (MARINE, lambda m: vars(m).update(altitude=math.nan, range=-np.ones(4)), "no_bottom"),
    "marine variance": (MARINE, lambda m: m.velocity_covar.__setitem__(4, -0.5), "invalid"),
    "a50 flag": (A50, lambda m: setattr(m, "velocity_valid", False), "flagged_invalid"),
    "a50 two beams": (A50, beams(True, False, True, False), "few_beams"),
    "a50 altitude": (A50, lambda m: setattr(m, "altitude", -1.0), "no_bottom"),
    "a50 fom": (A50, lambda m: setattr(m, "fom", 0.41), "poor_fom"),
    "a50 fom -1": (A50, lambda m: setattr(m, "fom", -1.0), "poor_fom"),
    "odometry variance": (ODOMETRY, lambda m: m.twist.covariance.__setitem__(7, -1.0), "invalid"),
}


@pytest.mark.parametrize("velocity", [(1.5, 0.2, -0.1), (0.0, 0.0, 0.0), (math.nan,) * 3])
@pytest.mark.parametrize("case", BAD)
def test_what_the_driver_says_is_invalid_is_not_used_and_counted_as_what_is_wrong(case, velocity):
    kind, spoil, counter = BAD[case]
    feed, sent = Feed(kind), message(kind)
    spoil(sent)
    set_velocity(sent, velocity)
    assert feed.feed.dvl(sent, 0) is None
    if counter == "invalid" and velocity == (0.0, 0.0, 0.0):
        counter = "zero_velocity"
    assert feed.counts[counter] == feed.counts["received"] == 1
    assert feed.counts["accepted"] == 0


@pytest.mark.parametrize("kind", [kind for kind in TYPES if kind != TWIST])
def test_a_velocity_of_exactly_zero_stands_for_none(kind):
    feed, sent = Feed(kind), message(kind)
    set_velocity(sent, (0.0, -0.0, 0.0))
    assert feed.take(sent) is None and feed.counts["zero_velocity"] == 1
    set_velocity(sent, (0.0, 1e-6, 0.0))  # a vehicle at rest
    assert feed.take(sent) is not None


@pytest.mark.parametrize("unknown", [-1.0, 0.0])
def test_a_marine_covariance_of_minus_one_or_zero_is_not_given_but_the_velocity_is(unknown):
    feed, sent = Feed(MARINE), message(MARINE)
    sent.velocity_covar = np.full(9, unknown)
    assert feed.take(sent) is not None
    assert feed.counts["accepted"] == 1


def test_without_a_covariance_the_figure_of_merit_is_the_standard_deviation_of_every_axis():
    sent = message(A50)
    sent.fom = 0.1
    np.testing.assert_allclose(Feed(A50).take(sent).covariance, 0.01 * np.eye(3), rtol=1e-12)
    sent.fom = 0.0
    assert Feed(A50).take(sent).covariance is None


def test_beams_that_a_driver_does_not_list_and_an_altitude_that_it_does_not_fill_say_nothing():
    sent = message(A50)
    sent.beams, sent.altitude = [], 0.0
    assert Feed(A50).take(sent) is not None
    sent.beams = [SimpleNamespace(valid=valid) for valid in (True, False, True, True)]
    assert Feed(A50).take(sent) is not None


@pytest.mark.parametrize("kind", [MARINE, A50])
def test_bad_samples_among_good_ones_change_nothing_but_the_counts(kind, bare, tmp_path):
    cases = [case for case in BAD.values() if case[0] == kind and case[1] and case[2] not in ("invalid", "few_beams")]
    changes = {10 * number: spoil for number, (_, spoil, _) in enumerate(cases, start=1)}
    bag = write_driver_bag(tmp_path / "bag", bare, kind, changes=changes)
    dvl = [sample for sample in bare if isinstance(sample, DvlSample)]
    bad = {dvl[number].stamp_ns for number in changes}
    clean = [sample for sample in bare if not (isinstance(sample, DvlSample) and sample.stamp_ns in bad)]
    assert estimates(bag) == estimates(write_bag(tmp_path / "clean", clean))
    counts = replayed(bag).result.counts["dvl"]
    assert counts["accepted"] == counts["received"] - len(cases) == len(dvl) - len(cases)
    for _, _, counter in cases:
        assert counts[counter] == sum(1 for case in cases if case[2] == counter)


def test_a_dvl_that_never_gives_a_valid_sample_is_an_error_that_says_what_is_wrong_with_them(tmp_path):
    changes = dict.fromkeys(range(50), lambda m: setattr(m, "beam_velocities_valid", False))
    bag = write_driver_bag(tmp_path / "bag", steady_run(50), MARINE, changes=changes)
    with pytest.raises(InputError, match=r"50 flagged_invalid.*beam_velocities_valid is false"):
        replayed(bag)


def numbers(rng: st.DataObject, value):
    """The same field with garbage of its type."""
    if isinstance(value, bool):
        return rng.draw(st.booleans())
    if isinstance(value, str):
        return rng.draw(st.sampled_from(["", "dvl_link", "base_link", "x_frd", "\x00/é"]))
    if isinstance(value, int):
        return rng.draw(st.sampled_from([0, 1, 2, 3, 255, 2**31 - 1, -(2**31)]))
    if isinstance(value, float):
        return rng.draw(st.floats(width=64))
    if isinstance(value, np.ndarray):
        size = rng.draw(st.sampled_from([0, 1, 8, 9, 36, value.size]))
        return np.array(rng.draw(st.lists(st.floats(), min_size=size, max_size=size)), dtype=value.dtype)
    if isinstance(value, list):
        return [numbers(rng, each) for each in value[: rng.draw(st.integers(0, len(value)))]]
    return SimpleNamespace(**{name: numbers(rng, each) for name, each in vars(value).items()})


@pytest.mark.parametrize("kind", TYPES)
@given(rng=st.data())
@searched(25)
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_no_garbage_in_the_fields_raises_and_every_message_is_counted(kind, rng):
    feed = Feed(kind, dvl_frame="dvl_link" if rng.draw(st.booleans()) else "")
    template = as_plain(message(kind, version="covariance"))
    for _ in range(3):
        feed.feed.dvl(numbers(rng, template), 0)
    counts = feed.counts
    lost = sum(count for name, count in counts.items() if name not in ("received", "accepted", "usable", "slow"))
    assert counts["received"] == 3 == counts["accepted"] + lost


@pytest.mark.parametrize("kind", [TWIST, TWIST_STAMPED, ODOMETRY])
@given(rng=st.data())
@searched(15)
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_no_garbage_in_a_reference_raises_either(kind, rng):
    feed = Feed(TWIST, gnss_type=kind)
    for _ in range(3):
        feed.feed.reference(numbers(rng, as_plain(message(kind, frame_id="map"))), 0)
    assert feed.calibrator.counts["reference"]["received"] == 3


@pytest.mark.parametrize("kind", TYPES)
def test_a_message_of_another_layout_than_its_types_is_counted_and_said(kind):
    feed = Feed(kind)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id="dvl_link")
    assert feed.feed.dvl(SimpleNamespace(header=header, child_frame_id="dvl_link"), 0) is None
    assert feed.counts["invalid"] == 1
    assert len(feed.said) == 1 and kind in feed.said[0]


# ---------------------------------------------------------------- bags


@pytest.mark.parametrize(("kind", "version"), [(MARINE, "first"), *((A50, version) for version in A50_DEFINITIONS)])
def test_an_sqlite_bag_without_definitions_is_read_by_the_known_ones_and_that_is_said(
    kind, version, bare, expected, tmp_path
):
    bag = write_driver_bag(tmp_path / "bag", bare, kind, maker=MAKERS[version], storage=StoragePlugin.SQLITE3)
    replay = replayed(forget_definitions(bag))
    for name, estimate in replay.result.estimates.items():
        assert [*estimate.state, *np.ravel(estimate.covariance)] == expected[name]
    assert any(kind in note and "ros2 bag convert" in note for note in replay.notes)


def test_a_bag_without_the_default_topic_suggests_the_one_of_a_dvl_and_lists_all(tmp_path):
    bag = write_driver_bag(tmp_path / "bag", steady_run(20), A50, dvl_topic="/sensors/velocity")
    with pytest.raises(InputError) as error:
        replayed(bag)
    assert "set --dvl-topic /sensors/velocity" in str(error.value)
    assert "The bag has: /sensors/velocity (dvl_msgs/msg/DVL), gnss/twist (geo" in str(error.value)
    assert replay([bag], Parameters(), Topics(dvl="/sensors/velocity")).result.counts["dvl"]["accepted"] == 20


def test_where_no_type_is_a_dvls_alone_the_name_suggests_the_topic(tmp_path):
    bag = write_driver_bag(tmp_path / "bag", steady_run(20), ODOMETRY, ODOMETRY, dvl_topic="/DVL/odom")
    with pytest.raises(InputError, match=r"set --dvl-topic /DVL/odom\. The bag"):
        replayed(bag)


def test_a_topic_of_a_type_that_holds_no_velocity_is_refused_with_those_that_do(tmp_path):
    bag = write_driver_bag(tmp_path / "bag", run()[:200], MARINE)
    with pytest.raises(InputError, match=r"imu/data holds sensor_msgs/msg/Imu, expected .*dvl_msgs/msg/DVL"):
        replay([bag], Parameters(), Topics(dvl="imu/data", imu="none"))
    with pytest.raises(
        InputError, match=r"holds marine_acoustic_msgs/msg/Dvl, expected .*Odometry or .*NavSatFix; set --gnss-topic"
    ):
        replay([bag], Parameters(), Topics(dvl="gnss/twist", gnss="dvl/twist"))


def test_bags_of_two_types_on_one_topic_are_not_mixed(tmp_path):
    bags = [write_driver_bag(tmp_path / kind[:5], steady_run(20), kind) for kind in (MARINE, A50)]
    with pytest.raises(InputError, match="dvl/twist holds dvl_msgs/msg/DVL and marine_acoustic_msgs/msg/Dvl; replay"):
        replayed(*bags)


def test_stamps_that_never_meet_the_references_are_explained(tmp_path):
    samples = [s._replace(stamp_ns=s.stamp_ns - 10**17) if isinstance(s, DvlSample) else s for s in steady_run(50)]
    bag = write_driver_bag(tmp_path / "bag", sorted(samples, key=lambda s: s.stamp_ns), MARINE)
    assert any("synchronised (NTP)" in note for note in replayed(bag).notes)
    assert not any("NTP" in note for note in replayed(write_bag(tmp_path / "good", steady_run(50))).notes)


def test_the_replay_says_what_the_dvls_data_are_in_the_terminal_and_in_json(tmp_path, capsys):
    changes = {5: lambda m: setattr(m, "num_good_beams", 1)}
    bag = write_driver_bag(tmp_path / "bag", steady_run(50), MARINE, changes=changes)
    assert main(["replay", str(bag), "-v", "-p", "model:=M3", "--json", str(tmp_path / "out.json")]) == 0
    said = "marine_acoustic_msgs/msg/Dvl, converted from forward-right-down to forward-left-up"
    shown = capsys.readouterr().out
    assert said in shown and "1 few beams" in shown
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["dvl"] == {"type": MARINE, "turned_from_frd": True}
    assert document["parameters"]["dvl_type"] == MARINE  # what the node needs to go on with the result
    assert document["counts"]["dvl"]["few_beams"] == 1


# ---------------------------------------------------------------- the registry


def test_a_driver_is_added_by_one_entry(monkeypatch, bare, expected, tmp_path):
    vendor = "vendor_msgs/msg/Log"
    for types in (VELOCITY_TYPES, DVL_TYPES):  # both are of the one entry
        monkeypatch.setitem(types, vendor, replace(VELOCITY_TYPES[A50], name=vendor))
    bag = write_driver_bag(tmp_path / "bag", bare, A50)
    (tmp_path / "vendor.mcap").write_bytes(vendor_mcap(bag, vendor))
    assert estimates(tmp_path / "vendor.mcap") == expected


def vendor_mcap(bag, vendor: str) -> bytes:
    """The same messages, the DVL's under a type of another name."""
    definitions = {"dvl/twist": (vendor, MAKERS["first"].store.generate_msgdef(A50, ros_version=2)[0])}
    return mcap_bytes(raw(bag), definitions=definitions)


@pytest.mark.parametrize("package", ["waterlinked_a50_ros_driver", "dvl_a50_msgs"])
def test_a_drivers_message_is_recognised_by_its_fields_whatever_its_package_is(package, bare, expected, tmp_path):
    bag, name = write_driver_bag(tmp_path / "bag", bare, A50), f"{package}/msg/DVL"
    (tmp_path / "fork.mcap").write_bytes(vendor_mcap(bag, name))
    assert estimates(tmp_path / "fork.mcap") == expected
    assert velocity_type("dvl_type", f"{package}/DVL").points_down


def test_a_dvls_fields_decide_how_a_message_is_read_and_others_are_none():
    girona = ("header", "velocity", "velocity_covariance", "altitude", "beams")
    assert not recognised("dave_interfaces/msg/DVL", girona).points_down
    assert recognised("new_msgs/msg/Twist", ("header", "velocity", "altitude")) is None
    assert "new_msgs/msg/Twist" not in VELOCITY_TYPES


def test_a_saved_result_of_a_recognised_type_is_read_where_nobody_has_seen_its_fields(tmp_path):
    (tmp_path / "p.yaml").write_text("/**:\n  ros__parameters:\n    dvl_type: unseen_msgs/msg/DVL\n")
    assert load_parameters(tmp_path / "p.yaml").dvl_type == "unseen_msgs/msg/DVL"


@pytest.mark.parametrize(
    ("ranges", "valid", "used"), [(20.0, True, 1), (20.0, False, 0), (-1.0, True, 0), (math.nan, True, 0)]
)
def test_gazebos_bridge_never_fills_the_altitude_and_is_read_by_its_beams(ranges, valid, used):
    feed, given = Feed(MARINE), message(MARINE)
    given.altitude, given.range, given.beam_ranges_valid = -1.0, np.full(4, ranges), valid
    feed.take(given)
    assert (feed.counts["accepted"], feed.counts.get("no_bottom", 0)) == (used, 1 - used)


def test_the_readme_lists_the_drivers_of_the_registry():
    assert section("drivers") == driver_table().strip(), "take it from: dvl-calib parameters --drivers"


def test_every_rule_has_a_counter_of_its_own_within_its_type():
    for kind in VELOCITY_TYPES.values():
        counters = [rule.counter for rule in kind.rules]
        assert len(set(counters)) == len(counters)
        assert not set(counters) & set(Calibrator(Parameters()).counts["dvl"])


def test_the_type_is_known_with_and_without_msg_in_its_name():
    for name in ("dvl_msgs/DVL", "dvl_msgs/msg/DVL"):
        assert velocity_type("dvl_type", name).name == A50
    for name in ("", "DVL", "dvl_msgs", "dvl_msgs/msg/Other", "a/b/c"):
        with pytest.raises(InputError, match=r"dvl_type: .* is none of geometry_msgs"):
            velocity_type("dvl_type", name)
