"""The error that users see, and what makes texts from outside fit to be seen."""

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(Exception):
    """A file, topic or value that cannot be used; the message names it and says what to do about it."""


@contextmanager
def needing_ros(what: str) -> Iterator[None]:
    """Say of imports within that fail what is to be installed. what: who needs it. Raises InputError."""
    try:
        yield
    except ImportError as error:
        raise InputError(
            f"{what} needs ROS 2 ({error}); source /opt/ros/jazzy/setup.bash, or pip install 'dvl_calib_ros[ros]'"
        ) from error


def printable(text: str) -> str:
    """Text for a terminal: control characters, which names in a bag may hold, shown as escapes."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def as_cell(value: object) -> object:
    """Return a value for a spreadsheet's cell: a text that would be run as a formula is quoted, all else as it is."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@")) else value
