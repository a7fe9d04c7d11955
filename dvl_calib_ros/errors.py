"""The error that users see, and escaping of texts from outside."""

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(Exception):
    """A file, topic or value that cannot be used; the message names it and the remedy."""


@contextmanager
def needing_ros(what: str) -> Iterator[None]:
    """Turn failed ROS imports inside into InputError with the remedy. what: the command or part that needs ROS."""
    try:
        yield
    except ImportError as error:
        raise InputError(
            f"{what} needs ROS 2 ({error}); source /opt/ros/jazzy/setup.bash, or pip install 'dvl_calib_ros[ros]'"
        ) from error


@contextmanager
def needing_page(what: str) -> Iterator[None]:
    """Turn a missing library for pages into InputError. what: the option or file that needs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(f"{what} needs matplotlib and jinja2 ({error}); pip install matplotlib jinja2") from error


def printable(text: str) -> str:
    """Escape control characters in a text for a terminal; names in a bag may have them."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


# what begins a formula in spreadsheets; the wide forms in Excel for East Asian languages
_FORMULA = tuple("=+-@\uff1d\uff0b\uff0d\uff20")


def as_cell(value: object) -> object:
    """Return a value for a spreadsheet cell: text on one line, quoted if it would run as a formula."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text
