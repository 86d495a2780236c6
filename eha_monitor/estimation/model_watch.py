"""From verdicts on windows to a mismatch that stands; where a learned table says nothing.

Pure decisions on times and numbers, for live rows and for recordings alike.  A table keeps its
last value beyond the range of the recording that it was learned from, which is no law: a model
that is used there is neither right nor wrong, and what is estimated beside it deserves doubt.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from eha_monitor.estimation.results import (
    Beside,
    Consistency,
    JointResult,
    Mismatch,
    ModelStatus,
    ParameterEstimate,
    Taint,
    stands,
)
from eha_monitor.physics.own_term import BY_ANGLE, OF, OF_UNITS
from eha_monitor.quantity import quantity, share
from eha_monitor.settings.monitor import Settings

CHANCE_S = 12.0  # a mismatch that chance could bring about must stand for longer than a window
FITTING_S = 2.0  # for so long must window after window fit before a mismatch is over
SOON_S = 30.0  # one that comes back within so long was not over
LONGEST_FITTING_S = 60.0
# A value that has moved so far is on trial for so long before it may raise an alarm.
MOVED = 0.05
TRIAL_S = 2.5
SURELY = 2.0  # standard deviations
FAR = 3.0  # standard deviations, beyond ``MOVED`` of the value: a contradiction
LONGEST_TRIAL_S = 5.0  # dry friction that appears is told within so long (measured: 2 to 5 s)

_ORDER = ("one", "two", "joint")


class StageWatch:
    """One stage's mismatch, with hysteresis.

    It begins with a window that chance does not explain, or with doubtful windows for longer
    than a window lasts.  It ends when the windows have fitted for ``FITTING_S``; that time
    doubles whenever the mismatch comes back soon, because a motion that shows it now and then
    must not make alarms flutter.

    Parameters
    ----------
    stage : ``one`` or ``two``.

    Attributes
    ----------
    standing : the mismatch, or None.
    """

    def __init__(self, stage: str):
        self.stage = stage
        self.standing: Mismatch | None = None
        self._doubted: float | None = None  # since when the windows are doubtful
        self._fitting: float | None = None  # since when they fit
        self._required = FITTING_S
        self._ended = -math.inf

    def update(self, time_s: float, verdict: Consistency | None,
               trial: Taint | None = None) -> bool:
        """Take the verdict on the window that ends at ``time_s``; True if a mismatch begins.

        A parameter that was on ``trial`` has moved because of it: it began no later.
        """
        if verdict is None or verdict.consistent:
            self._doubted = None
            return False
        if self._doubted is None:
            self._doubted = time_s
        if self.standing is not None:
            self.standing = self._mismatch(verdict, self.standing.since_s)
            return False
        if not (verdict.decisive or time_s - self._doubted > CHANCE_S):
            return False
        soon = time_s - self._ended < max(SOON_S, 2.0 * self._required)
        self._required = min(2.0 * self._required, LONGEST_FITTING_S) if soon else FITTING_S
        self._fitting = None
        first = verdict.first_time_s
        since = min(first, time_s) if math.isfinite(first) else time_s
        since = min(since, trial.since_s) if trial is not None else since
        self.standing = self._mismatch(verdict, max(since, self._ended))
        return True

    def _mismatch(self, verdict: Consistency, since: float) -> Mismatch:
        return replace(Mismatch.of(self.stage, verdict), since_s=since)

    def test(self, time_s: float, fits: bool | None) -> bool:
        """Take whether the last window fits by itself; True if the mismatch ends.

        None, e.g. at rest, says nothing: the mismatch stays, and the time does not run.
        """
        if self.standing is None:
            return False
        if not fits:
            self._fitting = None
            return False
        if self._fitting is None:
            self._fitting = time_s
        if time_s - self._fitting < self._required:
            return False
        self.standing, self._doubted, self._ended = None, None, time_s
        return True


class Trial:
    """Whether a value that has moved has stood the test of the model since.

    A friction that appears looks like damping until the motion shows otherwise.  A value is on
    trial while it differs by more than ``MOVED``, beyond ``SURELY`` standard deviations that it
    had then, from what it was at any time in the last ``TRIAL_S``, or is no older than that.  So
    a slow drift is never on trial, and a new value that settles within its ± has not moved; one
    that goes on moving stays on trial, but holds an alarm back no longer than
    ``LONGEST_TRIAL_S`` (:meth:`health.judge.Judge.judge`).

    Parameters
    ----------
    unit : of the value, SI.

    Attributes
    ----------
    taint : the doubt that the value deserves at present, or None.
    """

    def __init__(self, unit: str):
        self._unit, self._moving = unit, False
        # (s, bound, value): the upper bounds, rising, and the lower ones, falling.
        self._upper: deque[tuple[float, float, float]] = deque()
        self._lower: deque[tuple[float, float, float]] = deque()
        self._known = self._began = math.inf
        self.taint: Taint | None = None

    def update(self, time_s: float, value: float | None, stddev: float = 0.0) -> Taint | None:
        """Take the value, None while it is not known; return the doubt that it deserves."""
        if value is None or not math.isfinite(value):
            self.__init__(self._unit)
            return None
        self._known = min(self._known, time_s)
        upper, lower = self._bounds(time_s, value, SURELY * stddev)
        away, before = max((value - upper[1], upper[2]), (lower[1] - value, lower[2]),
                           key=lambda one: one[0] / max(abs(one[1]), 1e-300))
        moved = away > MOVED * abs(before)
        if not moved and time_s - self._known >= TRIAL_S:
            self.taint, self._moving = None, False
            return None
        if self.taint is None or (moved and not self._moving):
            self._began = time_s  # what was only new has moved from here on
        self._moving = self._moving or moved
        since = max(self._began, time_s - LONGEST_TRIAL_S)
        what = (f"it has moved from {quantity(before, self._unit)} to "
                f"{quantity(value, self._unit)}") if moved else "it is new"
        self.taint = Taint(f"{what}, and the model is being tested on the data since "
                           f"t = {since:.1f} s", since, True)
        return self.taint

    @property
    def moved(self) -> Taint | None:
        """The doubt while the value has moved; None where it is only new."""
        return self.taint if self._moving else None

    def _bounds(self, time_s: float, value: float, doubt: float
                ) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Return the least upper and the largest lower bound of the last ``TRIAL_S``."""
        for kept, sign in ((self._upper, 1.0), (self._lower, -1.0)):
            bound = value + sign * doubt
            while kept and sign * (kept[-1][1] - bound) >= 0:
                kept.pop()
            kept.append((time_s, bound, value))
            while time_s - kept[0][0] > TRIAL_S - 1e-6:
                kept.popleft()
        return self._upper[0], self._lower[0]


def tainted_by(mismatches: Iterable[Mismatch],
               parameters: Mapping[str, ParameterEstimate] = MappingProxyType({}),
               looks: Sequence[Beside] = (), elapsed_s: float = 0.0) -> dict[str, Taint]:
    """Return which of ``B`` and ``beta_e`` the mismatches that stand put in doubt, and why.

    Stage two holds the force balance as well, so what that lacks moves beta_e too.  While one
    stage does not fit, another is in doubt where least squares contradict it, or determine what it
    does not.

    Parameters
    ----------
    mismatches : those that stand.
    parameters : of the stages.
    looks : least squares on the balances (:mod:`balances.parameters`), in order of time; what
        stands of them at ``elapsed_s`` (s).
    """
    found: dict[str, Taint] = {}
    for mismatch in sorted(mismatches, key=lambda m: _ORDER.index(m.stage)):
        taint = Taint(f"the model does not fit since t = {mismatch.since_s:.1f} s "
                      f"({mismatch.balance})", mismatch.since_s)
        if mismatch.stage in ("one", "joint"):
            found["B"] = taint
        found["beta_e"] = taint  # its own reason goes before that of B
    known = {name: one for name in parameters
             if (one := stands(looks, elapsed_s, name)) is not None}
    if found:
        since = min(taint.since_s for taint in found.values())
        found = {name: Taint(f"least squares give {one.shown}", since)
                 for name, one in known.items()
                 if _contradicts(parameters[name], one)} | found
    return {name: replace(taint, instead=known.get(name)) for name, taint in found.items()}


def _contradicts(estimate: ParameterEstimate, other: ParameterEstimate) -> bool:
    """Tell whether a stage's value is farther from another than both may be off, or none."""
    return estimate.status != "converged" or (
        abs(estimate.value - other.value)
        > FAR * math.hypot(estimate.stddev, other.stddev) + MOVED * abs(other.value))


def model_status(verdicts: Iterable[Consistency | None],
                 joint: JointResult | None = None) -> ModelStatus:
    """Return one verdict from the stages' innovations and from the joint filter's fit."""
    judged = [verdict for verdict in verdicts if verdict is not None]
    wrong = [verdict for verdict in judged if not verdict.consistent]
    if wrong:
        return ModelStatus("mismatch", "; ".join(verdict.message for verdict in wrong))
    if joint is not None and not joint.fits:
        return ModelStatus("mismatch", "each stage fits its own channels, but position, pressure "
                           f"and drive do not fit together ({joint.message}): check the scale of "
                           "the sensors and the pump")
    if not judged:
        return ModelStatus("not_judged", "no stage has had enough data, or motion, to test the "
                           "model")
    return ModelStatus("consistent", "; ".join(verdict.message for verdict in judged))


BEYOND = 0.02  # of its range: so far past an end a table still holds
OFTEN = 0.01  # of the samples; a table leaves out 0.1 % of its own recording at either end
OVER_S = 0.01  # a velocity is read over so long


@dataclass(frozen=True)
class Range:
    """What a learned table covers: name of its entry, signal, both ends, SI."""

    name: str
    of: str
    first: float
    last: float


def ranges_of(settings: Settings) -> tuple[Range, ...]:
    """Return what the tables among a config's effects cover; the shaft's angle goes round."""
    return tuple(Range(name, entry["of"], entry["first"], entry["last"])
                 for name, entry in settings.effects.items()
                 if "values" in entry and entry.get("of") not in (None, OF[BY_ANGLE]))


def beyond(ranges: tuple[Range, ...], channels: Mapping[str, np.ndarray], dt: float,
           gain: float | None) -> str:
    """Return in words which table the motion leaves, "" where it leaves none.

    Parameters
    ----------
    channels : recorded ones by name, (n,) SI, NaN where missing;  ``dt`` between samples, s.
    gain : of the position loop, rad/s/m, where the shaft's speed is not recorded.
    """
    for one in ranges:
        values = _signal(one.of, channels, dt, gain)
        values = values[np.isfinite(values)]
        margin = BEYOND * (one.last - one.first)
        outside = (values < one.first - margin) | (values > one.last + margin)
        if len(values) and np.mean(outside) > OFTEN:
            unit = OF_UNITS[one.of]
            return (f"{one.name} was learned from {one.of} = {quantity(one.first, unit, 3)} to "
                    f"{quantity(one.last, unit, 3)}, and {share(float(np.mean(outside)))} of the "
                    "samples are outside")
    return ""


def _signal(of: str, channels: Mapping[str, np.ndarray], dt: float, gain: float | None
            ) -> np.ndarray:
    """Return a signal of a table along a recording, empty where it was not measured."""
    if of in ("x", "p1", "p2", "omega") and of in channels:
        return channels[of]
    if of == "v" and "x" in channels:
        step = max(round(OVER_S / dt), 1)
        x = channels["x"]
        return (x[step:] - x[:-step]) / (step * dt)
    if of in ("dp", "p") and "p1" in channels and "p2" in channels:
        return (channels["p1"] - channels["p2"] if of == "dp"
                else 0.5 * (channels["p1"] + channels["p2"]))
    if of == "omega" and gain is not None and "x_d" in channels and "x" in channels:
        return gain * (channels["x_d"] - channels["x"])
    return np.zeros(0)


def within(status: ModelStatus, words: str, since_s: float) -> ModelStatus:
    """Return the verdict on a model: none where the motion leaves what was learned (``words``)."""
    if not words:
        return status
    doubt = Taint(words, since_s)
    return replace(status, status="not_judged", message=words,
                   tainted={"B": doubt, "beta_e": doubt} | status.tainted)
