"""Which stretch of time the charts show: the last minutes, or one that was chosen."""

import math
from urllib.parse import urlencode

# Choices by their name; None is all that is kept.
CHOICES: dict[str, float | None] = {"1 min": 60.0, "5 min": 300.0, "30 min": 1800.0, "all": None}
FIRST = "5 min"
# A shorter stretch than this is a click and no choice, s.
SHORTEST = 1.0


class Span:
    """The choice of one page.

    Attributes
    ----------
    choice : one of ``CHOICES``; it counts while nothing is zoomed.
    zoom : the stretch that was dragged, time of day, s; None while the charts follow the data.
    """

    def __init__(self):
        self.choice = FIRST
        self.zoom: tuple[float, float] | None = None

    def choose(self, choice: str) -> None:
        """Follow the data again, over the time of a choice."""
        self.choice, self.zoom = choice, None

    def drag(self, first: float, last: float) -> bool:
        """Stay at a stretch; returns whether it is one."""
        if not (math.isfinite(first) and math.isfinite(last)) or last - first < SHORTEST:
            return False
        self.zoom = first, last
        return True

    def since(self, now: float) -> float:
        """Return from when on rows are needed; ``now`` is the time of day, s."""
        if self.zoom is not None:
            return self.zoom[0]
        length = CHOICES[self.choice]
        return -math.inf if length is None else now - length

    def query(self, actuator: str) -> str:
        """Return what asks for the same stretch as CSV."""
        asked: dict[str, str] = {"actuator": actuator}
        if self.zoom is not None:
            asked |= {"since": f"{self.zoom[0]:.3f}", "until": f"{self.zoom[1]:.3f}"}
        elif (length := CHOICES[self.choice]) is not None:
            asked["last"] = f"{length:g}"
        return urlencode(asked)
