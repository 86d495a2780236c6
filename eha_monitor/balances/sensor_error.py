"""Several numbers that changed, or one sensor.

One balance alone cannot tell a constant load from the zero of a pressure sensor, nor a pump whose
flow lags from a position that is read late.  The others can: a pressure that is read b too high
makes C_T b of leakage that is not there, and moves the lowest pressure of its chamber by b; a late
position makes a smaller gain of the drive.  So each sensor whose error would make what changed is
tried on the recordings themselves: with its channel corrected, what still differs?
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from eha_monitor.balances.candidates import stop
from eha_monitor.balances.course import Course
from eha_monitor.balances.judge import judge_with_oil, source_of, within_stroke
from eha_monitor.balances.judged import Judged, Moved
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.measured import courses_of
from eha_monitor.balances.model import LOAD
from eha_monitor.mismatch.diagnosis import Change, Value
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import effect_words, listed

TWICE = 2.0  # times what its symptom says, or half of it: so far an error is looked for
NEAR, STEPS = 3e-3, 20  # share of that to which it is found, in at most so many steps
TURNED = 0.05  # of a play: when its sensor has moved so far the piston is through it
FEWER = 2  # things that differ must a sensor's error, itself one, take away
Corrected = Callable[[np.ndarray, float, float], np.ndarray]


@dataclass(frozen=True)
class Fault:
    """What may be wrong with one channel.

    Attributes
    ----------
    effect, symbol, unit : of the catalogue.
    channel : that is read wrongly.
    symptoms : effects that a balance takes it for, the one that shows it best first: each with
        the error that makes an amount of it, of the rig, the channel's mean and the amount, SI.
    corrected : of the channel (n,), the error and the sample time, s: the channel without it.
    words : that end "the sensor of p1 reads", with ``{}`` for the amount: too much and too little.
    least : no error is less; nothing reads what is still to come.
    """

    effect: str
    symbol: str
    unit: str
    channel: str
    symptoms: dict[str, Callable[[Rig, float, float], float]]
    corrected: Corrected
    words: tuple[str, str]
    least: float = -np.inf


def _earlier(values: np.ndarray, late: float, dt: float) -> np.ndarray:
    """Return a channel as it was ``late`` s later; beyond its ends it goes on as it went there."""
    t, off = dt * np.arange(len(values)), abs(late)
    first, last = values[0], values[-1]
    before, after = np.interp((t[0] + off, t[-1] - off), t, values)
    return np.interp(t + late, np.concatenate(((t[0] - off,), t, (t[-1] + off,))),
                     np.concatenate(((2.0 * first - before,), values, (2.0 * last - after,))))


def _of_pressure(i: int, sign: float) -> tuple[Fault, Fault]:
    """Return what may be wrong with the pressure of a chamber, whose force has this sign."""
    def less(rig: Rig, force: float) -> float:
        return force / (sign * getattr(rig, f"area_{i}"))

    def of_scale(rig: Rig, mean: float, force: float) -> float:
        share = less(rig, force) / mean if mean else np.nan  # k p / (1 + k) p
        return share / (1.0 - share) if share < 1.0 else np.nan

    return (
        Fault("pressure_offset", f"b_{i}", "Pa", f"p{i}",
              {LOAD: lambda rig, mean, force: less(rig, force)},
              lambda p, b, dt: p - b, ("{} too high", "{} too low")),
        Fault("pressure_scale", f"k_{i}", "1", f"p{i}",
              {LOAD: of_scale}, lambda p, k, dt: p / (1.0 + k), ("{} too much", "{} too little")))


# A position that is T late takes K T x' from the speed that the drive is commanded.
LATE = Fault("position_delay", "T", "s", "x", {
    "flow_lag": lambda rig, mean, lag: lag if rig.pump_displacement else np.nan,
    "drive_gain": lambda rig, mean, gain: -gain * rig.area_1 / (
        rig.position_gain * (rig.pump_displacement or np.nan)),
    "feed_forward": lambda rig, mean, share: -share / rig.position_gain},
    _earlier, ("{} late", "{} early"), least=0.0)
# Behind a play the position lags by half of it, against friction, spring and mass alike.
PLAY = Fault("backlash", "b", "m", "x", {"backlash": lambda rig, mean, play: play},
             lambda x, b, dt: x + 0.5 * b * stop(x, TURNED * b) if b > 0.0 else x,
             ("with a play of {}", "with a play of {}"), least=0.0)
FAULTS = (*_of_pressure(1, 1.0), *_of_pressure(2, -1.0), LATE, PLAY)


@dataclass(frozen=True)
class Reading:
    """Recordings as their sensors read, or with an error of one of them taken away.

    Attributes
    ----------
    judged, courses : beside the machine.
    error : (value, deviation) of what was taken away, in the unit of its ``fault``, for the
        ``symptom`` that it makes.
    differs : what differs from the healthy recordings: (balance, effect), or (balance, "") of one
        that is left open; ``small`` those that are too small to matter.
    """

    judged: Judged
    courses: Sequence[Course]
    differs: frozenset[tuple[str, str]]
    small: frozenset[tuple[str, str]]
    fault: Fault | None = None
    error: tuple[float, float] = (0.0, 0.0)
    symptom: Moved | None = None

    @property
    def left(self) -> float:
        """Logarithm of the error that is left on unseen parts, of all balances.

        Less than the healthy recordings leave is no evidence.
        """
        return float(np.log([max(one.after, one.usual, one.table.floor / one.table.size)
                             for one in self.judged.balances]).sum())

    def far(self, but: str = "") -> float:
        """Return the sum over balances, ``but`` one, of (error over the machine's usual one)²."""
        return sum((one.error / max(one.usual, one.table.floor / one.table.size)) ** 2
                   for one in self.judged.balances if one.balance != but)

    def explains(self, given: "Reading") -> bool:
        """Tell whether what it takes away is the cause of what differs in given recordings.

        It takes away ``FEWER`` things and brings none that matters.  Another balance than its
        symptom's bears witness: of that it takes something away, and leaves nothing.
        """
        gone = given.differs - self.differs
        witnesses = {balance for balance, _ in gone} - {
            self.symptom.candidate.balance, *(balance for balance, _ in self.differs)}
        return (self.differs - self.small <= given.differs and len(gone) >= FEWER
                and bool(witnesses) and len(self.judged.balances) == len(given.judged.balances)
                and (self.judged.belongs or self.judged.explained))

    @property
    def words(self) -> str:
        """What was taken away, to follow "the sensor reads"."""
        value, stddev = self.error
        amount = (with_uncertainty(100.0 * abs(value), 100.0 * stddev, "%")
                  if self.fault.unit == "1" else
                  with_uncertainty(abs(value), stddev, self.fault.unit))
        return self.fault.words[0 if value > 0.0 else 1].format(amount)


def without_sensor_error(machine: Machine, recordings: Sequence[Recording], settings: Settings,
                         courses: Sequence[Course]
                         ) -> tuple[Judged, Reading, tuple[Change, ...]]:
    """Return recordings judged as they are and without the sensor error that explains more.

    Of all that differs one error must take away ``FEWER`` things, and bring none.  A change is
    told with the sensor that would make it only where that sensor, corrected, leaves less.
    What an error of the machine's fit might make as well bears witness all the same: that it is
    just as large as the sensor makes it is no accident.
    """
    judged, machine = judge_with_oil(machine, courses, settings), machine.taken_as_sure()
    given = _reading(machine, courses, settings)
    tried = [one for fault in FAULTS if (one := _corrected(
        fault, machine, recordings, settings, given)) is not None]
    fits = [one for one in tried if one.differs < given.differs]
    explain = [one for one in tried if one.explains(given)]
    if explain:
        few = min(len(one.differs) for one in explain)
        least = min(one.left for one in explain if len(one.differs) == few)
        best, *as_much = [one for one in explain if len(one.differs) == few
                          and one.left - least < machine.policy.alone]
        return judged, best, (_change(best, as_much, given, machine),)
    refuted = {one.fault.effect for one in tried} - {one.fault.effect for one in fits}
    return judged, replace(given, judged=replace(judged, balances=tuple(
        replace(one, changed=tuple(replace(moved, rivals=tuple(
            rival for rival in moved.rivals if rival not in refuted)) for moved in one.changed))
        for one in judged.balances))), ()


def _reading(machine: Machine, courses: Sequence[Course], settings: Settings) -> Reading:
    """Return motions judged beside a machine."""
    judged = judge_with_oil(machine, courses, settings)
    source = source_of(machine, courses, settings.rig, None)
    changed, small = (frozenset((one.candidate.balance, one.candidate.effect) for one in some)
                      for some in (judged.changed, judged.small))
    return Reading(judged, courses, changed | small | {
        (one.balance, "") for one in judged.loud if not one.changed or not one.settled} | (
        {(source.balance, source.what)} if source else set()), small - changed)


def _corrected(fault: Fault, machine: Machine, recordings: Sequence[Recording],
               settings: Settings, given: Reading) -> Reading | None:
    """Return recordings with a channel corrected for what it would explain; None if nothing."""
    channel = fault.channel
    changed = {one.candidate.effect: one for one in given.judged.changed}
    name = next((name for name in fault.symptoms if name in changed), None)
    if name is None or not all(one.has(channel) for one in recordings):
        return None
    symptom, mean = changed[name], float(np.mean(
        [np.nanmean(one.channels[channel]) for one in recordings]))

    def error_of(amount: float) -> float:
        return fault.symptoms[name](settings.rig, mean, amount)

    def without(value: float) -> Reading:
        right = [replace(one, channels=one.channels | {channel: fault.corrected(
            one.channels[channel], value, one.sample_time)}) for one in recordings]
        courses, _ = within_stroke(machine, courses_of(right, settings, machine.band)[1])
        return replace(_reading(machine, courses, settings), fault=fault, symptom=symptom,
                       error=(value, abs(error_of(off + symptom.apart) - first)))

    off = symptom.here - symptom.machine
    first = error_of(off)
    if not first >= fault.least:  # nor is it one of nil, or of a pump that nobody knows
        return None
    found, own = without(first), symptom.candidate.balance
    if not found.differs or found.far(own) >= given.far(own):
        return found
    # What all balances say together, as one of them alone takes other things for it as well.
    tried = {1.0: found}

    def far(times: float) -> float:
        tried[times] = without(times * first)
        return tried[times].far()

    minimize_scalar(far, bounds=(1.0 / TWICE, TWICE), method="bounded",
                    options={"xatol": NEAR, "maxiter": STEPS})
    near = sorted(tried, key=lambda times: tried[times].far())[:3]
    best = tried[near[0]]
    # As sure as far as one balance leaves sqrt(2) times what healthy recordings do.
    bend = float(np.polyfit(near, [tried[times].far() for times in near], 2)[0])
    known = abs(first) / np.sqrt(bend) if bend > 0.0 else np.inf
    value, chance = best.error
    return replace(best, error=(float(value), float(np.hypot(
        chance, min(known, abs(value - first))))))


def _change(one: Reading, others: Sequence[Reading], given: Reading, machine: Machine) -> Change:
    """Return the record of a sensor's error, and of others that explain as much."""
    moved, reads = one.symptom, {}
    for each in (one, *others):
        reads.setdefault(each.fault.channel, []).append(each.words)
    sensors = ", or ".join(f"the sensor of {channel} reads {' or '.join(words)}"
                           for channel, words in reads.items())
    by = with_uncertainty(abs(moved.here - moved.machine), moved.apart, moved.candidate.unit)
    shown = "" if moved.candidate.effect == one.fault.effect else (
        f"a {effect_words(moved.candidate.effect)} of {by}, and ")
    gone = [effect_words(what) if what else f"unexplained rest of the {balance}"
            for balance, what in sorted(given.differs - one.differs)
            if what != moved.candidate.effect]
    return Change(
        one.fault.effect, one.fault.symbol, "sensor", Value(0.0, one.error[1], one.fault.unit),
        Value(*one.error, one.fault.unit), one.fault.unit,
        f"{sensors}: that explains {shown}the {listed(gone)} that "
        f"{'differs' if len(gone) == 1 else 'differ'} from {machine.runs}",
        tuple(other.fault.effect for other in others))
