"""Another model in a running monitor: an estimator that catches up, and the model on disk.

Without losing a row: the running estimator goes on until the other one, which has first taken
the rows of its buffer in small slices, has caught up.
"""

import json
import math
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.live.estimator import LiveEstimator
from eha_monitor.live.ingest import Columns
from eha_monitor.output import write_json
from eha_monitor.settings.load import settings_from_tree
from eha_monitor.settings.monitor import Settings

SCHEMA = "eha_monitor/adopted/1"
MODEL = ("rig", "effects", "command_hold")  # sections and keys of the config that are the model


class Candidate:
    """An estimator that is to take the place of the running one.

    Parameters
    ----------
    estimator : with the other settings; knows no row yet.
    past : rows to begin with, (times in s, columns), in order.
    """

    def __init__(self, estimator: LiveEstimator, past: Iterable[tuple[np.ndarray, Columns]]):
        self.estimator = estimator
        self._waiting = deque(past)
        self.first_s = self._waiting[0][0][0] if self._waiting else math.nan

    def push(self, times: np.ndarray, columns: Columns) -> None:
        """Take rows as :meth:`LiveEstimator.push_rows` does; they wait for their slice."""
        if not self._waiting and math.isnan(self.first_s) and len(times):
            self.first_s = float(times[0])
        self._waiting.append((times, columns))

    def advance(self, seconds: float) -> bool:
        """Work for at most about ``seconds``; True once all rows have been taken."""
        until = time.monotonic() + seconds
        while self._waiting and time.monotonic() < until:
            self.estimator.push_rows(*self._waiting.popleft())
        return not self._waiting

    def withdraw(self, channel: str, since_s: float) -> None:
        """Take back what a channel gave from ``since_s`` on, also in rows that wait."""
        for place, (times, columns) in enumerate(self._waiting):
            if channel in columns and len(times) and times[-1] >= since_s:
                kept = np.where(times < since_s, columns[channel], math.nan)
                self._waiting[place] = times, {**columns, channel: kept}
        if not math.isnan(self.first_s):
            self.estimator.withdraw(channel, since_s)

    def reset(self, reason: str) -> None:
        """Begin anew with the rows that come."""
        self._waiting.clear()
        self.first_s = math.nan
        self.estimator.reset(reason)


def model_of(settings: Settings) -> dict:
    """Return what of a config is the model, as JSON's plain types."""
    return settings.model_dump(mode="json", include=set(MODEL))


@dataclass(frozen=True)
class Adopted:
    """A model that was put in place of that of the config.

    Attributes
    ----------
    who : ``service`` or ``automatic``.
    time_utc : when, ISO 8601.
    words : the effects, for people.
    report : where its diagnosis is described.
    base : the model of the config then; for another one it is not valid.
    model : as :func:`model_of`.
    """

    who: str
    time_utc: str
    words: str
    report: str
    base: dict
    model: dict

    def applied(self, settings: Settings) -> Settings:
        """Return settings with this model in place of theirs."""
        made = settings_from_tree(self.model, "the adopted model")
        return settings.model_copy(update={key: getattr(made, key) for key in MODEL})

    def save(self, path: Path) -> None:
        """Write it, for the next start.

        Raises
        ------
        InputError
            If the place cannot be written.
        """
        write_json(path, {"schema": SCHEMA} | asdict(self))


def adopted_before(path: Path, settings: Settings) -> Adopted | None:
    """Return the model that an earlier run adopted for this config, None where none did.

    Raises
    ------
    InputError
        One line, if the file is none, or its model was adopted for another config.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        if tree.pop("schema", None) != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA}")
        found = Adopted(**tree)
        found.applied(settings)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, AttributeError, InputError) as problem:
        raise InputError(f"{path}: expected an adopted model: {problem}") from problem
    if found.base != model_of(settings):
        raise InputError(f"{path}: adopted on {found.time_utc} for another rig or other effects "
                         "than the config now has: left out")
    return found
