"""The live estimator as it was some moments ago.

That a sensor has frozen shows only once it has been still for a while.  What the filters made of
it meanwhile is undone: they go back to the last state before, and take the rows anew without the
channel.  To wait for the parameters to come back instead takes longer than a window of the
model's test, and what the windows hold of the fault keeps a mismatch standing.
"""

import copy
from collections import deque
from typing import Any

EVERY_S = 0.5
KEPT = 12
# What the filters know; rows, events and settings are not part of it.
STATE = ("_one", "_two", "_handover", "_damping", "_piece", "_stale_piece", "_changes", "_tester",
         "_clean", "_noise_at", "_noise", "_quantum", "_r", "_announced", "_taken")


class Checkpoints:
    """States of an estimator, the last some seconds."""

    def __init__(self):
        self._kept: deque[tuple[int, dict[str, Any]]] = deque(maxlen=KEPT)

    def clear(self) -> None:
        """Forget all, e.g. when rows are counted anew."""
        self._kept.clear()

    def keep(self, estimator: Any, taken: int, dt: float) -> None:
        """Keep the state after ``taken`` rows, unless the last one is recent."""
        if self._kept and taken - self._kept[-1][0] < EVERY_S / dt:
            return
        self._kept.append((taken, _copy(estimator, {name: getattr(estimator, name)
                                                    for name in STATE})))

    def back(self, estimator: Any, row: int) -> bool:
        """Put an estimator back to its last state before ``row``; False if none is kept."""
        while self._kept and self._kept[-1][0] > row:
            self._kept.pop()
        if not self._kept:
            return False
        for name, value in _copy(estimator, self._kept[-1][1]).items():
            setattr(estimator, name, value)
        return True


def _copy(estimator: Any, state: dict[str, Any]) -> dict[str, Any]:
    # Never changed in place.
    shared = (estimator.settings, estimator._model, estimator._handover.settings,
              estimator._tester.settings)
    return copy.deepcopy(state, {id(each): each for each in shared})
