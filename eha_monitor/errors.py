"""The one exception that a user is meant to see, and words that several of them have."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

# Names out of a broken file may hold anything: line breaks of every alphabet, terminal controls.
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


def one_line(text: str) -> str:
    """Return a text without line breaks and terminal controls."""
    return _CONTROLS.sub(" ", text)


def installs(extra: str) -> str:
    """Return the words that say how an extra of setup.py comes."""
    return (f"install it, in the checkout, with make setup WITH={extra} or "
            f"pip install '.[{extra}]'")


def refused(problem: OSError) -> str:
    """Return what the system refused, in one line that names the file."""
    return ": ".join(str(part) for part in (problem.filename, problem.strerror or problem) if part)


class InputError(Exception):
    """Bad input: the message is one line that names what is wrong and what was expected.

    The command line prints it without a traceback and exits with status 2.
    """

    def __init__(self, message: str):
        super().__init__(one_line(message))


@contextmanager
def optional(words: str, extra: str) -> Iterator[None]:
    """Say in one line which extra is missing, where an import inside the block fails.

    ``words`` : what needs it, with ``{}`` where the reason stands.
    """
    try:
        yield
    except ImportError as problem:
        if (problem.name or "").startswith("eha_monitor"):
            raise  # a defect of ours is no missing package
        raise InputError(words.format(problem) + installs(extra)) from problem
