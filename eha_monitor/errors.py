"""The one exception that a user is meant to see."""

import re

# Names out of a broken file may hold anything: line breaks of every alphabet, terminal controls.
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


def one_line(text: str) -> str:
    """Return a text without line breaks and terminal controls."""
    return _CONTROLS.sub(" ", text)


class InputError(Exception):
    """Bad input: the message is one line that names what is wrong and what was expected.

    The command line prints it without a traceback and exits with status 2.
    """

    def __init__(self, message: str):
        super().__init__(one_line(message))
