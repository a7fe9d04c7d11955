"""The error that users see."""


class InputError(Exception):
    """A file, topic or value that cannot be used; the message names it and says what to do about it."""
