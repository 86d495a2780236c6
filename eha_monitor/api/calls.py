"""What every function of the Python interface does about its call: order, errors, progress.

A calculation uses all cores as it is, so that of several threads one calculates at a time.
"""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from eha_monitor.errors import InputError, refused

Progress = bool | Callable[[str, float], None]
READING = 0.03  # of a diagnosis' progress is the reading
_WIDTH = 78  # of a line of progress
_one = threading.RLock()


@contextmanager
def calling() -> Iterator[None]:
    """Calculate, and no other thread meanwhile; what the system refuses is bad input.

    Raises
    ------
    InputError
        In place of an OSError, with the same line that the command prints.
    """
    with _one:
        try:
            yield
        except OSError as problem:
            raise InputError(refused(problem)) from problem


def reporter(progress: Progress) -> Callable[[str, float], None]:
    """Return what a calculation reports its progress to: (text, share from 0 to 1).

    Parameters
    ----------
    progress : False: nobody; True: a line on the standard error; or a function of one's own.
    """
    if callable(progress):
        return progress
    return _line if progress else _nobody


def _nobody(text: str, share: float) -> None:
    pass


def _line(text: str, share: float) -> None:
    """Write over the line before, as terminals and notebooks show it."""
    line = f"{100 * min(max(share, 0.0), 1.0):3.0f} % {text}"[:_WIDTH]
    end = "\n" if share >= 1.0 else ""
    print(f"\r{line:{_WIDTH}}", end=end, file=sys.stderr, flush=True)


def _after_fork() -> None:
    """Forget what a forked process has not got: the other threads, and what they hold."""
    global _one
    _one = threading.RLock()
    fit = sys.modules.get("eha_monitor.mismatch.likelihood.fit")
    if fit is not None:
        fit.workers.cache_clear()


os.register_at_fork(after_in_child=_after_fork)
