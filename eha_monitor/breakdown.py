"""Where numbers leave what floating point can hold: told in one line, or begun anew.

Numbers of a recording may be measurements and still nothing that a model can be fitted to
(pressures of 1e12 Pa, a position that is a serial number).  What follows in the arithmetic is
judged by its results; where it ends in an exception, the boundary of the calculation names the
recording.  Any other exception is a defect and stays one.
"""

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError

# Of these alone a ValueError tells; there is no class of its own for them.
_WORDS = ("math domain error", "must not contain infs or nans", "cannot convert float nan")


def broke_down(problem: BaseException) -> bool:
    """Tell whether an exception says that numbers broke down, and not the program."""
    return isinstance(problem, np.linalg.LinAlgError | ArithmeticError) or (
        isinstance(problem, ValueError) and any(
            words in str(problem).lower() for words in _WORDS))


def place_of(problem: BaseException) -> str:
    """Return the line of this program in which an exception came about, such as fit.py:120."""
    ours = [frame for frame in traceback.extract_tb(problem.__traceback__)
            if Path(frame.filename).is_relative_to(Path(__file__).parent)]
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"


@contextmanager
def computing(*sources: str) -> Iterator[None]:
    """Compute without numpy's warnings; a breakdown of the numbers names the recordings.

    Raises
    ------
    InputError
        In place of an exception that says that the numbers broke down.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except (np.linalg.LinAlgError, ArithmeticError, ValueError) as problem:
        if not broke_down(problem):
            raise
        names = ", ".join(source for source in sources if source) or "recording"
        raise InputError(
            f"{names}: the calculation broke down ({problem}, {place_of(problem)}); expected "
            "matching channels in SI, and the rig's own data in the config"
            ) from problem


def begins_anew(method: Callable) -> Callable:
    """Let a live estimator's method survive a breakdown: it is told and estimated anew.

    The object has ``reset(reason)``; the samples that broke it are forgotten with the rest.
    """
    @wraps(method)
    def guarded(self, *arguments, **named):
        try:
            with np.errstate(all="ignore"):
                return method(self, *arguments, **named)
        except (np.linalg.LinAlgError, ArithmeticError, ValueError) as problem:
            if not broke_down(problem):
                raise
            self.reset(f"the numbers of the channels broke the calculation ({problem})")
    return guarded
