"""Atomic replacement of files: a reader sees the old or the new file, never a part."""

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

# Longest wait for another writer in the same folder. After it the file is written, but old backups are not tidied.
PATIENCE_S = 5.0
_PREFIX = ".dvl_calib."
_TEMPORARY, _STRANDED = ".tmp", ".bak"
# Longest name of a file, bytes: a file system holds 255, and backups are named `.bak` to `.bak.9999`.
LONGEST_NAME = 246
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

Keep = Callable[[Sequence[Path]], Sequence[Path]]
"""Select the previous files that are kept as backups; newest first, in and out."""


def newest_only(before: Sequence[Path]) -> Sequence[Path]:
    """Keep only the last file, as ``.bak``."""
    return before[:1]


def save_text(path: Path, text: str) -> None:
    """Write a text atomically, as `save_bytes`."""
    save_bytes(path, text.encode())


def save_bytes(path: Path, content: bytes, keep: Keep = newest_only) -> None:
    """Write a file atomically and keep the previous one as ``.bak``.

    An own stream of this process, such as /dev/stdout, is written to directly.

    Parameters
    ----------
    path: Destination. A link stays a link; the file that it points to is replaced.
    content: The whole file.
    keep: Selects the previous files to keep as ``.bak``, ``.bak.2``, ...; by default the last one.

    Raises
    ------
    InputError: If it cannot be written; the old file is then unchanged and no temporary file remains.

    """
    save_all({path: content}, keep)


def save_all(contents: Mapping[Path, bytes], keep: Keep = newest_only) -> None:
    """Write several files as `save_bytes`. If one cannot be written, none is changed."""
    path = Path()
    try:
        with ExitStack() as stack:
            saves: dict[Path, _Save] = {}
            alone: dict[Path, bool] = {}
            # everything that needs disk space happens before the first replacement
            for path, content in contents.items():
                stream = own_stream(path)
                if stream is not None:
                    _write_stream(stream, content)
                    continue
                target = _target(path)
                if target.parent not in alone:
                    alone[target.parent] = stack.enter_context(_locked(target.parent))
                saves[path] = stack.enter_context(_prepared_save(target, content))
            try:
                for path in saves:  # the error message names this path
                    os.replace(saves[path].temporary, saves[path].target)
            except BaseException:
                for save in saves.values():
                    save.undo()
                raise
            for save in saves.values():
                _tidy(save, keep, alone[save.target.parent])
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        full = isinstance(error, OSError) and error.errno in NO_SPACE
        remedy = "free some space, or name a file on another disk" if full else "name another place"
        raise InputError(f"{path}: could not be written ({_error_text(error)}); {remedy}") from error


def check_writable(path: Path) -> None:
    """Raise InputError if a file cannot be written to this path."""
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
        if "\0" in str(path):
            raise InputError(f"{path}: is no file name ({_error_text(error)}); name another file") from error
        folder = Path(os.path.realpath(path)).parent
        raise InputError(
            f"{path}: the folder {folder} is not writable ({_error_text(error)}); name another folder"
        ) from error


def check_folder_writable(path: Path) -> None:
    """Raise InputError if a folder and its missing parents cannot be created at this path."""
    above = path.parent
    try:
        while not above.exists() and above != above.parent:
            above = above.parent
        with tempfile.TemporaryFile(dir=above):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the folder {above} is not writable ({_error_text(error)}); name another") from error


def backup_of(path: Path) -> Path:
    """Return the path of the backup that `save_bytes` makes; for a link, next to its target."""
    target = Path(os.path.realpath(path))
    return target.with_name(f"{target.name}.bak")


def backups_of(path: Path) -> list[Path]:
    """Return all existing backups of a file and the next one that `save_bytes` will make."""
    target = Path(os.path.realpath(path))
    with suppress(OSError):
        return sorted({backup_of(target), *_backups(target)})
    return [backup_of(target)]


def own_stream(path: Path) -> int | None:
    """Return the descriptor of this process that a path names (/dev/fd/3), -1 for /dev/null, else None."""
    target = os.path.abspath(path)
    for _ in range(40):  # the kernel follows at most 40 links
        folder, name = os.path.split(target)
        folder = os.path.realpath(folder)
        if re.fullmatch(rf"/proc/{os.getpid()}(/task/\d+)?/fd", folder) and name.isdigit():
            return int(name)
        target = os.path.join(folder, name)
        if not os.path.islink(target):
            break
        target = os.path.join(folder, os.readlink(target))
    return -1 if target == os.devnull else None


def _error_text(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _write_stream(handle: int, content: bytes) -> None:
    """Write to a standard stream after its earlier output."""
    if handle < 0:
        return
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()  # keeps the order of earlier output
    _write(handle, content)


def _target(path: Path) -> Path:
    """Resolve links to the file to replace. Raises InputError for a folder, a device, a long name or a foreign link."""
    if path.is_symlink() and path.lstat().st_uid not in (0, os.geteuid()):
        raise InputError(f"{path}: is a link that another user has made; name another file")
    target = Path(os.path.realpath(path))
    with suppress(FileNotFoundError, NotADirectoryError):
        mode = target.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{path}: is a folder; name a file in it")
        if not stat.S_ISREG(mode):
            raise InputError(f"{path}: is a device, a pipe or a socket, which a file would replace; name a file")
    if len(os.fsencode(target.name)) > LONGEST_NAME:
        raise InputError(f"{path}: longer than {LONGEST_NAME} bytes, which leaves no room for .bak; name another")
    return target


class _Save(NamedTuple):
    """A file to replace, its temporary replacement, and a second name of the previous file, if any."""

    target: Path
    temporary: str
    before: Path | None

    @property
    def is_done(self) -> bool:
        return not os.path.exists(self.temporary)

    def undo(self) -> None:
        """Restore the previous file."""
        with suppress(OSError):
            if self.is_done and self.before is None:
                os.unlink(self.target)
            elif self.is_done and self.before is not None:
                os.replace(self.before, self.target)


@contextmanager
def _prepared_save(target: Path, content: bytes) -> Iterator[_Save]:
    """Prepare a save: everything except the final rename.

    If the process is killed after the rename, the previous file remains under a hidden name, where the next save finds
    it.
    """
    with _temporary_file(target, content) as temporary:
        save = _Save(target, temporary, _second_name(target, temporary) if target.exists() else None)
        try:
            yield save
        except BaseException:
            if save.before is not None and not save.is_done:
                os.unlink(save.before)
            raise


def _tidy(save: _Save, keep: Keep, is_alone: bool) -> None:
    """Name the backups and remove leftovers, after the rename."""
    with suppress(OSError):
        _rotate(save.target, save.before, keep, is_alone)
    with suppress(OSError):
        if is_alone:
            _remove_leftovers(save.target.parent)
    with suppress(OSError):  # not every file system can sync a folder
        _sync(save.target.parent)


@contextmanager
def _temporary_file(target: Path, content: bytes) -> Iterator[str]:
    """Write a hidden temporary file next to `target`, synced to disk; remove it at the end."""
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=_PREFIX, suffix=_TEMPORARY)
    try:
        with suppress(OSError):  # tells other writers that this one is alive
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
    remaining = memoryview(content)
    while remaining:
        remaining = remaining[os.write(handle, remaining) :]


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder. Yield whether the lock was obtained."""
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        yield _lock(handle, PATIENCE_S)
    finally:
        with suppress(OSError):
            os.close(handle)


def _lock(handle: int, patience_s: float) -> bool:
    """Lock an open folder, waiting at most `patience_s`. Return whether that succeeded."""
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
    """Return a hidden second name for the previous file of a target, by a hard link or else a copy.

    If the process is killed, the next save of the target finds the file by that name (`_stranded_prefix`).
    """
    name = target.with_name(f"{_stranded_prefix(target)}{secrets.token_hex(4)}{_STRANDED}")
    try:
        os.link(target, name)
    except OSError:  # a file system without hard links
        copy = f"{temporary[: -len(_TEMPORARY)]}.copy{_TEMPORARY}"
        try:
            shutil.copy2(target, copy)
            _sync(Path(copy))
            os.replace(copy, name)  # atomic
        except BaseException:
            with suppress(OSError):
                os.unlink(copy)
            raise
    return name


def _stranded_prefix(target: Path) -> str:
    """Return how the hidden names begin of a target's previous files that killed saves left behind."""
    return f"{_PREFIX}{zlib.crc32(os.fsencode(target.name)):08x}."


def _rotate(target: Path, before: Path | None, keep: Keep, is_alone: bool) -> None:
    """Rename the previous file, and files left by killed saves, to their backup names."""
    stranded = [] if before is None else [before]
    if is_alone:
        found = target.parent.glob(f"{_stranded_prefix(target)}*{_STRANDED}")
        stranded += sorted((backup for backup in found if backup != before), key=_modified_ns, reverse=True)
    if not stranded:
        return
    inodes = [path.stat().st_ino for path in [*stranded, target]]
    for path in [path for i, path in enumerate(stranded) if inodes[i] in inodes[:i] + inodes[-1:]]:
        os.unlink(path)  # left by a save that was killed before its rename
        stranded.remove(path)
    existing = _backups(target) if keep is not newest_only else [path for path in [backup_of(target)] if path.exists()]
    kept = keep([*stranded, *existing])
    for path in {*stranded, *existing} - {*kept}:
        with suppress(FileNotFoundError):
            os.unlink(path)
    names = map(backup_of(target).with_name, _backup_names(target, len(kept)))
    moves = [(path, name) for path, name in zip(kept, names, strict=True) if path != name]
    # move each file only to a free name: upward moves from the last on, then downward moves
    upward = [(path, name) for path, name in moves if path in stranded or _number(path) < _number(name)]
    for path, name in [*reversed(upward), *(move for move in moves if move not in upward)]:
        os.replace(path, name)
        with suppress(FileNotFoundError):  # os.replace between two links of one file does nothing
            os.unlink(path)


def _modified_ns(path: Path) -> int:
    return path.stat().st_mtime_ns


def _backup_names(target: Path, count: int) -> list[str]:
    return [f"{target.name}.bak" if number == 1 else f"{target.name}.bak.{number}" for number in range(1, count + 1)]


def _backups(target: Path) -> list[Path]:
    """Return all backups of a file, newest first."""
    pattern = re.compile(re.escape(target.name) + r"\.bak(\.[1-9]\d{0,3})?")
    return sorted((path for path in target.parent.iterdir() if pattern.fullmatch(path.name)), key=_number)


def _number(backup: Path) -> int:
    last = backup.name.rpartition(".")[2]
    return int(last) if last.isdigit() else 1


def _remove_leftovers(folder: Path) -> None:
    """Remove temporary files of killed writers. Living writers hold a lock on theirs."""
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
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
