"""Messages by the thousand are those that one reads one by one."""

from __future__ import annotations

from operator import itemgetter

import numpy as np
import pytest
from conftest import searched
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from io_fixtures import TOPICS, mcap_bytes, raw
from mcap.writer import CompressionType

from dvl_calib_ros.bags.batches import batched
from dvl_calib_ros.bags.channels import Channel
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.salvage.damage import Damage, DamagedError
from dvl_calib_ros.bags.salvage.mcap_records import (
    MESSAGE,
    RECORD_HEAD,
    SCHEMA,
    Tables,
    messages_of,
    places_by_index,
    places_of,
)

TIMES = st.integers(0, 40) | st.sampled_from([2**63 - 1, 2**63, 2**64 - 1])


@searched(60, HealthCheck.function_scoped_fixture)
@given(
    st.lists(st.tuples(st.sampled_from(sorted(TOPICS)), TIMES, st.binary(max_size=70)), min_size=1, max_size=40),
    st.sampled_from([60, 300, 2048]),
    st.sampled_from([CompressionType.NONE, CompressionType.ZSTD]),
)
def test_chunks_in_any_order_of_time_are_merged(tmp_path_factory, messages, chunk_size, compression):
    path = tmp_path_factory.mktemp("bag") / "bag.mcap"
    path.write_bytes(mcap_bytes(messages, chunk_size=chunk_size, compression=compression))
    expected = [each for each in messages if not each[2].startswith(b"\x28\xb5\x2f\xfd")]
    found = raw(path)
    assert [log_ns for _, log_ns, _ in found] == sorted(log_ns for _, log_ns, _ in expected)
    assert sorted(found) == sorted(expected)  # of chunks that hold the same time either may be first
    topics = sorted(TOPICS)[:1]
    with BagReader([path]) as bag:
        some = [(channel.topic, log_ns, data) for log_ns, channel, data in bag.raw_messages(topics)]
    assert some == [each for each in found if each[0] in topics]


def record(opcode: int, content: bytes) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content)) + content


def message(channel: int, log_ns: int, data: bytes) -> bytes:
    number = channel.to_bytes(2, "little") + bytes(4)
    return record(MESSAGE, number + log_ns.to_bytes(8, "little") * 2 + data)


@pytest.fixture
def tables() -> Tables:
    known = Tables(None)
    known.channels.update(dict.fromkeys((1, 7)))  # only whether they are there is asked
    return known


@searched(100, HealthCheck.function_scoped_fixture)
@given(
    st.lists(st.tuples(st.sampled_from([1, 7]), st.integers(0, 2**64 - 1), st.binary(max_size=40)), max_size=20),
    st.none() | st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)),
)
def test_places_are_those_of_messages_read_one_by_one_or_there_are_none(tables, messages, damage):
    """damage: where one byte is another, as a share of all, and which."""
    records = bytearray(b"".join(message(*each) for each in messages))
    if damage is not None and records:
        records[int(damage[0] * len(records))] = damage[1]
    noted = Damage()
    expected = messages_of(0, bytes(records), tables, noted)
    places = places_of(bytes(records), tables)
    if places is None:
        assert noted or len(records) < 31
        return
    columns = zip(*(column.tolist() for column in places), strict=True)
    found = [(log_ns, number, bytes(records[start:end])) for log_ns, number, start, end in columns]
    assert sorted(found, key=itemgetter(0)) == expected
    assert not noted


@searched(150, HealthCheck.function_scoped_fixture)
@given(
    st.lists(
        st.tuples(st.sampled_from([1, 7, "schema"]), st.integers(0, 2**64 - 1), st.binary(max_size=40)), max_size=12
    ),
    st.none() | st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)),
    st.none() | st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(-3, 3) | st.integers(0, 2**64 - 1)),
    st.booleans(),
)
def test_an_index_leads_to_all_that_one_finds_from_record_to_record_or_to_nothing(
    tables, messages, damage, wrong, is_short
):
    """damage: where one byte is another; wrong: where one of the index's places is another; short: it lacks one."""
    parts = [
        record(SCHEMA, b"\1\0" + bytes(12)) if number == "schema" else message(number, *each)
        for number, *each in messages
    ]
    places = np.cumsum([0, *map(len, parts)])[:-1]
    starts = np.array(
        [at for at, (kind, *_) in zip(places, messages, strict=True) if kind != "schema"], dtype=np.uint64
    )
    records = bytearray(b"".join(parts))
    if damage is not None and records:
        records[int(damage[0] * len(records))] = damage[1]
    if wrong is not None and len(starts):
        at = int(wrong[0] * len(starts))
        starts[at] = (int(starts[at]) + wrong[1]) % 2**64
    found = places_by_index(bytes(records), starts[: len(starts) - is_short], tables)
    if found is not None:
        expected = places_of(bytes(records), tables)
        assert [column.tolist() for column in found] == [column.tolist() for column in expected]
    elif damage is None and wrong is None and not is_short:
        assert not len(starts)


@pytest.mark.parametrize(
    "records",
    [
        message(1, 5, b"ab")[:-1], message(1, 5, b"ab") + b"\5", message(2, 5, b"ab"), record(MESSAGE, bytes(21)) * 3,
        message(1, 5, b"ab") + record(4, b"no channel"), message(1, 5, b"ab") + record(9, b""),
    ],
)  # fmt: skip
def test_records_of_which_something_is_wrong_have_no_places(tables, records):
    assert places_of(message(1, 5, b"ab"), tables) is not None
    assert places_of(records, tables) is None


def test_what_came_before_damage_is_given_before_it_is_raised():
    channel = Channel("a", "b")

    def until_damage():
        yield 1, channel, b"one"
        yield 2, channel, b""
        raise DamagedError("here")

    found = []
    with pytest.raises(DamagedError, match="here"):
        for batch in batched(until_damage()):
            found += batch.messages()
    assert found == [(1, channel, b"one"), (2, channel, b"")]
