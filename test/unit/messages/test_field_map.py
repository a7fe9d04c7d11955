"""DVL messages of unlisted types are read by a map of fields, and a map that does not fit is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from io_fixtures import JAZZY, estimates, replayed, run, write_bag
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.numerics.samples import DvlSample
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.messages.field_map import forget_mapped
from dvl_calib_ros.node.message_types import velocity_class

HEAD = "std_msgs/Header header\n"
DIRECTIONS = np.array([(0.5, 0.0, -0.87), (-0.5, 0.0, -0.87), (0.0, 0.5, -0.87), (0.0, -0.5, -0.87)])
VECTOR, BEAM = JAZZY.types["geometry_msgs/msg/Vector3"], "team_msgs/msg/Beam"
# definition, map, and the fields of a message beside its header
Fields = Callable[[Any, Any], dict[str, Any]]
TYPES: dict[str, tuple[str, str, Fields]] = {
    "vector": (
        "geometry_msgs/Vector3 vel\nfloat64[9] cov\nbool lock\n",
        "velocity=vel,variance=cov,valid=lock",
        lambda sample, _: {"vel": VECTOR(*sample.velocity), "cov": sample.covariance.ravel(), "lock": True},
    ),
    "numbers": (
        "float64 u\nfloat64 v\nfloat64 w\nfloat64[9] cov\n",
        "velocity=u,v,w,variance=cov",
        lambda sample, _: {**dict(zip("uvw", sample.velocity, strict=True)), "cov": sample.covariance.ravel()},
    ),
    "array": (
        "float64[] velocities\nfloat64[9] cov\n",
        "velocity=velocities,variance=cov",
        lambda sample, _: {"velocities": np.array(sample.velocity), "cov": sample.covariance.ravel()},
    ),
    "beams": (
        "Beam[] beams\nfloat64[9] cov\n",
        "beams=beams,direction,velocity,variance=cov",
        lambda sample, store: {
            "beams": [store.types[BEAM](VECTOR(*row), float(row @ sample.velocity)) for row in DIRECTIONS],
            "cov": sample.covariance.ravel(),
        },
    ),
}


@pytest.fixture
def restored_types():
    yield
    forget_mapped("")


def write_team_bag(path: Path, kind: str, change: Callable[[int, Any], None] = lambda *_: None) -> Path:
    """The messages of a run, those of the DVL in a type of a team's own. change: by number and message."""
    definition, _, fields = TYPES[kind]
    store, name = get_typestore(Stores.ROS2_JAZZY), f"team_msgs/msg/{kind.title()}"
    store.register(get_types_from_msg("geometry_msgs/Vector3 direction\nfloat64 velocity\n", BEAM))
    store.register(get_types_from_msg(HEAD + definition, name))
    source = write_bag(path.with_name(f"{path.name}_listed"), run(30.0))
    samples = iter([sample for sample in run(30.0) if isinstance(sample, DvlSample)])
    connections: dict[str, Any] = {}
    n_dvl = 0
    with BagReader([source]) as bag, Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, log_ns, message, _ in bag.messages(bag.topics):
            msgtype = message.__msgtype__
            if topic == "dvl/twist":
                header = store.types["std_msgs/msg/Header"](message.header.stamp, message.header.frame_id)
                message, msgtype = store.types[name](header, **fields(next(samples), store)), name
                change(n_dvl, message)
                n_dvl += 1
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(connections[topic], log_ns, store.serialize_cdr(message, msgtype))
    return path


@pytest.mark.spread(2)
@pytest.mark.parametrize("kind", TYPES)
def test_the_answer_is_that_of_a_listed_type(tmp_path, kind):
    bag = write_team_bag(tmp_path / "bag", kind)
    found, expected = estimates(bag, dvl_fields=TYPES[kind][1]), estimates(tmp_path / "bag_listed")
    assert found.keys() == expected.keys()
    for name, numbers in expected.items():
        np.testing.assert_allclose(found[name], numbers, rtol=1e-9, atol=1e-12)


def test_what_is_not_valid_is_not_used(tmp_path):
    def lose(number: int, message: Any) -> None:
        message.lock = number % 4 != 0

    bag = write_team_bag(tmp_path / "bag", "vector", lose)
    counts = replayed(bag, dvl_fields=TYPES["vector"][1]).result.counts["dvl"]
    assert counts["flagged_invalid"] == -(-counts["received"] // 4)


def test_fewer_than_three_beams_are_no_velocity(tmp_path):
    def lose(number: int, message: Any) -> None:
        if number % 2:
            del message.beams[2:]

    bag = write_team_bag(tmp_path / "bag", "beams", lose)
    counts = replayed(bag, dvl_fields=TYPES["beams"][1]).result.counts["dvl"]
    assert counts["flagged_invalid"] == counts["received"] // 2


WRONG = {
    "velocity=vel.x,vel.y,vel.q": ["no field 'vel.q'", "vel.x, vel.y, vel.z, cov, lock"],
    "velocity=vel,valid=lok": ["no field 'lok'", "lock"],
    "velocity=lock": ["'lock'", "not a vector"],
    "velocity=vel.x,vel.y": ["velocity names 2 fields, expected 1 or 3"],
    "speed=vel": ["'speed=vel'", "velocity, beams, valid"],
    "valid=lock": ["either velocity or beams"],
    "beams=vel,direction,velocity": ["'vel'", "not a list of beams"],
}


@pytest.mark.parametrize("text", WRONG)
def test_a_map_that_does_not_fit_is_named_with_the_fields_there_are(tmp_path, capsys, text):
    bag = write_team_bag(tmp_path / "bag", "vector")
    assert main(["replay", str(bag), "--dvl-fields", text]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "dvl_fields: " in said
    assert all(expected in said for expected in WRONG[text])


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("vector", "velocity=vel,valid=lock"),
        ("array", "velocity=velocities"),
        ("beams", "beams=beams,direction,velocity"),
    ],
)
def test_the_map_that_an_error_suggests_reads_the_bag(tmp_path, capsys, kind, expected):
    bag = write_team_bag(tmp_path / "bag", kind)
    assert main(["doctor", str(bag)]) == 2
    assert f"or read dvl/twist with --dvl-fields {expected}. " in capsys.readouterr().err
    assert main(["doctor", str(bag), "--dvl-fields", expected]) == 0


def test_the_map_reads_live_messages(restored_types):
    messages = pytest.importorskip("geometry_msgs.msg")
    name, text = "geometry_msgs/AccelStamped", "velocity=accel.linear,frame=header.frame_id"
    assert velocity_class("dvl_type", name, text) is messages.AccelStamped
    parameters = load_parameters(None, [f"dvl_type:={name}", f"dvl_fields:={text}"])
    decoder = MessageDecoder(parameters)
    message = messages.AccelStamped()
    message.header.frame_id, message.accel.linear.x = "dvl_link", 1.5
    sample = decoder.dvl(decoder.adapted["dvl/twist"](message), 7)
    assert sample.velocity == (1.5, 0.0, 0.0) and sample.stamp_ns == 7 and sample.covariance is None
    with pytest.raises(InputError, match="dvl_fields: 'velocity=linear' does not fit geometry_msgs/msg/AccelStamped"):
        velocity_class("dvl_type", name, "velocity=linear")
