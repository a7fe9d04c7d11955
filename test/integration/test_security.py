"""What comes from outside (bags, files, the network) can neither execute nor write where the operator did not say."""

from __future__ import annotations

import os
import re
import shlex
import xml.etree.ElementTree as ElementTree
from contextlib import suppress

import pytest
from conftest import ROOT, searched
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import JAZZY, raw, rewrite, run, write_bag
from mcap.writer import CompressionType, Writer
from report_fixtures import drawn
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.serde import SerdeError

from dvl_calib_ros.bags.channels import Definition, DefinitionError, typestore
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.cli.main import main
from dvl_calib_ros.disk.atomic import check_writable, save_text
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.errors import InputError, printable
from dvl_calib_ros.files.result_file import check_in_folder
from dvl_calib_ros.messages.drivers import TWIST_TYPE

MSG, IDL = MessageDefinitionFormat.MSG, MessageDefinitionFormat.IDL


# ---------------------------------------------------------------------- the package itself


@pytest.mark.parametrize("command", ["parameters", "result"])
def test_aliases_that_multiply_are_refused_in_a_short_line(tmp_path, capsys, command):
    """A billion laughs: nine levels of nine references each."""
    laughs = "a0: &a0 [lol]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10))
    path = tmp_path / "laughs.yaml"
    bag = write_bag(tmp_path / "bag", run(6.0))
    if command == "parameters":
        path.write_text(laughs + "/**:\n  ros__parameters: {model: *a9}\n")
        arguments = ["--params", str(path)]
    else:
        text = "format: dvl_calib_ros result 1\nmodels: {M5: {state: [0], covariance: [[1]], state_names: *a9}}\n"
        path.write_text(laughs + text + "parameters: {}\n")
        arguments = ["-p", f"initial_calibration:={path}"]
    assert main(["replay", str(bag), *arguments]) == 2
    assert len(capsys.readouterr().err) < 2000


# ---------------------------------------------------------------------- definitions, which become code

HOSTILE = {
    "a constant that is code": (MSG, "string X=__import__('os').system('touch pwned')\nint32 a\n"),
    "a constant that ends its quotes": (MSG, 'string X=\');__import__("os").system("touch pwned")#\nint32 a\n'),
    "a default that is code": (MSG, "string a \"'+__import__('os').system('touch pwned')+'\"\n"),
    "a field that is code": (MSG, "int32 a=__import__('os').system('touch pwned')\n"),
    "a type that ends its name": (MSG, 'x"""\nimport os;os.system("touch pwned")\n"""/Y a\n'),
    "a nested type with code for a name": (MSG, "int32 a\n" + "=" * 80 + "\nMSG: a/b;import os\nint32 b\n"),
    "idl code": (IDL, "module a { module msg { struct B { long x; }; const string C = \"'+exec('pwned')+'\"; }; };"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_definition_runs_nothing(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    kind, text = HOSTILE[name]
    with suppress(DefinitionError, SerdeError):
        store = typestore(Definition(kind, text), "a/msg/B")
        store.deserialize_cdr(b"\0\1\0\0" + bytes(32), "a/msg/B")
    assert not list(tmp_path.iterdir())


@searched(60)
@given(st.text(alphabet="'\"\\\n;=#[]() ab1_/<>:", max_size=60), st.sampled_from([MSG, IDL]))
def test_no_text_gets_through_a_definition_into_code(text, kind):
    """Whatever is accepted, all that reaches the generated code are plain names and numbers."""
    try:
        store = typestore(Definition(kind, text + "\nint32 a\n"), "a/msg/B")
    except DefinitionError:
        return
    for name, (constants, fields) in store.fielddefs.items():
        assert not constants
        assert re.fullmatch(r"[\w/]+", name, re.ASCII)
        assert all(re.fullmatch(r"\w+", field, re.ASCII) for field, _ in fields)


def nested(bodies: list[str]) -> str:
    """Return a definition whose types are these: the first, and C, D, E and so on."""
    first, *others = bodies
    return (
        first + "".join(f"\n{'=' * 80}\nMSG: a/{'CDEFGHIJKLMNOP'[i]}\n{each}" for i, each in enumerate(others)) + "\n"
    )


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (MSG, "string[900000000] a\n"),
        (MSG, "string[60000] a\n"),
        (MSG, nested(["a/C[60000] a", "uint8 x"])),
        (MSG, "uint8[0] a\n"),
        (MSG, nested(["a/C[0] a"])),
        (MSG, nested([f"a/{'CDEFGHIJKLMNOP'[i]} x\na/{'CDEFGHIJKLMNOP'[i]} y" for i in range(14)] + ["uint8 x"])),
        (MSG, nested(["a/C[21] x", "a/D[21] x", "a/E[21] x", "uint8 x"])),
        (MSG, "".join(f"uint8 a{i}\n" for i in range(9000))),
        (MSG, "int32 a # " + "x" * (1 << 19) + "\n"),
        (IDL, "module a { module msg { const long X = 1 << 99999999999; struct B { long x; }; }; };"),
        (IDL, "module a { module msg { const long X = " + "(" * 40 + "1" + ")" * 40 + "; struct B { long x; }; }; };"),
    ],
)
def test_a_definition_that_would_take_all_memory_or_for_ever_is_refused(kind, text):
    with pytest.raises(DefinitionError, match=r"of 900|of 60|of 0|unfolds|characters|computed"):
        typestore(Definition(kind, text), "a/msg/B")


def test_messages_of_a_refused_definition_are_counted_not_fatal(tmp_path, capsys):
    path = tmp_path / "hostile.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema(TWIST_TYPE, "ros2msg", b"string[900000000] a\n")
        channel = writer.register_channel("dvl/twist", "cdr", schema)
        for log_ns in range(1, 4):
            writer.add_message(channel, log_ns, b"\0\1\0\0" + bytes(64), log_ns)
        writer.finish()
    with BagReader([path]) as bag:
        assert [(message, "array of 900000000" in why) for _, _, message, why in bag.messages(["dvl/twist"])] == [
            (None, True)
        ] * 3
    assert main(["replay", str(path)]) == 2
    assert "3 invalid" in capsys.readouterr().err


def test_every_definition_that_ros_ships_is_accepted():
    for msgtype in JAZZY.fielddefs:
        definition, _ = JAZZY.generate_msgdef(msgtype, ros_version=2)
        assert msgtype in typestore(Definition(MSG, definition), msgtype).types


# ---------------------------------------------------------------------- paths


@pytest.mark.parametrize("name", ["../../escaped.mcap", "/etc/hostname", "..", "bag/../../x.db3"])
def test_file_names_in_metadata_lead_to_no_file_outside_of_the_folder(tmp_path, name):
    bag = write_bag(tmp_path / "outer" / "bag", run(6.0)) if (tmp_path / "outer").mkdir() is None else None
    (tmp_path / "escaped.mcap").write_bytes(b"secret")
    metadata = bag / "metadata.yaml"
    metadata.write_text(f"rosbag2_bagfile_information: {{relative_file_paths: ['{name}', bag.mcap]}}\n")
    with BagReader([bag]) as reader:
        assert [source.path for source in reader._sources] == [bag / "bag.mcap"]


HOSTILE_NAME = "../../escaped<script>alert(1)</script>$(touch escaped);touch escaped\x1b[2J"


def test_names_in_a_bag_write_no_file_and_reach_no_terminal_or_page_raw(tmp_path, capsys, monkeypatch):
    """Topic and frame names of a bag, through every command that writes."""
    monkeypatch.chdir(tmp_path)
    drawn(monkeypatch)  # what is in the pictures: test_report.py

    def change(topic, message):
        message.header.frame_id = HOSTILE_NAME if topic != "gnss/twist" else "map"
        return message

    bag = rewrite(tmp_path / "bag", change, run(30.0))
    outputs = ["--json", "out.json", "--save", "out.yaml", "--report", "out.html"]
    assert main(["replay", str(bag), "-p", "gnss_frame:=enu", "-p", "dvl_position:=told", *outputs]) == 0
    assert main(["salvage", str(bag), "-o", str(tmp_path / "new")]) == 0
    assert main(["replay", str(bag), "--dvl-topic", HOSTILE_NAME]) == 2
    output = capsys.readouterr()
    assert "\x1b" not in output.out + output.err
    assert "<script>alert" not in (tmp_path / "out.html").read_text()
    line = load_yaml(tmp_path / "out.yaml", "result file")["mounting"]["static_transform_publisher"]
    assert shlex.split(line)[-1] == printable(HOSTILE_NAME)  # it is there to be pasted
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"bag", "bag_source", "new", "out.json", "out.yaml", "out.html"}
    assert raw(tmp_path / "new") == raw(bag)


def test_control_characters_are_shown_not_sent():
    assert printable("a\x1b]0;x\x07b\u202eφ\udcff") == "a\\x1b]0;x\\x07b\\u202eφ\\udcff"


def test_at_run_time_a_result_file_stays_in_its_folder_and_is_yaml(tmp_path):
    check_in_folder(tmp_path / "other.yaml", tmp_path)
    (tmp_path / "link.yaml").symlink_to("/etc/passwd.yaml")
    for bad in ("../x.yaml", "sub/x.yaml", ".bashrc", "link.yaml", "x.yaml/../../y.yaml"):
        with pytest.raises(InputError, match="a running node accepts only"):
            check_in_folder(tmp_path / bad, tmp_path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make another user's link")
def test_a_link_that_another_user_has_laid_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    link = tmp_path / "result.yaml"
    link.symlink_to(victim)
    save_text(link, "mine")
    assert victim.read_text() == "mine"
    os.lchown(link, 65534, 65534)
    for attempt in (lambda: save_text(link, "theirs"), lambda: check_writable(link)):
        with pytest.raises(InputError, match="another user"):
            attempt()
    assert victim.read_text() == "mine"


# ---------------------------------------------------------------------- SROS2


def allowed() -> dict[str, set[str]]:
    """What config/sros2_policy.xml allows: kind -> full names."""
    (profile,) = ElementTree.parse(ROOT / "config" / "sros2_policy.xml").iterfind(".//profile")
    names: dict[str, set[str]] = {}
    for group in profile:
        ((kind, verdict),) = group.attrib.items()
        assert verdict == "ALLOW"
        texts = [entry.text or "" for entry in group]
        names[kind] = {
            f"/{profile.get('node')}/{text[2:]}" if text.startswith("~/") else f"/{text.lstrip('/')}" for text in texts
        }
        assert not any(set(text) & set("*?[") for text in texts), "no wildcards"
    return names


def test_the_sros2_policy_allows_what_the_live_node_has_and_nothing_else():
    pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")
    from ros import NODE, World, until

    world = World()
    try:
        with world.calibration_node("use_sim_time:=true"):
            asked = {
                "subscribe": world.node.get_subscriber_names_and_types_by_node,
                "publish": world.node.get_publisher_names_and_types_by_node,
                "reply": world.node.get_service_names_and_types_by_node,
                "request": world.node.get_client_names_and_types_by_node,
            }

            def present() -> dict[str, set[str]]:
                try:
                    found = {kind: {name for name, _ in ask(NODE, "/")} for kind, ask in asked.items()}
                except Exception:  # rclpy: it has not been discovered yet
                    return {}
                return {kind: names for kind, names in found.items() if names}

            expected = allowed()
            until(
                lambda: all(expected[kind] - {"/tf_static"} <= present().get(kind, set()) for kind in expected),
                "the node's endpoints",
            )
            # ROS from PyPI has no tf2_msgs and tf2_ros, and the node then does without
            found = present()
            assert {kind: names - {"/tf_static"} for kind, names in found.items()} == {
                kind: names - {"/tf_static"} for kind, names in expected.items()
            }
            assert {kind for kind, names in expected.items() if "/tf_static" in names} == {"subscribe", "publish"}
    finally:
        world.close()
