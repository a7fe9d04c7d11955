"""CSV and NPY trajectories become the samples that they describe, or are refused by file and row."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from conftest import searched
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import estimates, raw
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.logs.trajectories import (
    ImportOptions,
    import_folder,
    import_recording,
    read_attitude,
    read_columns,
    read_dvl,
    read_reference,
)

TABLE = np.array([[0.0, 1.0, 0.1, -0.05], [0.2, 1.1, 0.2, -0.06], [0.4, 1.2, 0.3, -0.07]])
HEADER = "Time [s],Vx [m/s],Vy [m/s],Vz [m/s]\n"


def csv(path: Path, table=TABLE, header: str = HEADER) -> Path:
    path.write_text(header + "".join(",".join(repr(float(cell)) for cell in row) + "\n" for row in table))
    return path


def windows(path: Path) -> Path:
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    return path


def npy(path: Path, table=TABLE) -> Path:
    np.save(path, table)
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two recordings: one with everything, one with the DVL alone, as NPY."""
    (tmp_path / "in").mkdir()
    csv(tmp_path / "in" / "T1_dvl.csv")
    csv(tmp_path / "in" / "T1_gnss.csv")
    csv(tmp_path / "in" / "T1_attitude.csv", TABLE * [1, 0.1, 0.1, 1], "Time [s],Roll [rad],Pitch [rad],Yaw [rad]\n")
    npy(tmp_path / "in" / "T2_dvl.npy")
    return tmp_path / "in"


@pytest.mark.parametrize(
    "write",
    [
        csv,
        npy,
        lambda path: csv(path, header=""),
        lambda path: csv(path, header="\ufeff"),
        lambda path: csv(path, header=HEADER.upper()),
        lambda path: windows(csv(path)),
    ],
)
def test_every_kind_of_file_gives_the_same_exact_numbers(tmp_path, write):
    name = "a.npy" if write is npy else "a.csv"
    time, values, left_out = read_columns(write(tmp_path / name), "m/s")
    assert np.array_equal(np.column_stack([time, values]), TABLE) and not left_out


def test_forward_right_down_becomes_forward_left_up(tmp_path):
    samples = read_dvl(csv(tmp_path / "a.csv"), 10**9, "frd", 0.0, [])
    assert [sample.velocity for sample in samples] == [(vx, -vy, -vz) for _, vx, vy, vz in TABLE]
    assert [sample.stamp_ns for sample in samples] == [10**9, 1_200_000_000, 1_400_000_000]
    unchanged = read_dvl(csv(tmp_path / "a.csv"), 0, "flu", 0.0, [])
    assert [sample.velocity for sample in unchanged] == [tuple(row[1:]) for row in TABLE]


@pytest.mark.parametrize(
    ("frame", "signs", "expected"),
    [
        ("frd", (1, -1, -1), VelocityFrame.BODY),
        ("flu", (1, 1, 1), VelocityFrame.BODY),
        ("enu", (1, 1, 1), VelocityFrame.ENU),
        ("ned", (1, 1, 1), VelocityFrame.NED),
    ],
)
def test_a_reference_keeps_its_earth_frame_or_becomes_forward_left_up(tmp_path, frame, signs, expected):
    (sample, *_) = read_reference(csv(tmp_path / "a.csv"), 0, frame, 0.3, [])
    assert sample.frame is expected
    assert sample.velocity == pytest.approx(TABLE[0, 1:] * signs)
    assert np.array_equal(sample.covariance, np.eye(3) * 0.3**2)


def test_attitude_of_marine_instruments_becomes_that_of_ros(tmp_path):
    """Heading 30 degrees east of north, bow up by 10: ROS sees yaw 60 from east, pitch -10, no roll."""
    table = np.array([[0.0, 0.0, np.radians(10), np.radians(30)], [1.0, 0.0, np.radians(10), np.radians(32)]])
    first, second = read_attitude(csv(tmp_path / "a.csv", table, ""), 0, [])
    yaw, pitch, roll = Rotation.from_quat(first.orientation).as_euler("ZYX", degrees=True)
    assert (yaw, pitch, roll) == pytest.approx((60.0, -10.0, 0.0), abs=1e-9)
    ahead = Rotation.from_quat(first.orientation).apply([1, 0, 0])
    assert ahead == pytest.approx(
        [np.cos(np.radians(10)) * 0.5, np.cos(np.radians(10)) * 3**0.5 / 2, np.sin(np.radians(10))]
    )
    # turning to starboard is a negative rate about up
    assert second.angular_velocity == pytest.approx(first.angular_velocity, abs=1e-12)
    assert Rotation.from_quat(first.orientation).apply(first.angular_velocity) == pytest.approx([0, 0, -np.radians(2)])


WRONG = {
    "missing.csv": (None, "no such file"),
    "empty.csv": ("", "expected rows of time and three values"),
    "header_only.csv": (HEADER, "expected rows"),
    "degrees.csv": ("Time [s],Roll [deg],Pitch [deg],Yaw [deg]\n0,1,2,3\n", "'Roll [deg]' is not in m/s; convert"),
    "round_brackets.csv": ("Time (s),Vx (knots),Vy (knots),Vz (knots)\n0,1,2,3\n", "'Vx (knots)' is not in m/s"),
    "milliseconds.csv": ("Time [ms],Vx [m/s],Vy [m/s],Vz [m/s]\n0,1,2,3\n", "'Time [ms]' is not in s"),
    "time_last.csv": ("Vx,Vy,Vz,Time\n1,2,3,0\n", "first column is 'Vx', expected time"),
    "nan.csv": (HEADER + "0,1,nan,3\n1,1,,3\n", "every row has a value that is not a finite number"),
    "unsorted.csv": (HEADER + "0,1,2,3\n2,1,2,3\n1,1,2,3\n", "time does not increase at row 3"),
    "repeated.csv": (HEADER + "0,1,2,3\n0,1,2,3\n", "time does not increase at row 2"),
    "five.csv": (HEADER + "0,1,2,3,4\n", "data row 1 has 5 columns"),
    "five_header.csv": ("Time [s],a,b,c,d\n0,1,2,3\n", "has 5 columns"),
    "short.csv": (HEADER + "0,1,2,3\n1,2\n", "data row 2 has 2 columns"),
    "words.csv": (HEADER + "0,1,two,3\n", "data row 1 is not all numbers"),
    "one_cut.csv": (HEADER + "0,1,2", "expected rows"),
    "cut_and_short.csv": (HEADER + "0,1\n1,2", "data row 1 has 2 columns"),
    "decimal_commas.csv": ("0,0,1,5,0,1,-0,05\n0,2,1,5,0,1,-0,05\n", "data row 1 has 8 columns"),
    "utf16.csv": ("Time [s],a,b,c\n0,1,2,3\n".encode("utf-16"), "save it as such, in UTF-8"),
    "semicolons.csv": ("0;1;2;3\n", "has 1 columns"),
    "latin1.csv": ("Zeit [s],°,°,°\n0,1,2,3\n".encode("latin-1"), "cannot be read as CSV"),
    "binary.csv": (bytes(range(256)), "cannot be read as CSV"),
    "nanoseconds.csv": (HEADER + "1600000000000000000,1,2,3\n", "not in 1970 .. 2038"),
    "since_1970.csv": (HEADER + "1790000000.25,1,2,3\n", "1790000000.25 s, after --start, is not in 1970 .. 2038; times"
                       " are seconds, and those since 1970 need --start 0"),
    "underscore.csv": (HEADER + "0,1_0,2,3\n", "data row 1 is not all numbers"),
    "negative.csv": (HEADER + "-1600000001,1,2,3\n", "not in 1970 .. 2038"),
    "text.npy": ("0,1,2,3\n", "not a NumPy array file"),
    "empty.npy": ("", "not a NumPy array file"),
    "archive.npy": (b"PK\x03\x04" + bytes(40), "not a NumPy array file"),
    "claims.npy": (b"\x93NUMPY\x01\x00\x46\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 4)}  ",
                   "not a NumPy array file"),
}  # fmt: skip


def test_an_attitude_that_nothing_can_turn_to_leaves_the_rates_of_the_others(tmp_path):
    """A damaged row, 87 µs after another: the smooth curve through all of them had no end."""
    time = 0.1 * np.arange(40)
    sound = np.column_stack([time, 0.05 * np.sin(time), 0.02 * np.cos(time), 0.1 * time])
    wild = np.insert(sound, 20, [time[19] + 87e-6, 1e300, -0.5, 3.0], axis=0)
    header = "Time [s],Roll [rad],Pitch [rad],Yaw [rad]\n"
    both = [csv(tmp_path / f"{n}_attitude.csv", rows, header) for n, rows in enumerate((sound, wild))]
    expected, found = (np.array([each.angular_velocity for each in read_attitude(path, 0, [])]) for path in both)
    far = np.abs(np.arange(40) - 19.5) > 8  # a smooth curve swings next to it
    np.testing.assert_allclose(np.delete(found, 20, axis=0)[far], expected[far], atol=0.01)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_in_a_file_is_said_with_file_and_row_and_nothing_is_written(tmp_path, name):
    content, expected = WRONG[name]
    if content is not None:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        import_recording(tmp_path / name, None, None, tmp_path / "bag", ImportOptions())
    assert str(caught.value).startswith(f"{tmp_path / name}: ") and expected in str(caught.value)
    assert not (tmp_path / "bag").exists()


MISSING = ["nan", "NaN", "inf", "-inf", "", " ", "NA", "n/a", "null", "None", "-", "1e999"]


@pytest.mark.parametrize("word", MISSING)
@pytest.mark.parametrize("column", range(4))
def test_a_row_without_a_number_is_left_out_counted_and_named_as_an_invalid_sample_of_a_bag_is(tmp_path, word, column):
    rows = [[repr(float(cell)) for cell in row] for row in TABLE]
    rows[1][column] = word
    (tmp_path / "a.csv").write_text(HEADER + "".join(f"{','.join(row)}\n" for row in rows))
    imported = import_recording(tmp_path / "a.csv", None, None, tmp_path / "bag", ImportOptions())
    assert imported.counts["dvl/twist"] == 2
    (note,) = imported.notes
    assert "a.csv: 1 of 3 rows have a value that is not finite, left out; the first is row 2" in note
    assert read_columns(tmp_path / "a.csv", "m/s").values.tolist() == TABLE[[0, 2], 1:].tolist()


def test_rows_of_an_array_that_are_not_finite_are_left_out_too_and_the_order_of_time_is_that_of_the_others(tmp_path):
    table = np.vstack([TABLE, TABLE[1]])
    table[1] = np.nan
    with pytest.raises(InputError, match="time does not increase at row 4"):
        read_columns(npy(tmp_path / "a.npy", table), "m/s")
    time, _, left_out = read_columns(npy(tmp_path / "a.npy", table[:3]), "m/s")
    assert time.tolist() == [0.0, 0.4] and "1 of 3 rows" in left_out[0]


@searched(80)
@given(data=st.data())
def test_of_a_file_that_is_cut_anywhere_no_number_is_taken_that_was_not_in_it(tmp_path_factory, data):
    """A copy that was interrupted, with the zeros that a power cut may leave behind it."""
    path = csv(tmp_path_factory.mktemp("cut") / "a.csv", np.vstack([TABLE, TABLE[-1] + [10.25, 0.5, 0.25, 0.125]]))
    whole = path.read_text()
    at = data.draw(st.integers(whole.index("\n0.2") + 1, len(whole)))
    path.write_text(whole[:at] + data.draw(st.sampled_from(["", "\0" * 7])))
    time, values, left_out = read_columns(path, "m/s")
    lines = whole[: whole.rindex("\n", 0, at) + 1].splitlines()[1:] if at else []
    expected = [[float(cell) for cell in line.split(",")] for line in lines]
    assert np.column_stack([time, values]).tolist() == expected
    assert len(left_out) == (whole[at - 1] != "\n")


ODD = [np.zeros((3, 3)), np.zeros(4), np.zeros((0, 4)), np.array([["a"] * 4]), np.array({}), np.zeros(2, "f8,f8,f8,f8")]


@pytest.mark.parametrize("table", ODD)
def test_an_array_of_another_shape_or_kind_is_refused(tmp_path, table):
    np.save(tmp_path / "a.npy", table, allow_pickle=True)
    with pytest.raises(InputError, match=r"a\.npy: "):
        read_columns(tmp_path / "a.npy", "m/s")


def test_a_folder_becomes_one_bag_per_recording_with_the_files_that_belong_to_it(folder, tmp_path):
    written = import_folder(folder, tmp_path / "out", ImportOptions())
    assert written == {
        tmp_path / "out" / "T1": ({"dvl/twist": 3, "gnss/twist": 3, "imu/data": 3}, ()),
        tmp_path / "out" / "T2": ({"dvl/twist": 3, "gnss/twist": 0, "imu/data": 0}, ()),
    }
    with BagReader([tmp_path / "out" / "T1"]) as bag:
        assert bag.message_counts == {"dvl/twist": 3, "gnss/twist": 3, "imu/data": 3}
    assert estimates(tmp_path / "out" / "T1")["M3"] != estimates(tmp_path / "out" / "T2")["M3"]


def test_a_recording_given_as_csv_and_npy_is_imported_once(folder, tmp_path):
    npy(folder / "T1_dvl.npy", TABLE * [1, 2, 2, 2])
    import_folder(folder, tmp_path / "out", ImportOptions())
    import_recording(
        folder / "T1_dvl.csv", folder / "T1_gnss.csv", folder / "T1_attitude.csv", tmp_path / "one", ImportOptions()
    )
    assert raw(tmp_path / "out" / "T1") == raw(tmp_path / "one")


def test_a_folder_with_one_bad_file_leaves_no_bag_behind(folder, tmp_path):
    csv(folder / "T9_dvl.csv", TABLE[::-1])
    with pytest.raises(InputError, match="T9_dvl"):
        import_folder(folder, tmp_path / "out", ImportOptions())
    assert not any((tmp_path / "out").iterdir())


def test_a_folder_without_recordings_says_how_they_are_named(tmp_path):
    with pytest.raises(InputError, match=r"NAME_dvl\.csv or NAME_dvl\.npy"):
        import_folder(tmp_path, tmp_path / "out", ImportOptions())


def test_an_existing_output_is_never_overwritten(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "precious").touch()
    with pytest.raises(InputError, match="exists already"):
        import_recording(csv(tmp_path / "a.csv"), None, None, tmp_path / "bag", ImportOptions())
    assert os.listdir(tmp_path / "bag") == ["precious"]


@pytest.mark.parametrize("std", [-0.1, float("nan"), float("inf")])
def test_a_standard_deviation_that_is_none_is_refused(std):
    with pytest.raises(InputError, match="--dvl-std"):
        ImportOptions(dvl_std=std)
