"""Files that are always the old or the new one, whole, whatever happens while they are written."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from ..errors import InputError

# How long one writer waits for another in the same folder, s; after that it goes on, and leaves the tidying to others.
PATIENCE_S = 5.0
_PREFIX = ".dvl_calib."
_TEMPORARY, _STRANDED = ".tmp", ".bak"
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

Keep = Callable[[Sequence[Path]], Sequence[Path]]
"""Which of the files before, newest first, are kept as backups, in the same order."""


def newest_only(before: Sequence[Path]) -> Sequence[Path]:
    """Keep the file before, as ``.bak``."""
    return before[:1]


def save_text(path: Path, text: str) -> None:
    """Write a text as `save_bytes` does."""
    save_bytes(path, text.encode())


def save_bytes(path: Path, content: bytes, keep: Keep = newest_only) -> None:
    """Write a file so that it is always the old or the new one, whole; the old one is kept as ``.bak``.

    One of this process's own streams, such as /dev/stdout, is written to instead.

    Parameters
    ----------
    path: Where to; a link stays a link, and what it leads to is replaced.
    content: All of the file.
    keep: Which of the files before are kept; by default the last. If several, they are ``.bak``, ``.bak.2``, ...

    Raises
    ------
    InputError: If it cannot be written; then the old file is untouched and no other is left.

    """
    save_all({path: content}, keep)


def save_all(contents: Mapping[Path, bytes], keep: Keep = newest_only) -> None:
    """Write files that belong together as `save_bytes` does. If one of them cannot be written, all are as before."""
    path = Path()
    try:
        with ExitStack() as stack:
            saves: dict[Path, _Save] = {}
            alone: dict[Path, bool] = {}
            for path, content in contents.items():  # all that takes space, before anything is replaced
                stream = own_stream(path)
                if stream is not None:
                    _write_stream(stream, content)
                    continue
                target = _target(path)
                if target.parent not in alone:
                    alone[target.parent] = stack.enter_context(_locked(target.parent))
                saves[path] = stack.enter_context(_prepared(target, content))
            try:
                for path in saves:  # named if it fails
                    os.replace(saves[path].temporary, saves[path].target)
            except BaseException:
                for save in saves.values():
                    save.undo()
                raise
            for save in saves.values():
                _tidy(save, keep, alone[save.target.parent])
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        full = isinstance(error, OSError) and error.errno in NO_SPACE
        remedy = "free some space, or name a file on another disk" if full else "name another place"
        raise InputError(f"{path}: could not be written ({_why(error)}); {remedy}") from error


def check_writable(path: Path) -> None:
    """Raise InputError if a file could not be written there, before work is done for it."""
    try:
        if own_stream(path) is not None:
            return
        target = _target(path)
        folder = target.parent
        if not folder.is_dir():
            raise InputError(f"{path}: the folder {folder} does not exist; create it or name another")
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        where = (
            f"the folder {Path(os.path.realpath(path)).parent} is not writable" if "\0" not in str(path) else "no name"
        )
        raise InputError(f"{path}: {where} ({_why(error)}); name another") from error


def check_folder_writable(path: Path) -> None:
    """Raise InputError if a folder could not be made there, with those that it lies in, before work is done for it."""
    above = path.parent
    try:
        while not above.exists() and above != above.parent:
            above = above.parent
        with tempfile.TemporaryFile(dir=above):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the folder {above} is not writable ({_why(error)}); name another") from error


def backup_of(path: Path) -> Path:
    """Where the file is that `save_bytes` last replaced; beside what a link points to."""
    target = Path(os.path.realpath(path))
    return target.with_name(f"{target.name}.bak")


def backups_of(path: Path) -> list[Path]:
    """Every backup that there is of a file, and the one that the next `save_bytes` will make."""
    target = Path(os.path.realpath(path))
    with suppress(OSError):
        return sorted({backup_of(target), *_backups(target)})
    return [backup_of(target)]


def own_stream(path: Path) -> int | None:
    """The file descriptor of this process that a path names (/dev/stdout, /dev/fd/3), None if it names a file.

    /dev/null is taken for one, too: -1.
    """
    here = os.path.abspath(path)
    for _ in range(40):  # links, as many as the kernel follows
        folder, name = os.path.split(here)
        folder = os.path.realpath(folder)
        if re.fullmatch(rf"/proc/{os.getpid()}(/task/\d+)?/fd", folder) and name.isdigit():
            return int(name)
        here = os.path.join(folder, name)
        if not os.path.islink(here):
            break
        here = os.path.join(folder, os.readlink(here))
    return -1 if here == os.devnull else None


def _why(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _write_stream(handle: int, content: bytes) -> None:
    if handle < 0:
        return
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()  # what was printed before comes before
    _write(handle, content)


def _target(path: Path) -> Path:
    """Where a file is written: a link stays a link. Raises InputError for what must not be replaced by a file."""
    if path.is_symlink() and path.lstat().st_uid not in (0, os.geteuid()):
        raise InputError(f"{path}: is a link that another user has made; name another file")
    target = Path(os.path.realpath(path))
    with suppress(FileNotFoundError, NotADirectoryError):
        mode = target.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{path}: is a folder; name a file in it, such as {path / 'calibration.yaml'}")
        if not stat.S_ISREG(mode):
            raise InputError(f"{path}: is a device, a pipe or a socket, which a file would replace; name a file")
    return target


# ---------------------------------------------------------------------- the order of a save


class _Save(NamedTuple):
    """A file to be replaced, the hidden one that replaces it, and another name of the one before, if there is one."""

    target: Path
    temporary: str
    before: Path | None

    @property
    def is_done(self) -> bool:
        return not os.path.exists(self.temporary)

    def undo(self) -> None:
        """Put the file before in its place again."""
        with suppress(OSError):
            if self.is_done and self.before is None:
                os.unlink(self.target)
            elif self.is_done and self.before is not None:
                os.replace(self.before, self.target)


@contextmanager
def _prepared(target: Path, content: bytes) -> Iterator[_Save]:
    """All of a save but the renaming.

    Until that every failure leaves the old file alone. Killed after it, the file before is stranded under a hidden
    name, from which the next save takes it.
    """
    with _written_beside(target, content) as temporary:
        save = _Save(target, temporary, _second_name(target, temporary) if target.exists() else None)
        try:
            yield save
        except BaseException:
            if save.before is not None and not save.is_done:
                os.unlink(save.before)
            raise


def _tidy(save: _Save, keep: Keep, is_alone: bool) -> None:
    """See to the backups; the new file is there."""
    with suppress(OSError):
        _rotate(save.target, save.before, keep, is_alone)
    with suppress(OSError):
        if is_alone:
            _remove_leftovers(save.target.parent)
    with suppress(OSError):  # not every file system can sync a folder
        _sync(save.target.parent)


@contextmanager
def _written_beside(target: Path, content: bytes) -> Iterator[str]:
    """Name of a hidden file with this content, on the disk; what is left of it in the end is removed."""
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=_PREFIX, suffix=_TEMPORARY)
    try:
        with suppress(OSError):  # tells other savers that its writer lives
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        os.fchmod(handle, stat.S_IMODE(target.stat().st_mode) if target.exists() else 0o644)
        _write(handle, content)
        os.fsync(handle)
        yield temporary
    finally:
        with suppress(OSError):
            os.unlink(temporary)
        with suppress(OSError):
            os.close(handle)


def _write(handle: int, content: bytes) -> None:
    left = memoryview(content)
    while left:
        left = left[os.write(handle, left) :]


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Whether no other process saves in this folder meanwhile. Leaves nothing behind, whatever end it comes to."""
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        yield _lock(handle, PATIENCE_S)
    finally:
        with suppress(OSError):
            os.close(handle)


def _lock(handle: int, patience_s: float) -> bool:
    deadline = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EINTR) or time.monotonic() > deadline:
                return False  # not every file system can lock a folder
        time.sleep(0.01)


def _second_name(target: Path, temporary: str) -> Path:
    """Make the file before known under a hidden name, too, which says whose it is."""
    name = target.with_name(f"{_stranded_prefix(target)}{secrets.token_hex(4)}{_STRANDED}")
    try:
        os.link(target, name)
    except OSError:  # a file system without hard links
        copy = f"{temporary[: -len(_TEMPORARY)]}.copy{_TEMPORARY}"
        try:
            shutil.copy2(target, copy)
            _sync(Path(copy))
            os.replace(copy, name)  # whole, whenever it is seen
        except BaseException:
            with suppress(OSError):
                os.unlink(copy)
            raise
    return name


def _stranded_prefix(target: Path) -> str:
    return f"{_PREFIX}{zlib.crc32(os.fsencode(target.name)):08x}."


def _rotate(target: Path, before: Path | None, keep: Keep, is_alone: bool) -> None:
    """Give the file before, and what a killed save left of those before it, their names as backups."""
    stranded = [] if before is None else [before]
    if is_alone:
        found = target.parent.glob(f"{_stranded_prefix(target)}*{_STRANDED}")
        stranded += sorted((each for each in found if each != before), key=_modified_ns, reverse=True)
    if not stranded:
        return
    inodes = [each.stat().st_ino for each in [*stranded, target]]
    for each in [each for at, each in enumerate(stranded) if inodes[at] in inodes[:at] + inodes[-1:]]:
        os.unlink(each)  # of a save that was killed before its renaming
        stranded.remove(each)
    known = _backups(target) if keep is not newest_only else [each for each in [backup_of(target)] if each.exists()]
    kept = keep([*stranded, *known])
    for each in {*stranded, *known} - {*kept}:
        with suppress(FileNotFoundError):
            os.unlink(each)
    places = dict(zip(kept, map(backup_of(target).with_name, _backup_names(target, len(kept))), strict=True))
    moves = [(each, place) for each, place in places.items() if each != place]
    # where a file goes, none is that has not gone: those that go up from the last on, then those that go down
    up = [move for move in moves if move[0] in stranded or _number(move[0]) < _number(move[1])]
    for each, place in [*reversed(up), *(move for move in moves if move not in up)]:
        os.replace(each, place)
        with suppress(FileNotFoundError):  # two names of one file: renaming one to the other does nothing
            os.unlink(each)


def _modified_ns(path: Path) -> int:
    return path.stat().st_mtime_ns


def _backup_names(target: Path, count: int) -> list[str]:
    return [f"{target.name}.bak" if number == 1 else f"{target.name}.bak.{number}" for number in range(1, count + 1)]


def _backups(target: Path) -> list[Path]:
    """All backups of a file, the newest first."""
    pattern = re.compile(re.escape(target.name) + r"\.bak(\.[1-9]\d{0,3})?")
    return sorted((each for each in target.parent.iterdir() if pattern.fullmatch(each.name)), key=_number)


def _number(backup: Path) -> int:
    last = backup.name.rpartition(".")[2]
    return int(last) if last.isdigit() else 1


def _remove_leftovers(folder: Path) -> None:
    """Remove what writers left that were killed. Those that live hold a lock on theirs."""
    for path in folder.glob(f"{_PREFIX}*{_TEMPORARY}"):
        with suppress(OSError):
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                if os.fstat(handle).st_uid == os.geteuid():
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(path)
            finally:
                os.close(handle)


def _sync(path: Path) -> None:
    """Bring a file or a folder to the disk."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
