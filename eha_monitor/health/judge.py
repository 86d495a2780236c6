"""One alarm: the limits of one side of one parameter, its clocks, and the level that they give.

A line of the diagnostics (:class:`Finding`) has the same levels.

A level is a judgement (OK, WARN, ERROR), or there is none: STALE without data, and "not judged"
where the value came but cannot be judged.  What is not judged is never OK.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

from eha_monitor.estimation.model_watch import LONGEST_TRIAL_S
from eha_monitor.settings.monitor import Limits

Level = Literal["OK", "WARN", "ERROR", "STALE"]
# Lines of ``monitor/diagnosis`` that are always there.
DIAGNOSIS, MODEL_IN_FORCE = "diagnosis", "model_in_force"
MACHINE = "machine"  # and this one beside a machine file
INDICATOR = "indicator "  # and these, each with its name
MISMATCH = "model_mismatch"  # the test of the model, a line of ``monitor/health``
RAISED: tuple[Level, ...] = ("OK", "WARN", "ERROR")
NOT_JUDGED = "not judged"
NO_LIMIT = "no limit set"  # what an alarm says that nobody asked for
# As it is reported; what counts most comes last.
SEVERITY: tuple[str, ...] = ("OK", "STALE", NOT_JUDGED, "WARN", "ERROR")

SETTLE_S = 10.0  # a value has settled when it has stayed within ...
WITHIN = 0.05  # ... so much of itself for so long
_TIME_TOLERANCE = 1e-6  # sums of sample times miss the hold time by rounding


class Reported:
    """The level of an alarm, or of a line of the diagnostics, in words."""

    @property
    def word(self) -> str:
        """The level as it is reported: OK, WARN, ERROR, STALE or ``not judged``."""
        return NOT_JUDGED if self.unjudged else self.level

    @property
    def raised(self) -> bool:
        """Whether it is WARN or ERROR by judgement."""
        return self.word in ("WARN", "ERROR")


@dataclass(frozen=True)
class Alarm(Reported):
    """State of one alarm at one time.

    Attributes
    ----------
    name : ``viscous_damping_high``, ``viscous_damping_low``, ``bulk_modulus_high`` or
        ``bulk_modulus_low``.
    level : STALE without data; of what is not judged STALE too, or WARN where the value as it
        stands is beyond a limit: that must be reported.
    message : the reason, as a sentence.
    time_s : when it took this level.
    not_judged : the value came, but says nothing about the limits; ``level`` is no judgement.
    """

    name: str
    level: Level
    message: str
    time_s: float
    not_judged: bool = False

    @property
    def unjudged(self) -> bool:
        """Whether the level is no judgement."""
        return self.not_judged


@dataclass(frozen=True)
class Finding(Reported):
    """One line of the diagnostics."""

    name: str  # stable, without the hardware's name
    level: str  # ``OK``, ``WARN``, ``ERROR`` or ``STALE``
    message: str  # a sentence
    # key -> number or text; numbers are written so that plotting tools read them
    values: dict[str, float | int | str] = field(default_factory=dict)

    @property
    def unjudged(self) -> bool:
        """Whether the level is no judgement."""
        return str(self.values.get("not_judged", "0")) == "1"


@dataclass(frozen=True)
class Watched:
    """A parameter with alarms: symbol in the results, section of the thresholds, words."""

    symbol: str
    section: str
    words: str
    unit: str


@dataclass(frozen=True)
class Doubt:
    """How far a value may be off: it may truly be as low as ``lowest``, as high as ``highest``.

    ``trial``: it has just moved, and may raise nothing until the model has been tested on it,
    which a value that goes on moving waits ``wait`` s for; ``never``: nothing has tested it yet.
    """

    lowest: float
    highest: float
    trial: bool = False
    wait: float = LONGEST_TRIAL_S
    never: bool = False


@dataclass
class Judge:
    """One alarm: limits of one side of one parameter, and what is raised."""

    watched: Watched
    sign: float  # +1 above the limit is bad, -1 below
    limits: tuple[float | None, float | None] = (None, None)  # WARN, ERROR
    hysteresis: float = 0.0
    hold_time: float = 0.0
    # raised, raised_s: 0, 1 or 2: OK, WARN or ERROR; and when it rose last, s
    raised: int = 0
    raised_s: float = -math.inf
    # of each limit, since when the value has passed it for certain, s
    since: list[float | None] = field(default_factory=lambda: [None, None])
    # of each limit, the look at which it had first, where looks give the value
    look: list[object] = field(default_factory=lambda: [None, None])
    # of each limit, since when the value has been back inside it for certain, s
    within: list[float | None] = field(default_factory=lambda: [None, None])
    beyond: float | None = None  # since when the value as it stands has passed the first limit, s
    # level, time_s, situation: of the alarm, and since when
    level: Level | None = None
    not_judged: bool = False
    time_s: float = 0.0
    situation: tuple = ("unjudged", "no data yet")

    @property
    def name(self) -> str:
        """Name of the alarm."""
        return f"{self.watched.section}_{'high' if self.sign > 0 else 'low'}"

    @property
    def off(self) -> bool:
        """Whether no limit is set."""
        return self.limits == (None, None)

    @property
    def first(self) -> int:
        """Place of the limit that is passed first."""
        return 0 if self.limits[0] is not None else 1

    def configure(self, limits: Limits) -> None:
        """Take other limits; a level that no longer has a limit falls."""
        side = "high" if self.sign > 0 else "low"
        self.limits = (getattr(limits, f"{side}_warn"), getattr(limits, f"{side}_error"))
        self.hysteresis, self.hold_time = limits.hysteresis, limits.hold_time
        self.forget()
        while self.raised and self.limits[self.raised - 1] is None:
            self.raised -= 1

    def forget(self) -> None:
        """Start the clocks anew: nothing is known about the limits."""
        self.since, self.within, self.beyond = [None, None], [None, None], None

    def judge(self, time_s: float, value: float, margin: float,
              doubt: Doubt | None = None, look: object = None) -> None:
        """Raise or clear on one value.

        A limit is passed when the value, as far back as its doubt reaches, lies beyond it by
        ``margin`` (confidence times standard deviation); a level falls when the value, as far
        out as its doubt reaches, is back inside.  On trial the clocks run, and a limit that was
        passed for all of ``LONGEST_TRIAL_S`` is raised though the value goes on moving: the model
        has been tested on it for so long.  Where a ``look`` at some seconds gives the value, the
        next one must have passed the limit as well: a few seconds may lack the motion.
        """
        sign, good, bad, wait, back_in = self.sign, value, value, 0.0, 0.0
        if doubt is not None:
            good, bad = ((doubt.lowest, doubt.highest) if sign > 0
                         else (doubt.highest, doubt.lowest))
            wait, back_in = (doubt.wait, LONGEST_TRIAL_S) if doubt.trial else (0.0, 0.0)
        if sign * (value - self.limits[self.first]) <= margin:
            self.beyond = None
        elif self.beyond is None:
            self.beyond = time_s
        if not self.raised and self.beyond is None and self.since == [None, None]:
            return  # as nearly always: the value is inside, and its doubt lies on both sides
        for place, limit in enumerate(self.limits):
            back = limit is None or self._cleared(limit, bad)
            self.within[place] = _clock(self.within[place], back, time_s)
            passed = limit is not None and sign * (good - limit) > margin
            if self.since[place] is None:
                self.look[place] = look
            self.since[place] = _clock(self.since[place], passed, time_s)
        while self.raised and _ran(self.within[self.raised - 1], time_s, back_in):
            self.raised -= 1
        for place in (0, 1):
            if place + 1 > self.raised and _ran(self.since[place], time_s, max(
                    wait, self.hold_time)) and (look is None or look != self.look[place]):
                self.raised, self.raised_s = place + 1, time_s

    def evident(self, margin: float, doubt: Doubt | None, value: float) -> bool:
        """Tell whether what is raised is so as far back as the value's doubt reaches."""
        good = value if doubt is None else doubt.lowest if self.sign > 0 else doubt.highest
        return self.raised > 0 and self.sign * (good - self.limits[self.raised - 1]) > margin

    def recall(self, since_s: float, value: float, margin: float, doubt: Doubt) -> None:
        """Take back what was raised since ``since_s`` on a value that deserved doubt then."""
        while self.raised and self.raised_s >= since_s and not self.evident(margin, doubt, value):
            self.raised -= 1

    def verdict(self, time_s: float, doubt: Doubt | None) -> tuple[Level, bool]:
        """Return the level after :meth:`judge`, and whether it is none but "not judged"."""
        if self.raised or doubt is None:
            return RAISED[self.raised], False
        limit = self.limits[self.first]
        bad = doubt.highest if self.sign > 0 else doubt.lowest
        evident = _ran(self.beyond, time_s, self.hold_time)
        if doubt.trial:
            inside = ("STALE", True) if doubt.never else ("OK", False)
            return ("WARN", True) if evident else inside
        if self.sign * (bad - limit) <= 0:
            return "OK", False  # inside, wherever the model's error may have moved it from
        return ("WARN" if evident else "STALE"), True

    def _cleared(self, limit: float, value: float) -> bool:
        inside = limit - self.sign * self.hysteresis * abs(limit)
        return self.sign * (value - inside) <= 0

    def take(self, level: Level, time_s: float, situation: tuple, not_judged: bool = False
             ) -> bool:
        """Set the level; True when it changed."""
        self.situation = situation
        if (level, not_judged) == (self.level, self.not_judged):
            return False
        self.level, self.not_judged, self.time_s = level, not_judged, time_s
        return True


def _clock(since: float | None, runs: bool, time_s: float) -> float | None:
    """Return since when something holds, s; None where it does not."""
    if not runs:
        return None
    return time_s if since is None else since


def _ran(since: float | None, time_s: float, wait: float) -> bool:
    """Tell whether a clock has run for ``wait`` s."""
    return since is not None and time_s - since >= wait - _TIME_TOLERANCE


UNKNOWN = Doubt(-math.inf, math.inf)  # of a value that the model's error may have moved anywhere


class Rebase:
    """Reading a value under a model that does not fit by how it changes from where it settled.

    It knows what one parameter read before a mismatch and what it reads under it.  A force that
    the model lacks adds to B, so B is read by the difference; a flow that it lacks scales beta_e,
    so beta_e is read by the ratio.

    Parameters
    ----------
    nominal : value that stands for the one before, where the mismatch was there from the start.
    by_ratio : read by the ratio instead of the difference.
    """

    def __init__(self, nominal: float, by_ratio: bool):
        self.before, self._by_ratio = nominal, by_ratio
        self.settled: float | None = None
        self._since: float | None = None
        self._recent: deque[tuple[float, float]] = deque()

    def fits(self, value: float) -> None:
        """Note a value while the model fits."""
        self.before, self.settled, self._since = value, None, None
        self._recent.clear()

    def read(self, time_s: float, value: float, stddev: float, since_s: float
             ) -> tuple[float, float] | None:
        """Return value and standard deviation as the limits should see them.

        None while the value has not yet settled under the mismatch that began at ``since_s``.
        """
        if since_s != self._since:
            self._since, self.settled = since_s, None
            self._recent.clear()
        if self.settled is None and not self._settle(time_s, value):
            return None
        if self._by_ratio:
            factor = self.before / self.settled
            return factor * value, factor * stddev
        return value + self.before - self.settled, stddev

    def _settle(self, time_s: float, value: float) -> bool:
        recent = self._recent
        recent.append((time_s, value))
        while time_s - recent[0][0] > SETTLE_S + 1e-6:
            recent.popleft()
        values = [v for _, v in recent]
        mean = math.fsum(values) / len(values)
        if (time_s - recent[0][0] < 0.9 * SETTLE_S or mean == 0
                or max(values) - min(values) > WITHIN * abs(mean)):
            return False
        self.settled = mean
        return True
