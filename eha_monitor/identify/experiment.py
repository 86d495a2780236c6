"""The experiment: move a rig, or the simulated one, within limits until all is decided."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.signal import savgol_coeffs

from eha_monitor.errors import InputError
from eha_monitor.identify.plan import (
    TOTAL,
    WORTH,
    Contest,
    Planned,
    Planner,
    Structure,
    beside,
    running,
    standing,
)
from eha_monitor.mismatch.advise.motions import demanded, excitation_tree, without_noise
from eha_monitor.mismatch.advise.separate import simulated
from eha_monitor.mismatch.advise.words import motion_sentence
from eha_monitor.mismatch.data.experiment import OUTPUTS, Experiment
from eha_monitor.mismatch.diagnose import Answered, diagnose_and_name
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.name.naming import Names, Naming
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of
from eha_monitor.physics.simulator import Simulator
from eha_monitor.progress import Report, silent
from eha_monitor.quantity import number, quantity
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.monitor import Experiment as Bounds
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed, odds

NEEDED = ("lower", "upper", "speed", "acceleration", "pressure")
LOOP = ("pump_displacement", "position_gain", "area_1", "area_2", "volume_1", "volume_2")
CHANNELS = ("x", "p1", "p2")  # that are watched, where they come
WINDOW = 0.02  # s over which speed and acceleration are taken from the position
STANDING = 3  # samples beyond a limit before it counts: one may be a spike
INSIDE = 0.02  # of the travel, from its ends, where a position is held
NOISE = 5.0  # standard deviations that noise may add


def bounds_of(settings: Settings, source: str) -> Bounds:
    """Return the limits of a config; raise InputError unless complete and possible on its rig."""
    given, rig = settings.experiment, settings.rig
    for key in NEEDED:
        if getattr(given, key) is None:
            raise InputError(f"{source}: experiment.{key}: expected a number, as nothing is moved "
                             f"without limits of {', '.join(NEEDED)}")
    for key in LOOP:
        if getattr(rig, key) is None:
            raise InputError(f"{source}: rig.{key}: expected a number, as motions are planned "
                             "with a model of a pump in a position loop; of an actuator behind a "
                             "valve record motions of your own")
    if given.pressure <= rig.charge_pressure:
        raise InputError(f"{source}: experiment.pressure: expected more than the charge pressure "
                         f"of {quantity(rig.charge_pressure, 'Pa', 3)}, got "
                         f"{quantity(given.pressure, 'Pa', 3)}")
    return given


def held(bounds: Bounds, position: float) -> float:
    """Return where to hold a piston, m: as demanded, but a little within the travel."""
    inside = INSIDE * (bounds.upper - bounds.lower)
    return float(np.clip(position, bounds.lower + inside, bounds.upper - inside))


class Watch:
    """Tells from what the sensors show whether a limit is exceeded.

    Speed and acceleration are those of a parabola fitted to ``WINDOW`` s of positions
    (Savitzky and Golay 1964); what their noise may add is not counted.

    The bounds are complete; ``noise`` is the standard deviation of the position, m.  What comes
    with stamps is judged by these: rows that are lost make nothing faster.
    """

    def __init__(self, bounds: Bounds, dt: float, noise: float):
        self._bounds, self._dt = bounds, dt
        count = max(5, 2 * round(0.5 * WINDOW / dt) + 1)
        self._rates = [(name, unit, limit, kernel, NOISE * noise * float(np.linalg.norm(kernel)))
                       for name, unit, limit, kernel in (
            ("speed", "m/s", bounds.speed, savgol_coeffs(count, 2, 1, dt)),
            ("acceleration", "m/s²", bounds.acceleration, savgol_coeffs(count, 2, 2, dt)))]
        # channel -> (k, 2) time in s and value, of the last samples
        self._kept: dict[str, np.ndarray] = {}
        self._count = count

    def exceeded(self, channels: dict[str, np.ndarray], at: np.ndarray | None = None) -> str:
        """Take further samples, channel -> (n,) SI; return which limit they exceed, or "".

        Missing samples (NaN) are left out, those of a channel that does not come are not asked.
        A gap is bridged by a straight line, and one longer than ``WINDOW`` s begins anew.

        ``at`` : (n,) stamps of the samples, s; None, or stamps that do not go on, where they come
        one each sample time.
        """
        for name in CHANNELS:
            values = channels.get(name)
            if values is None:
                continue
            before = self._kept.get(name, np.empty((0, 2)))
            last = before[-1, 0] if len(before) else 0.0
            goes_on = (at is not None and (at[0] > last or not len(before))
                       and (np.diff(at) > 0.0).all())
            times = at if goes_on else last + self._dt * np.arange(1, len(values) + 1)
            there = np.isfinite(values)
            rows = np.concatenate([before, np.column_stack([times, values])[there]])
            gaps = np.flatnonzero(np.diff(rows[:, 0]) > WINDOW + self._dt)
            rows = rows[gaps[-1] + 1 if len(gaps) else 0:]
            if not len(rows):
                continue
            count = round((rows[-1, 0] - rows[0, 0]) / self._dt) + 1
            even = rows[0, 0] + self._dt * np.arange(count)
            if found := self._beyond(name, np.interp(even, *rows.T)):
                return found
            since = rows[-1, 0] - (self._count + STANDING) * self._dt
            self._kept[name] = rows[rows[:, 0] >= since]
        return ""

    def _beyond(self, name: str, rows: np.ndarray) -> str:
        b = self._bounds
        if name != "x":
            return lasting(rows, b.pressure, f"{name} of", "Pa", b.pressure)
        found = (lasting(rows, b.upper, "position of", "m", b.upper)
                 or lasting(-rows, -b.lower, "position of", "m", -b.lower, -1.0))
        for what, unit, limit, kernel, extra in self._rates:
            if found or len(rows) < len(kernel):
                break
            rates = np.abs(np.convolve(rows, kernel, "valid"))
            found = lasting(rates, limit + extra, f"{what} of", unit, limit)
        return found


def lasting(values: np.ndarray, most: float, what: str, unit: str, limit: float,
            sign: float = 1.0) -> str:
    """Return in words by how much values are beyond ``most`` for ``STANDING`` samples, or ""."""
    if len(values) < STANDING:
        return ""
    least = np.lib.stride_tricks.sliding_window_view(values, STANDING).min(axis=1)
    if not (least > most).any():
        return ""
    return (f"{what} {quantity(sign * float(least.max()), unit, 3)}, the limit is "
            f"{quantity(sign * limit, unit, 3)}")


TURN = 0.02  # s that are simulated between two looks at the limits
HELD = 0.5  # s that are still recorded after an abort
START_NS = 1_000_000_000
# A recording as it is to be used, and what its channels say about the config.
Checked = tuple[Recording, Sequence[ChannelFinding]]


@dataclass(frozen=True)
class Ran:
    """A motion that was run."""

    recording: Recording  # what came
    aborted: str = ""  # why it ended early, or ""; ``asked``: whether somebody asked for it
    asked: bool = False
    bag: Path | None = None  # where it was recorded as it came, or None


class Rig(Protocol):
    """What runs motions."""

    def position(self) -> float:
        """Return where the piston is held, m."""

    def run(self, x_d: np.ndarray, name: str) -> Ran:
        """Run a demand (n,) m, one value to a sample, from where the piston is held.

        Where a limit is exceeded, data stop, or somebody asks for it, the position demanded last
        is held, or the limit next to it: the piston comes to rest there without a jolt.
        """


class SimulatedRig:
    """The simulated actuator of a config, in place of a rig: it goes on from motion to motion."""

    def __init__(self, settings: Settings, bounds: Bounds, seed: int | None = None,
                 source: str = "config"):
        self._demand = np.full(1, 0.5 * (bounds.lower + bounds.upper))
        self._began, self._dt = 0, settings.rig.sample_time
        self._simulator = Simulator(settings, seed, source, self._demanded)
        self._bounds = bounds
        self._noise = max(settings.simulation.noise.position,
                          settings.simulation.noise.position_resolution)

    def _demanded(self, time: np.ndarray) -> np.ndarray:
        """Return x_d at each time, m; behind its end the demand is held."""
        return np.interp(time / self._dt - self._began, np.arange(len(self._demand)), self._demand)

    def position(self) -> float:
        """Return where the piston is held, m."""
        return float(self._demand[-1])

    def run(self, x_d: np.ndarray, name: str) -> Ran:
        """Run a demand; see :meth:`Rig.run`."""
        simulator, parts = self._simulator, []
        watch = Watch(self._bounds, simulator.dt, self._noise)
        self._demand, self._began = x_d, simulator.samples
        start, end, aborted = simulator.samples, simulator.samples + len(x_d), ""
        turn = max(1, round(TURN / simulator.dt))
        while simulator.samples < end:
            shown = simulator.advance(min(turn, end - simulator.samples))
            parts.append(shown)
            aborted = aborted or watch.exceeded(shown)
            if aborted and end > simulator.samples and self._demand is x_d:
                self._demand = np.array([held(self._bounds, x_d[simulator.samples - start - 1])])
                end = min(end, simulator.samples + round(HELD / simulator.dt))
        return Ran(Recording(simulator.dt, {key: np.concatenate([part[key] for part in parts])
                                            for key in parts[0]},
                             START_NS + round(start * simulator.dt * 1e9), name), aborted)


LOAD = 0.3  # of the force that the pressure limit allows
CHARGED = 1.5  # times the charge pressure
WARMER = 0.7  # of B: mineral oil some 12 K warmer (Reynolds' law, 0.03 1/K)
SENSORS = {"p1": ("a sensor of the pressure of chamber 1", "pressure"),
           "p2": ("a sensor of the pressure of chamber 2", "pressure"),
           "omega": ("a sensor of the pump speed", "pump_speed"),
           "v": ("a sensor of the velocity", "velocity")}


def otherwise(contest: Contest, x_d: np.ndarray, bounds: Bounds) -> tuple[str, ...]:
    """Return in words what else would tell structures apart, each tried with the same motion.

    Where none of it would, what the catalogue says to look at on the rig.
    """
    now = float(np.sum([one.probability**2 for one in contest.structures]))
    found = []
    for words, experiment, structures in changes(contest, bounds):
        other = Contest(experiment, structures, recorded=False)
        gram = other.told_by(without_noise(demanded(experiment, other.fit, words, x_d), other.fit))
        if gram is None:
            continue
        expected = other.expected(gram)[0]
        if expected > now + WORTH:
            found.append(f"{words} (expected probability {expected:.2f}, without it {now:.2f})")
    if found:
        return tuple(found)
    names = dict.fromkeys(name for one in contest.structures[:3] for name in sorted(one.names)
                          if name in CATALOGUE)
    return tuple(f"at the rig: {CATALOGUE[name].rig_check.rstrip('.')}" for name in names)


def changes(contest: Contest, bounds: Bounds
            ) -> Iterator[tuple[str, Experiment, Sequence[Structure]]]:
    """Yield what may be changed, in words, with the experiment and the structures under it."""
    experiment, structures = contest.experiment, contest.structures
    rig, noise = experiment.settings.rig, experiment.settings.simulation.noise
    force = float(f"{LOAD * rig.area_1 * (bounds.pressure - rig.charge_pressure):.1g}")

    def moved(place: int, factor: float = 1.0, more: float = 0.0, effect: int | None = None
              ) -> list[Structure]:
        """Return the structures with one parameter changed, and perhaps one effect active."""
        found = []
        for one in structures:
            theta, active = one.fit.theta.copy(), one.fit.active.copy()
            theta[place] = factor * theta[place] + more
            if effect is not None:
                active[effect] = True
            found.append(replace(one, fit=replace(one.fit, theta=theta, active=active)))
        return found

    higher = rig.model_copy(update={"charge_pressure": CHARGED * rig.charge_pressure})
    yield (f"a charge pressure of {quantity(higher.charge_pressure, 'Pa', 2)}",
           replace(experiment, settings=experiment.settings.model_copy(update={"rig": higher})),
           moved(s.P_CHARGE, CHARGED))
    yield f"a constant load of {quantity(force, 'N', 1)} on the rod", experiment, moved(
        place_of("constant_load.F_0"), more=force, effect=NAMES.index("constant_load"))
    yield "oil that is some 12 °C warmer", experiment, moved(s.B, WARMER)
    for name, (words, level) in SENSORS.items():
        column = OUTPUTS.index(name)
        if experiment.used[column]:
            continue
        used, levels = experiment.used.copy(), experiment.noise.copy()
        used[column], levels[column] = True, getattr(noise, level)
        there = replace(experiment, used=used, noise=levels)
        yield words, there, [replace(one, fit=seen(there, one.fit)) for one in structures]


def seen(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit with the gains and innovations of other sensors, the rig at rest."""
    x = float(np.nanmean(experiment.stretches[0].z[:, 0]))
    rest = demanded(experiment, fit, "rest", np.full(len(experiment.stretches[0]), x))
    return with_unknowns(simulated(rest, fit), fit, fit.unknowns)


DECIDED, INSEPARABLE, TIME, ABORTED = "decided", "inseparable", "time", "aborted"
LIMITS = "limits"
BALANCES = "balances"
FOLLOWS = 0.05  # of a demand: a piston that moves by less does not follow it
FEW = 0.05  # probability of all rivals together, below which what has no model yet is looked for


@dataclass(frozen=True)
class Round:
    """One motion, and what is known after it."""

    # planned, ran: the motion, and what came of it
    planned: Planned
    ran: Ran
    seconds: float  # of motion so far, this one included
    # of all recordings so far; None where the motion was aborted
    diagnosis: Diagnosis | None = None
    # names, probability: the set that stands, and its probability; ``rivals`` the others from 1 %
    # on, the most probable first
    names: Names = frozenset()
    probability: float = np.nan
    rivals: dict[Names, float] = field(default_factory=dict)
    # the motion that is planned next, or None; ``end`` then says why
    following: Planned | None = None
    end: str = ""
    would: tuple[str, ...] = ()  # what would tell the rest apart, in words, where no motion does


def identify(rig: Rig, planner: Planner,
             check: Callable[[Recording], Checked] = lambda recording: (recording, ()),
             report: Report | None = None) -> Iterator[Round]:
    """Run motions until a set of effects has the probability asked for, or none can get it.

    Yields a round after each motion; the last one has an ``end``.  Raises InputError if the
    limits allow no motion, or what came cannot be diagnosed.

    Parameters
    ----------
    rig : what moves; ``planner`` knows config, limits and the probability asked for.
    check : of each recording before it is diagnosed; returns it as it is to be used, and what
        its channels say about the config; raises what is wrong with it.
    report : told what is done and how far it is, 0 to 1.
    """
    say = report or silent
    say("planning the first motion", 0.0)
    planned: Planned | None = planner.first(rig.position())
    recordings: list[Recording] = []
    known: list[Fit] = []
    motions: list[Planned] = []
    channels: dict[tuple[str, tuple[str, ...]], ChannelFinding] = {}
    seconds, before = 0.0, None
    while planned is not None:
        number = len(motions) + 1
        say(f"motion {number}: {planned.motion.words}", 0.0)
        ran = rig.run(planned.x_d, f"motion_{number:02d}")
        seconds += ran.recording.duration
        if ran.aborted:
            yield Round(planned, ran, seconds, end=ABORTED)
            return
        usable, said = check(ran.recording)
        recordings.append(usable)
        channels |= {(one.kind, one.channels): one for one in said}
        motions.append(planned)
        answer = diagnose_and_name(recordings, planner.settings, say, known)
        answer = answer._replace(diagnosis=replace(
            answer.diagnosis, channels=(*channels.values(), *answer.diagnosis.channels)))
        # A rest alone may show nothing, and so may a motion that is too quick.
        if answer.diagnosis.verdict == "insufficient_data" and not follows(
                planned.x_d, ran.recording):
            raise InputError(f"{ran.recording.source}: {answer.diagnosis.message}; expected a "
                             "piston that follows the command")
        one = judged(planned, ran, seconds, answer)
        if answer.naming is not None:
            known = [fit for names, fit, _ in answer.naming.tried if names]
            one = following(planner, answer.naming, one, rig.position())
        elif (now := said_by(answer.diagnosis)) != before:
            # No set explains it yet: another motion may show what is missing.
            before = now
            one = replace(one, following=planner.best(
                planner.blank, rig.position(), planner.bounds.total_time - seconds,
                [one.motion.name for one in motions]))
        if one.following is None and not answer.by_filter:
            one = by_least_squares(one)
        planned = one.following
        yield one


def said_by(found: Diagnosis) -> tuple[str, frozenset[str]]:
    """Return verdict and names of an answer."""
    return found.verdict, frozenset(
        [one.name for one in found.effects] + [one.key for one in found.rig_data])


def follows(x_d: np.ndarray, recording: Recording) -> bool:
    """Tell whether the piston has moved by ``FOLLOWS`` of what was demanded, (n,) m."""
    x = recording.channels.get("x", np.zeros(1))
    return bool(np.nanmax(x) - np.nanmin(x) >= FOLLOWS * np.ptp(x_d))


def judged(planned: Planned, ran: Ran, seconds: float, answer: Answered) -> Round:
    """Return what is known after a motion.

    Nothing stands beside a verdict that something without a name is there, or where least squares
    on the balances answer instead of a filter.
    """
    sets = standing(answer.naming) if answer.naming else {}
    stands = answer.by_filter and answer.diagnosis.verdict != "unexplained"
    order = [names for names in sets if stands] or [frozenset()]
    return Round(planned, ran, seconds, answer.diagnosis, order[0],
                 sets[order[0]] if order[0] in sets and stands else 0.0,
                 {names: sets[names] for names in order[1:] if sets[names] >= 0.01})


def by_least_squares(one: Round) -> Round:
    """Return the last round where least squares on the balances answer: they plan no motion.

    A set is as probable as its least probable effect, or as that nothing is missing.  It is never
    decided: a filter sees more there, of sensors and drive as well, and no set explains it.
    """
    found = one.diagnosis
    sure = {"mismatch": min((effect.probability for effect in found.effects), default=0.0),
            "consistent": found.probability.get("consistent", 0.0)}.get(found.verdict, 0.0)
    return replace(one, names=frozenset(effect.name for effect in found.effects),
                   probability=sure, rivals={}, end=BALANCES, would=found.advice)


def following(planner: Planner, naming: Naming, now: Round, position: float) -> Round:
    """Return a round with the motion to run next; or why there is none."""
    if now.probability >= planner.wanted:
        return replace(now, end=DECIDED)
    structures = running(naming)
    if 1.0 - structures[0].probability < FEW:  # what else may be there has no model yet
        structures = beside(naming.experiment, structures[0])
    contest = Contest(naming.experiment, structures, explained=naming.evidence)
    planned = planner.best(contest, position, planner.bounds.total_time - now.seconds)
    if planned is None:
        binds = planner.binding.most_common(1)
        if not binds or planner.binding[TOTAL]:
            return replace(now, end=TIME)
        return replace(now, end=LIMITS, would=(binds[0][0],))
    if planned.at_last > planned.now + WORTH:
        return replace(now, following=planned)
    return replace(now, end=INSEPARABLE, would=otherwise(contest, planned.x_d, planner.bounds))


SCHEMA = "eha_monitor/identify/1"


def set_words(names: Names) -> str:
    """Return a set of effects and numbers of the rig: ``Coulomb friction and another mass``."""
    return listed([f"another {effect_words(name.removeprefix('rig.'))}"
                   if name.startswith("rig.") else effect_words(name)
                   for name in sorted(names)]) or "nothing beyond the config"


def percent(probability: float) -> str:
    """Return a probability in per cent, never quite 0 or 100."""
    if not math.isfinite(probability):
        return "—"
    return f"{min(max(100.0 * probability, 0.1), 99.9):.1f} %"


def plan_words(planned: Planned, dt: float) -> str:
    """Return what is to be moved, and why."""
    text = (f"{motion_sentence(planned.motion)} ({number(len(planned.x_d) * dt, 3)} s with the "
            "way to it)")
    if planned.pair is not None:
        one, other = map(set_words, planned.pair)
        text += f", to distinguish {one} from {other} (by {odds(max(planned.log_units, 0.0))})"
    return (f"{text}; probability of the right set of effects: now {percent(planned.now)}, "
            f"expected after it {percent(planned.expected)}")


def round_words(one: Round, count: int, dt: float) -> str:
    """Return what stands after a motion, with which probability, and what is next and why."""
    what = one.planned.motion.words.replace("the speed of this recording", "full speed")
    head = f"motion {count}, {what}, {number(one.seconds, 3)} s so far"
    if one.diagnosis is not None:
        head += f", diagnosed in {one.diagnosis.wall_s:.0f} s"
    head += ": "
    if one.end == ABORTED:
        return f"{head}aborted: {one.ran.aborted}; the position demanded last is held"
    if one.diagnosis is not None and one.diagnosis.verdict == "unexplained":
        head += "something that is not in the catalogue"
    elif not one.probability > 0.0:
        head += "no set of effects explains all that the filter sees yet"
        if one.diagnosis is not None and one.end != BALANCES:
            head += f"; least squares on the balances: {one.diagnosis.message}"
    else:
        head += f"{set_words(one.names)}, {percent(one.probability)}"
    if one.rivals:
        head += "; else " + ", ".join(f"{set_words(names)} {percent(value)}"
                                      for names, value in list(one.rivals.items())[:3])
    if not one.end:
        return f"{head}. Next: {plan_words(one.following, dt)}"
    would = f"; what would: {'; '.join(one.would)}" if one.would else ""
    return f"{head}. " + {
        DECIDED: "Decided",
        LIMITS: "By the models that may yet be right no motion keeps the limits; what binds is "
                f"{''.join(one.would)}",
        TIME: "The time is up: no motion fits into what is left of it",
        BALANCES: "This is the answer of least squares on the balances: no set of effects "
                  "explains all that the filter sees, so that no motion can be planned to decide "
                  f"between them{''.join(f'; {line}' for line in one.would)}",
        INSEPARABLE: f"No motion within the limits distinguishes what is left{would}"}[one.end]


def planned_tree(planned: Planned, dt: float) -> dict:
    """Return a planned motion as plain data."""
    return {"name": planned.motion.name, "words": motion_sentence(planned.motion),
            "duration_s": len(planned.x_d) * dt, "excitation": excitation_tree(planned.motion),
            "expected_probability": planned.expected, "probability_now": planned.now,
            "between": None if planned.pair is None else [sorted(one) for one in planned.pair],
            "log_units": planned.log_units,
            "predicted": {key: -value if key == "lower" else value
                          for key, value in planned.peaks.items()}}


def tree(rounds: list[Round], bags: list[str], bounds: Bounds, wanted: float, dt: float) -> dict:
    """Return an experiment as plain data, without its diagnosis."""
    last = rounds[-1]
    return {
        "schema": SCHEMA, "end": last.end, "aborted": last.ran.aborted, "bags": bags,
        "names": sorted(last.names), "probability": last.probability, "wanted": wanted,
        "motion_s": last.seconds, "would": last.would,
        "limits": {key: getattr(bounds, key) for key in (*NEEDED, "motion_time", "total_time")},
        "rounds": [{"motion": planned_tree(one.planned, dt), "seconds": one.seconds,
                    "aborted": one.ran.aborted,
                    "verdict": one.diagnosis and one.diagnosis.verdict,
                    "names": sorted(one.names), "probability": one.probability,
                    "rivals": [{"names": sorted(names), "probability": value}
                               for names, value in one.rivals.items()]} for one in rounds]}
