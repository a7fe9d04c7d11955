"""The error that users see, and what makes texts from outside fit to be seen."""


class InputError(Exception):
    """A file, topic or value that cannot be used; the message names it and says what to do about it."""


def printable(text: str) -> str:
    """Text for a terminal: control characters, which names in a bag may hold, shown as escapes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
