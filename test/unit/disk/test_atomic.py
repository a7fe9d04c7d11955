"""Whatever happens while a file is written: it is the old or the new one, whole, and nothing else is left."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from dvl_calib_ros.disk import atomic
from dvl_calib_ros.disk.atomic import check_writable, save_bytes, save_text
from dvl_calib_ros.errors import InputError


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "link.yaml").symlink_to(tmp_path / "data" / "result.yaml")
    save_text(tmp_path / "link.yaml", "text")
    assert (tmp_path / "link.yaml").is_symlink()
    assert (tmp_path / "data" / "result.yaml").read_text() == "text"


def test_a_file_system_that_cannot_sync_folders_or_link_files_is_no_failure(tmp_path, monkeypatch):
    sync = os.fsync

    def only_files(handle):
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(errno.EINVAL, "Invalid argument")
        sync(handle)

    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "fsync", only_files)
    monkeypatch.setattr(os, "link", no_links)
    save_text(tmp_path / "result.yaml", "one")
    save_text(tmp_path / "result.yaml", "two")
    assert (tmp_path / "result.yaml").read_text() == "two"
    assert (tmp_path / "result.yaml.bak").read_text() == "one"


def test_an_interrupted_save_leaves_no_temporary_file(tmp_path, monkeypatch):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_text(tmp_path / "result.yaml", "text")
    assert os.listdir(tmp_path) == []


def test_where_no_file_can_be_is_said_before_anything_is_collected(tmp_path):
    (tmp_path / "file").touch()
    for path, expected in (
        (tmp_path, "is a folder; name a file in it"),
        (tmp_path / "missing" / "r.yaml", "does not exist; create it"),
        (tmp_path / "file" / "r.yaml", "does not exist; create it"),
    ):
        with pytest.raises(InputError, match=expected):
            check_writable(path)
        with pytest.raises(InputError, match="is a folder" if path == tmp_path else "could not be written"):
            save_text(path, "text")
    check_writable(tmp_path / "new.yaml")
    assert os.listdir(tmp_path) == ["file"]


# ---------------------------------------------------------------------- every call of a save

CALLS = ["open", "write", "fsync", "fchmod", "link", "replace", "unlink", "close", "stat", "scandir", "listdir"]
CALLS += ["flock", "mkstemp", "urandom", "sendfile", "chmod", "utime"]  # the last three: a copy, without links
PLACES = {name: os for name in CALLS} | {"flock": atomic.fcntl, "mkstemp": tempfile}


@contextmanager
def at_call(number: int, happens: Callable[[], None]) -> Iterator[list[str]]:
    """Let something happen at the so-many-th call that a save makes; the calls that were made."""
    made: list[str] = []

    def instead(name: str, real: Callable) -> Callable:
        def call(*arguments, **options):
            made.append(name)
            if len(made) == number:
                happens()
            return real(*arguments, **options)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(PLACES[name], name, instead(name, getattr(PLACES[name], name)))
        yield made


def both(before):
    return before[:2]


def generations(folder: Path) -> Path:
    """A file and its two backups in a new folder."""
    folder.mkdir()
    path = folder / "result.yaml"
    for text in ("one", "two", "three"):
        save_bytes(path, text.encode(), both)
    return path


def hidden(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if name.startswith(".")]


def no_links(*_, **__):
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


def number_of_calls(folder: Path, has_links: bool = True) -> int:
    path = generations(folder)
    with at_call(0, lambda: None) as made:
        save_bytes(path, b"four", both)
    assert made.count("replace") == 4 - has_links and made.count("fsync") == 3 - has_links
    return len(made)


@pytest.mark.parametrize(
    ("code", "has_links"), [(errno.EIO, True), (errno.ENOSPC, True), (errno.EACCES, True), (errno.EIO, False)]
)
def test_whichever_call_of_a_save_fails_the_file_is_the_old_or_the_new_one_and_nothing_is_lost(
    tmp_path, monkeypatch, code, has_links
):
    monkeypatch.setattr(atomic, "PATIENCE_S", 0.01)  # a lock whose file could not be closed stays
    if not has_links:
        monkeypatch.setattr(os, "link", no_links)
    count = number_of_calls(tmp_path / "count", has_links)

    def fail():
        raise OSError(code, os.strerror(code))

    refused = 0
    for number in range(1, count + 1):
        path = generations(tmp_path / str(number))
        with at_call(number, fail) as made:
            try:
                save_bytes(path, b"four", both)
                saved = True
            except InputError as error:
                assert os.strerror(code) in str(error)
                assert ("free some space" in str(error)) == (code == errno.ENOSPC)
                saved = False
        refused += not saved
        assert path.read_text() == ("four" if saved else "three"), made[number - 1]
        if not saved and made[number - 1] != "unlink":  # what could not be unlinked is taken by the next save
            assert hidden(path.parent) == [] and path.with_name("result.yaml.bak").read_text() == "two"
        assert_next_save_tidies(path, ["three", "two"] if saved else ["three"])
    assert 5 <= refused < count


def assert_next_save_tidies(path: Path, still_there: list[str]) -> None:
    save_bytes(path, b"five", lambda before: before[:4])
    assert path.read_text() == "five" and hidden(path.parent) == []
    backups = [path.with_name(name).read_text() for name in sorted(os.listdir(path.parent)) if name != path.name]
    assert [text for text in backups if text in still_there] == still_there, backups
    assert len(backups) == len(set(backups))


def test_at_whichever_call_a_save_is_killed_the_file_is_whole_and_the_next_save_loses_nothing(tmp_path):
    count = number_of_calls(tmp_path / "count")
    seen = set()
    for number in range(1, count + 1):
        path = generations(tmp_path / str(number))
        child = os.fork()
        if child == 0:
            with at_call(number, lambda: os.kill(os.getpid(), signal.SIGKILL)):
                save_bytes(path, b"four", both)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == signal.SIGKILL
        seen.add(path.read_text())
        assert_next_save_tidies(path, ["four", "three"] if path.read_text() == "four" else ["three", "two"])
    assert seen == {"three", "four"}


# ---------------------------------------------------------------------- several writers


def test_three_writers_on_one_file_leave_a_whole_file_its_backups_and_no_litter(tmp_path):
    path = tmp_path / "result.yaml"
    children = []
    for writer in "abc":
        child = os.fork()
        if child == 0:
            with suppress(BaseException):
                for _ in range(60):
                    save_bytes(path, writer.encode() * 5000, both)
                os._exit(0)
            os._exit(1)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0, 0]
    assert sorted(os.listdir(tmp_path)) == ["result.yaml", "result.yaml.bak", "result.yaml.bak.2"]
    for name in os.listdir(tmp_path):
        text = (tmp_path / name).read_text()
        assert len(text) == 5000 and len(set(text)) == 1


def test_what_a_killed_writer_left_goes_with_the_next_save_and_what_a_living_one_writes_stays(tmp_path):
    dead = tmp_path / ".dvl_calib.dead.tmp"
    dead.write_text("torn")
    with atomic._temporary_file(tmp_path / "other.yaml", b"alive") as living:
        save_text(tmp_path / "result.yaml", "text")
        assert not dead.exists() and Path(living).read_text() == "alive"
    assert os.listdir(tmp_path) == ["result.yaml"]


def test_a_writer_that_stands_still_holds_up_no_other_for_long(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "PATIENCE_S", 0.05)
    with atomic._locked(tmp_path) as is_alone:
        assert is_alone
        save_text(tmp_path / "result.yaml", "one")
        save_text(tmp_path / "result.yaml", "two")
    assert (tmp_path / "result.yaml").read_text() == "two"
    assert (tmp_path / "result.yaml.bak").read_text() == "one"


# ---------------------------------------------------------------------- what is no ordinary file


@pytest.fixture(params=["pipe", "socket", "device"])
def special(request, tmp_path):
    path = tmp_path / "special"
    if request.param == "pipe":
        os.mkfifo(path)
    elif request.param == "socket":
        server = socket.socket(socket.AF_UNIX)
        server.bind(str(path))
    else:
        try:
            os.mknod(path, 0o020600, os.makedev(1, 7))  # /dev/full
        except OSError:
            pytest.skip("only root can make a device")
    return path


def test_a_device_a_pipe_or_a_socket_is_never_replaced_by_a_file(special, tmp_path):
    (tmp_path / "link").symlink_to(special)
    kind = special.lstat().st_mode
    for path in (special, tmp_path / "link"):
        for attempt in (lambda path=path: save_text(path, "text"), lambda path=path: check_writable(path)):
            with pytest.raises(InputError, match="is a device, a pipe or a socket"):
                attempt()
    assert special.lstat().st_mode == kind and sorted(os.listdir(tmp_path)) == ["link", "special"]


def test_what_is_written_to_a_stream_of_the_process_itself_goes_there_after_what_was_printed(tmp_path):
    script = (
        "from pathlib import Path; from dvl_calib_ros.disk.atomic import check_writable, save_text\n"
        "print('before')\n"
        "for name in ('/dev/stdout', '/proc/self/fd/1', '/dev/null', 'link'):\n"
        "    check_writable(Path(name)); save_text(Path(name), f'{name}\\n')\n"
    )
    (tmp_path / "link").symlink_to("/dev/stdout")
    (tmp_path / "out").write_text("old ")
    with (tmp_path / "out").open("a") as out:
        subprocess.run([sys.executable, "-c", script], stdout=out, check=True, cwd=tmp_path, env=environment())
    assert (tmp_path / "out").read_text() == "old before\n/dev/stdout\n/proc/self/fd/1\nlink\n"
    assert sorted(os.listdir(tmp_path)) == ["link", "out"] and not os.path.isfile("/dev/null")


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


def test_a_file_keeps_its_permissions(tmp_path):
    path = tmp_path / "robot.urdf"
    save_text(path, "one")
    assert path.stat().st_mode & 0o777 == 0o644
    path.chmod(0o600)
    save_text(path, "two")
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "x" * 253, "loop", "file/below"])
def test_a_name_that_no_file_can_have_is_refused_in_one_line(tmp_path, name):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").touch()
    for attempt in (save_text, lambda path, _: check_writable(path)):
        with pytest.raises(InputError) as caught:
            attempt(tmp_path / name, "text")
        assert "\n" not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ["file", "loop"]
