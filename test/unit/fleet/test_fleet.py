"""A catalogue of a fleet: each recording once, what `replay` says of it, and what a person is to look at."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from fleet_fixtures import copies, write_dive, write_fleet
from report_fixtures import drawn
from water_fixtures import SALINITY, TEMPERATURE, USED, with_water

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.checks.speed_of_sound import speed_of_sound
from dvl_calib_ros.calibration.comparison.mounting_change import compare
from dvl_calib_ros.fleet_catalogue import update as running
from dvl_calib_ros.fleet_catalogue.update import Catalogue, Catalogued, histories, need_person
from dvl_calib_ros.parallel import Lost, Workers, outcomes_as_done
from dvl_calib_ros.present.comparison import QUANTITIES, fleet
from dvl_calib_ros.present.comparison_figures import _draw_quantity
from dvl_calib_ros.present.document import Sentence
from dvl_calib_ros.present.figure_style import new_figure

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")


def table(out: Path):
    """All rows, as pandas reads them."""
    return pytest.importorskip("pandas").read_parquet(out / "rows")


def contents(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((out / "rows").iterdir())}


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch) -> None:
    """But for those of `made`, which are looked at."""
    drawn(monkeypatch)


@pytest.fixture(scope="module")
def dives(tmp_path_factory) -> Path:
    return write_fleet(tmp_path_factory.mktemp("fleet") / "dives")


@pytest.fixture(scope="module")
def made(dives, tmp_path_factory):
    """The fleet calibrated, its folder."""
    out = tmp_path_factory.mktemp("fleet_out") / "catalogue"
    return dc.fleet(dives, out, jobs=1), out


@pytest.fixture
def copied(made, tmp_path) -> Path:
    """That folder for a test of its own."""
    return Path(shutil.copytree(made[1], tmp_path / "out"))


def test_a_row_is_a_recording_and_parameter_with_what_replay_says_of_it(made, dives):
    rows = table(made[1])
    assert not rows.duplicated(["recording", "parameter"]).any()
    own = rows[rows.recording == str(dives / "auv1" / "dive1")].set_index("parameter")
    run = dc.replay(dives / "auv1" / "dive1", history=False)
    estimate = run.replayed.result.estimate
    assert own.value[["roll", "pitch", "yaw"]].tolist() == list(run.mounting.rpy_deg)
    assert own.std_next[["roll", "pitch", "yaw"]].tolist() == list(run.mounting.std_deg)
    up = np.degrees(np.stack([estimate.filter_std, estimate.recording_std, estimate.std])[:, 2])
    np.testing.assert_allclose(own.loc["yaw", ["std_filter", "std_recording", "std_next"]].tolist(), up, rtol=0.1)
    assert up[0] < up[2]
    assert set(own.verdict) == {run.verdict} and list(own.codes.iloc[0]) == list(run.codes)
    assert set(own.drift_after) == {run.replayed.navigation.after.per_km}
    assert set(own.vehicle) == {"auv1"} and len(set(own.day)) == 1
    assert own.unit[["yaw", "scale"]].tolist() == ["deg", "%"]


def test_a_part_of_before_the_bias_of_the_dvl_was_kept_is_read(made):
    (part, *_) = (each for each in Catalogue(made[1]).parts() if each.extrinsics is not None)
    told = dict(part.extrinsics)
    assert Catalogued.of("a", "b", [], told).extrinsics.dvl == told["dvl"] == "dvl_link, flu"
    del told["dvl"], told["by_bias"]
    old = Catalogued.of("a", "b", [], told).extrinsics
    assert old.dvl == "" and not old.by_bias.any()


def test_a_bad_recording_is_one_row_with_its_error(made, dives):
    result, out = made
    rows = table(out)
    bad = rows[rows.recording == str(dives / "auv2" / "no.mcap")]
    assert len(bad) == 1 and "damaged" in bad.error.iloc[0] and bad.parameter.isna().all()
    assert rows[rows.recording != str(dives / "auv2" / "no.mcap")].error.isna().all()
    assert result.recordings == 5
    (person,) = (each for each in result.persons if each.code == "")
    assert person.recordings == (str(dives / "auv2" / "no.mcap"),)


def test_the_day_on_which_a_mounting_moved_is_said(made):
    result, _ = made
    by_name = {each.name: each for each in result.vehicles}
    (change,) = by_name["auv1"].compared.moved
    assert (change.last_before.name, change.first_after.name) == ("dive1", "dive2")
    assert by_name["auv2"].compared is None
    (turned,) = re.findall(r"auv1: The mounting has moved in yaw by \+(\S+)°", repr(result))
    assert result.word == "moved" and float(turned) == pytest.approx(3.0, abs=1.0)
    page = result.page.read_text()
    assert page.count("<img") >= 3 and "no.mcap" in page
    assert ">Damaged" in page or " Damaged" in page  # a sentence, which wraps


def test_the_page_begins_with_who_needs_a_person_and_draws_an_inverted_dvl_without_a_jump(made):
    found = made[0]
    moved = found.vehicles[0]
    alone = replace(moved, name="a_first", days=moved.days[:1], compared=None)
    table = fleet(replace(found, vehicles=(alone, moved))).tables["Vehicles"]
    assert [row[0] for row in table.rows] == [moved.name, "a_first"]
    for angles in ((179.9, -179.8), (-179.9, 179.7)):
        turned = [  # as of two DVLs
            replace(
                each,
                dvl="",
                value=np.radians([roll, *np.zeros(7)]),
                shown=np.ones(8, dtype=bool),
                covariance=1e-4 * np.eye(8),
            )
            for each, roll in zip(moved.compared.calibrations[:2], angles, strict=True)
        ]
        axes = new_figure()[1]
        _draw_quantity(axes, compare(turned), QUANTITIES[0])
        assert np.ptp(axes.get_ylim()) < 20.0


def test_a_rejected_recording_that_differs_from_accepted_ones_is_a_suspected_move(made):
    (result, out), why = made, "the clock jumps"
    entries = [Catalogued.of(part.recording, part.vehicle, Catalogue(out).rows_of(part.recording), part.extrinsics)
               for part in Catalogue(out).parts() if part.vehicle == "auv1"]  # fmt: skip
    entries = [
        replace(each, extrinsics=replace(each.extrinsics, rejected=why * each.recording.endswith("dive2")))
        for each in entries
    ]
    (vehicle,) = histories(entries)
    assert len(vehicle.days) == 2 and vehicle.compared.verdict == "suspicious"
    said = repr(replace(result, vehicles=(vehicle,)))
    assert said.startswith("suspicious: auv1: Suspected move: dive2 is rejected (the clock")
    (alone,) = histories([each for each in entries if not each.recording.endswith("dive1")])
    assert len(alone.days) == 1 and alone.compared.verdict == "suspicious"  # nor is it "not compared"


@pytest.mark.slow
def test_recordings_of_one_day_share_what_differs_from_day_to_day(tmp_path):
    for number in range(4):
        write_dive(tmp_path / "dives" / f"dive{number}", 0, seed=number)
    result = dc.fleet(tmp_path / "dives", tmp_path / "out", jobs=1)
    (vehicle,) = result.vehicles
    (day,) = vehicle.days
    assert vehicle.name == "dives" and day.name == "4 recordings"
    own = table(tmp_path / "out")
    alone = own[own.parameter == "yaw"].std_recording.iloc[0]
    assert np.degrees(day.std[2]) > 0.1  # day_std_heading, which no number of recordings makes smaller
    assert np.degrees(day.std[2]) < np.hypot(0.1, alone) * 1.05


@pytest.mark.slow
def test_what_is_done_and_unchanged_is_not_done_again(dives, tmp_path, monkeypatch):
    place, out = tmp_path / "dives", tmp_path / "out"
    shutil.copytree(dives / "auv1", place / "auv1")
    done: list[str] = []

    def counted(task, real=running.entry_of):
        done.append(task.recording.inside)
        return real(task)

    monkeypatch.setattr(running, "entry_of", counted)

    def again(**options) -> list[str]:
        done.clear()
        result = dc.fleet(place, out, jobs=1, **options)
        assert result.calibrated == len(done) and result.unchanged == 3 - len(done)
        return sorted(done)

    assert len(again()) == 3
    before = contents(out)
    assert again() == [] and contents(out) == before
    os.utime(place / "auv1" / "dive0" / "dive0.mcap", (1.0, 1.0))
    assert again() == ["auv1/dive0"] and contents(out).keys() == before.keys()
    assert len(again(min_speed=0.3)) == 3
    next((out / "rows").glob("dive2*")).write_bytes(b"cut off")
    assert again(min_speed=0.3) == ["auv1/dive2"]
    assert again(min_speed=0.3, vehicle_from="(auv)") == [] and set(table(out).vehicle) == {"auv"}


def test_what_failed_by_the_machine_is_tried_again(dives, tmp_path, monkeypatch):
    def full(task):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dvl_calib_ros.fleet_catalogue.recording_entry.open_recording", lambda *_: full(None))
    result = dc.fleet(dives / "auv2" / "late", tmp_path / "out", jobs=1)
    assert [each.why for each in result.persons] == ["OSError: [Errno 28] No space left on device"]
    monkeypatch.undo()
    result = dc.fleet(dives / "auv2" / "late", tmp_path / "out", jobs=1)
    assert result.calibrated == 1 and result.persons == ()


@pytest.mark.slow
def test_a_recording_whose_name_is_no_text_or_that_is_gone_costs_its_row(dives, tmp_path, monkeypatch):
    place = tmp_path / "dives"
    shutil.copytree(dives / "auv1", place / "auv1")
    os.rename(place / "auv1" / "dive1", os.fsencode(place / "auv1") + b"/dive\xff")
    found = running.recordings_in

    def then_gone(places):
        recordings = found(places)
        shutil.rmtree(place / "auv1" / "dive2", ignore_errors=True)
        return recordings

    monkeypatch.setattr(running, "recordings_in", then_gone)
    result = dc.fleet(place, tmp_path / "out", jobs=1)
    assert result.recordings == 3 and len(result.vehicles[0].days) == 2
    (person,) = result.persons
    assert person.recordings == (str(place / "auv1" / "dive2"),) and "is not there" in person.why
    assert str(place / "auv1" / "dive\\xff") in set(table(tmp_path / "out").recording)
    assert dc.fleet(place, tmp_path / "out", jobs=1).unchanged == 2


@pytest.mark.slow
def test_what_recordings_say_of_the_water_is_in_rows_and_on_the_page(tmp_path):
    bag = with_water(tmp_path / "dives" / "auv1" / "dive")
    result = dc.fleet(tmp_path / "dives", tmp_path / "out", jobs=1)
    own = table(tmp_path / "out").set_index("parameter")
    names = ["water_temperature", "water_salinity", "dvl_speed_of_sound"]
    assert own.value[names].tolist() == pytest.approx([TEMPERATURE, SALINITY, USED])
    assert own.value["water_speed_of_sound"] == pytest.approx(speed_of_sound(TEMPERATURE, SALINITY), abs=0.1)
    assert 1.0 < own.std_recording["water_speed_of_sound"] < 3.0
    page = result.page.read_text()
    assert dc.replay(bag, history=False).replayed.cause_of_scale.sentence in html.unescape(page)
    assert f"{USED:.1f} m/s" in page  # and not the usual 1500


def test_a_part_of_another_schema_is_not_read(copied, dives):
    part = next((copied / "rows").glob("dive0*"))
    old = parquet.read_table(part)
    told = json.loads(old.schema.metadata[b"dvl_calib"]) | {"schema": 0, "extrinsics": {}}
    parquet.write_table(old.replace_schema_metadata({"dvl_calib": json.dumps(told)}), part)
    result = dc.fleet(dives, copied, jobs=1)
    assert (result.calibrated, result.unchanged) == (1, 4)


def test_no_flipped_bit_of_a_part_is_read_as_another_value(made, tmp_path):
    catalogue = Catalogue(tmp_path / "out")
    (source,) = (made[1] / "rows").glob("dive0*")
    whole, rng, place = source.read_bytes(), np.random.default_rng(7), catalogue.rows / source.name
    for number in range(1, 201):
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        place.write_bytes(flipped)
        assert list(catalogue.parts()) == [] and not place.exists()
        assert len(catalogue.notes) == number and "is damaged" in catalogue.notes[-1]
    assert len(list((tmp_path / "out" / "set_aside").iterdir())) == 200
    place.write_bytes(whole)
    (part,) = catalogue.parts()
    assert catalogue.rows_of(part.recording) == Catalogue(made[1]).rows_of(part.recording)


def test_pages_of_a_part_have_checksums_for_other_readers(made):
    """A number that is another is seen by a reader that compares them."""
    (part,) = (made[1] / "rows").glob("dive0*")
    values = parquet.read_table(part)["value"].to_numpy()
    flipped = bytearray(part.read_bytes())
    flipped[flipped.index(values[2].tobytes()[:7])] ^= 1
    assert (parquet.read_table(pa.BufferReader(bytes(flipped)))["value"].to_numpy() != values).any()
    with pytest.raises(OSError, match="CRC"):
        parquet.read_table(pa.BufferReader(bytes(flipped)), page_checksum_verification=True)


def test_a_damaged_or_foreign_part_is_set_aside_and_its_recording_done_again(made, copied, dives):
    out, rows = copied, copied / "rows"
    before, expected = contents(out), made[0].recordings
    names = {name[:5]: name for name in before}
    flipped = bytearray(before[names["dive0"]])
    flipped[len(flipped) // 3] ^= 4
    (rows / names["dive0"]).write_bytes(flipped)
    (rows / names["dive1"]).rename(rows / "another.parquet")
    shutil.copy(rows / names["dive2"], rows / "copy.parquet")
    os.mkfifo(rows / "pipe.parquet")
    (rows / "folder.parquet").mkdir()
    (rows / "link.parquet").symlink_to("pipe.parquet")
    (rows / "nowhere.parquet").symlink_to("nowhere")
    (rows / "large.parquet").touch()
    os.truncate(rows / "large.parquet", 1 << 40)
    result = dc.fleet(dives, out, jobs=1)
    assert (result.calibrated, result.unchanged, result.recordings) == (2, expected - 2, expected)
    assert contents(out).keys() == before.keys()
    strange = ("another", "copy", "pipe", "folder", "link", "nowhere", "large")
    aside = {names["dive0"], *(f"{name}.parquet" for name in strange)}
    assert {path.name for path in (out / "set_aside").iterdir()} == aside
    assert all(
        any(f"rows/{name}: " in note and str(out / "set_aside") in note for note in result.notes) for name in aside
    )
    again = dc.fleet(dives, out, jobs=1)
    assert (again.calibrated, again.notes) == (0, ())


def test_what_cannot_be_set_aside_is_said_in_one_line(copied, dives, capsys):
    (copied / "rows" / "bad.parquet").write_text("no part")
    (copied / "set_aside").write_text("a file")
    said = fail(capsys, "fleet", dives, "--out", copied, "--jobs", "1")
    assert "bad.parquet" in said and "remove it" in said


def test_the_same_data_in_two_places_is_used_once(dives, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(dives / "auv1" / "dive0", tmp_path / "dives" / "auv1" / name)
    result = dc.fleet(tmp_path / "dives", tmp_path / "out", jobs=1)
    assert [(each.code, each.recordings) for each in result.persons] == [
        ("SAME_DATA", (str(tmp_path / "dives" / "auv1" / "b"),))
    ]
    assert result.recordings == 2 and len(result.vehicles[0].days) == 1


@pytest.mark.slow
def test_an_object_store_gives_what_its_files_give(made, dives, tmp_path, capsys):
    fsspec = pytest.importorskip("fsspec")
    store = fsspec.filesystem("memory")
    store.put(str(dives), "/bucket/dives", recursive=True)
    try:
        error = fail(capsys, "fleet", "memory://bucket/dives", "--out", tmp_path / "out")
        assert "read it with --jobs 1" in error
        dc.fleet("memory://bucket/dives", tmp_path / "out", jobs=1)
        again = dc.fleet("memory://bucket/dives", tmp_path / "out", jobs=1)
    finally:
        store.rm("/bucket", recursive=True)
    assert (again.calibrated, again.unchanged) == (0, 5)
    one, other = (each.drop(columns="recording") for each in (table(tmp_path / "out"), table(made[1])))
    order = ["vehicle", "first", "parameter"]
    one, other = (each.sort_values(order).reset_index(drop=True) for each in (one, other))
    same = (one.drop(columns=["codes", "error"]) == other.drop(columns=["codes", "error"])) | (
        one.isna() & other.isna()
    )
    assert same.drop(columns=["codes", "error"]).all().all()
    assert "memory:///bucket/dives/auv2/no.mcap: " in "".join(one.error.dropna())


def test_the_command_prints_the_answer_and_who_needs_a_person(copied, dives, capsys):
    said, _ = succeed(capsys, "fleet", dives, "--out", copied, "--jobs", "1")
    assert said.startswith("not compared") or said.startswith("moved")
    assert "1 recording of 5 needs a person" in said and "no.mcap" in said
    assert said.count("\nauv1: ") == said.count("\nauv2: ") == 1  # one line per vehicle


def test_each_vehicle_has_its_own_reason_the_most_urgent_first(made):
    (moved,) = (each for each in made[0].vehicles if each.name == "auv1")
    rows = ({"verdict": "reject", "codes": ["A"], "reason": f"reason of {name}", "error": ""} for name in "bc")
    entries = [Catalogued(f"/dives/{name}/1", name, (row,)) for name, row in zip("bc", rows, strict=True)]
    persons = tuple(need_person(entries))
    assert [(each.vehicle, each.why) for each in persons] == [("b", "reason of b"), ("c", "reason of c")]
    unusable = [replace(moved, name=name, days=(), compared=None, recordings=1) for name in "bc"]
    good = replace(moved, name="a", compared=None, days=moved.days[:1])
    document = fleet(replace(made[0], vehicles=(good, *unusable, moved), persons=persons))
    lines = [item.text for item in document.sections[0].items if isinstance(item, Sentence)]
    assert [line.partition(":")[0] for line in lines] == ["auv1", "b", "c", "a"]
    assert lines[1] == "b: not compared. Reason of b. 1 recording needs a person."
    assert lines[3] == "a: not compared. One day alone."


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere", "--out", "out"), "nowhere: no such folder"),
        (("file", "--out", "out"), "no recording"),
        (("recorded", "--out", "out", "-p", "initial_calibration:=file"), "initial_calibration"),
        ((".", "--out", "out", "--jobs", "-1"), "jobs: -1 is no number of processes"),
        (("recorded", "--out", "file/out"), "file/out"),
        ((".", "--out", "out", "--vehicle-from", "("), "--vehicle-from"),
    ],
)
def test_bad_usage_is_refused_in_one_line(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("recorded").mkdir()
    for file in ("file", "recorded/one.mcap"):
        Path(file).write_text("a file\n")
    assert said in fail(capsys, "fleet", *arguments)


# ------------------------------------------------------------------ workers that die


def test_what_kills_its_worker_costs_itself_alone():
    """A worker that dies with one item, as by a recording that takes all memory."""
    items = ["1", "2", "__import__('os').kill(__import__('os').getpid(), 9)", "4", "5", "6"]
    outcomes = dict(outcomes_as_done(eval, items, Workers(jobs=2)))
    assert isinstance(outcomes.pop(2), Lost)
    assert outcomes == {0: 1, 1: 2, 3: 4, 4: 5, 5: 6}


def children_of(parent: int) -> list[int]:
    """Processes that are not over yet, by their parent."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, of = stat.read_text().rpartition(")")[2].split()[:2]
            if int(of) == parent and state != "Z":
                found.append(int(stat.parent.name))
    return found


def is_over(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.slow
def test_workers_end_with_a_parent_that_is_killed():
    """Those that work, and one that waits for work in vain."""
    script = (
        "import time; from dvl_calib_ros.parallel import Workers, outcomes_as_done; "
        "list(outcomes_as_done(time.sleep, [300.0, 300.0], Workers(jobs=3)))"
    )
    parent = subprocess.Popen([sys.executable, "-c", script])
    try:
        until = time.monotonic() + 60.0
        while len(workers := children_of(parent.pid)) < 3:
            assert time.monotonic() < until and parent.poll() is None
            time.sleep(0.05)
        time.sleep(1.0)  # they are up
        workers = children_of(parent.pid)
    finally:
        parent.kill()
        parent.wait()
    try:
        until = time.monotonic() + 20.0
        while not all(map(is_over, workers)):
            assert time.monotonic() < until, f"orphans: {[pid for pid in workers if not is_over(pid)]}"
            time.sleep(0.05)
    finally:
        for pid in workers:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
def test_a_run_that_is_killed_at_any_moment_is_gone_on_with(dives, tmp_path):
    """SIGKILL at three moments, each run going on with the one before; no row is lost, none is there twice."""
    place, out = copies(tmp_path / "dives", dives / "auv1" / "dive0", 4), tmp_path / "out"
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", "fleet", str(place), "--out", str(out), "--jobs", "2"]
    rng, seen = np.random.default_rng(4), 0
    for _ in range(3):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.5, 5.0))
        ended = process.poll() is not None
        process.kill()
        process.wait()
        if (out / "rows").exists():
            whole = [parquet.read_table(path).num_rows for path in (out / "rows").glob("*.parquet")]
            assert all(rows > 1 for rows in whole) and len(whole) >= seen
            seen = len(whole)
        if ended and seen == 4:
            break
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    rows = table(out)
    assert rows.recording.nunique() == 4 and not rows.duplicated(["recording", "parameter"]).any()
    assert rows.groupby("recording").size().nunique() == 1
    assert list((out / "rows").glob("*.parquet")) and len(list((out / "rows").iterdir())) == 4


@pytest.mark.slow
def test_workers_of_a_cluster_that_are_killed_cost_no_row(dives, tmp_path):
    distributed = pytest.importorskip("distributed")
    place, out = copies(tmp_path / "dives", dives / "auv1" / "dive0", 8), tmp_path / "out"
    (place / "auv0" / "no.mcap").write_text("no bag")
    killed: list[int] = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True) as cluster,
        distributed.Client(cluster, set_as_default=False) as watcher,
    ):

        def kill(share: float) -> None:
            if len(killed) < 2 and share > 0.25 * (1 + len(killed)):
                pids = watcher.run(os.getpid)
                if pids:
                    killed.append(next(iter(pids.values())))
                    os.kill(killed[-1], signal.SIGKILL)

        workers = Workers(dask=cluster.scheduler_address)
        result = running.run_fleet([str(place)], out, dc.Parameters(), running.Given(), workers, None, kill)
    assert len(killed) == 2 and result.calibrated == 9
    rows = table(out)
    assert rows.recording.nunique() == 9 and not rows.duplicated(["recording", "parameter"]).any()
    assert rows.error.notna().sum() == 1


@pytest.mark.slow
def test_four_times_the_recordings_take_no_more_memory(dives, tmp_path):
    """Neither here nor in a worker, of which two have four each: what one keeps shows in its own largest."""
    script = (
        "import resource, json, sys; from dvl_calib_ros.cli.main import main; "
        "code = main(['fleet', *sys.argv[1:], '--jobs', '2']); u = [resource.getrusage(who) for who in "
        "(resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]; print(json.dumps([code, u[0].ru_maxrss, u[1].ru_maxrss]))"
    )
    largest = {}
    for name, count in (("few", 2), ("many", 8)):
        place = copies(tmp_path / f"dives_{name}", dives / "auv1" / "dive0", count)
        done = subprocess.run(
            [sys.executable, "-c", script, str(place), "--out", str(tmp_path / name)],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        code, *largest[name] = json.loads(done.stdout.splitlines()[-1])
        assert code == 0
    assert table(tmp_path / "many").recording.nunique() == 8
    for few, many in zip(largest["few"], largest["many"], strict=True):
        assert many < 1.08 * few
