"""The next motion: what it is expected to tell between the structures still in the running."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from eha_monitor import ties
from eha_monitor.errors import InputError
from eha_monitor.mismatch.advise.identifiability import effects_for
from eha_monitor.mismatch.advise.motions import (
    USED,
    Limits,
    Motion,
    candidates,
    demand_of,
    demanded,
    resized,
    without_noise,
)
from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.data.inputs import CLOSED
from eha_monitor.mismatch.likelihood.fit import Fit, free_run
from eha_monitor.mismatch.likelihood.information import Gram, Slope, Traces, free_slopes, gain_of
from eha_monitor.mismatch.name.candidates import all_named, candidate, log_prior
from eha_monitor.mismatch.name.naming import Names, Naming
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.mismatch.name.posterior import counted
from eha_monitor.mismatch.name.starts import own_sizes, starts_of, with_effect
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.simulator import Simulator
from eha_monitor.quantity import quantity
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Experiment as Bounds
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Segment

MOST = 5  # structures that a motion is to tell apart
MARGIN = 0.8  # of each limit, that a predicted motion may take
SAFE_UNDER = 3  # most probable structures, whose own predictions must keep the limits
SIGMAS = 3.0  # standard deviations of B and beta_e that the limits must bear
SURE, UNSURE = 1.05, 1.8  # factors on B and beta_e that they bear at least and at most
TIGHT = 0.05  # of the configured leakage: of that only the order of magnitude is known
ALIKE = 0.02  # expected probability within which the shorter motion is better
WORTH = 0.05  # expected probability: a motion that promises less tells nothing
WAIT = 0.3  # s at rest before a motion and after it
PACE = 0.5  # of the limits of speed and acceleration on the way to where a motion begins
RUNS_AWAY = 2.0  # times a limit in a motion that was made small enough for it
FAR_OFF = 1e3  # times a limit: no motion of any size that limits allow
UNSTABLE = ("the model of the config: with B or the effective bulk modulus a few times off, as "
            "far as is known, its position loop runs away (check position_gain, or diagnose a "
            "recording and take that config)")
ATTEMPTS = 5  # at a size that keeps the limits
SMALLEST = 0.02  # of a motion's size: below, there is nothing left of it
SEEN = 10.0  # standard deviations of the position's noise: a smaller motion shows nothing


@dataclass(frozen=True)
class Structure:
    """A set of effects and wrong numbers of the rig, its model, and how probable it is."""

    names: Names
    fit: Fit
    probability: float


@dataclass(frozen=True)
class Planned:
    """A motion within the limits."""

    motion: Motion  # what is demanded, without the way to where it begins
    x_d: np.ndarray  # (n,) m, one value to a sample: way, rest, motion, rest
    # probability that the right structure is expected to have after it; ``now`` before,
    # ``at_last`` after as many as there is time for of the motion that then tells most
    expected: float = np.nan
    now: float = np.nan
    at_last: float = np.nan
    # s of it until the right structure is expected to stand; inf if not in time
    until: float = np.inf
    # the two structures that it is to tell apart first, or None; ``log_units`` between them with
    # what is there already, expected
    pair: tuple[Names, Names] | None = None
    log_units: float = np.nan
    # limit -> largest value that any likely structure predicts, SI; ``shown`` (n, N_OUTPUTS) what
    # the first predicts
    peaks: dict[str, float] = field(default_factory=dict)
    shown: np.ndarray | None = None


def standing(naming: Naming) -> dict[Names, float]:
    """Return the probability of each set as an answer, the most probable first.

    A set that only adds to another, and that the data give no more than its prior, is no rival
    of it: no recording excludes an effect of size zero, or a Stribeck drop of none beside Coulomb
    friction.  Its probability is the other's.  Nor is a set in which a number of the rig stands
    for the effect that has the same equation.  Nor one that nobody fitted, in which another law of
    a family stands for the best set's: that is one claim, as in the diagnosis.
    """
    same: dict[Names, list[Names]] = {}
    for names in naming.weights:
        same.setdefault(frozenset(map(TWINS.get, names, names)), []).append(names)
    found = {ties.best(group, naming.weights.get, sorted): sum(map(naming.weights.get, group))
             for group in same.values()}
    best, fitted = ties.best(found, found.get, sorted), {names for names, *_ in naming.tried}
    for names in sorted(found, key=lambda names: (-size(names), sorted(names))):
        if not names or not all_named(names):
            continue
        if not best <= names and names not in fitted and all(
                one in names or names & candidate(one).kin for one in best):
            found[best] += found.pop(names)
            continue
        less = [some for some in found if some != names and within(some, names)
                and found[names] <= found[some] * np.exp(
                    log_prior(names, POLICY) - log_prior(some, POLICY))]
        if less:
            found[ties.best(less, found.get, sorted)] += found.pop(names)
    return {names: found[names] for names in ties.ordered(found, found.get, sorted)}


# Effect -> number of the rig that has the same equation.
TWINS = {name: f"rig.{effect.rig_twin}" for name, effect in CATALOGUE.items() if effect.rig_twin}


def size(names: Names) -> int:
    """Return of how many laws a set is made, those that its members contain included."""
    return sum(1 + len(CATALOGUE[name].contains) if name in CATALOGUE else 1 for name in names)


def within(some: Names, names: Names) -> bool:
    """Tell whether a set is another one with some sizes zero."""
    return all(one in names or any(one in CATALOGUE[name].contains for name in names
                                   if name in CATALOGUE) for one in some)


def running(naming: Naming) -> list[Structure]:
    """Return the structures that were fitted and are still in the running, the best first."""
    gone = naming.weights.keys() - standing(naming).keys()
    rows = [(names, fit, float(np.exp(-behind))) for names, fit, behind in naming.tried
            if names not in gone]
    best = frozenset(naming.after.named) | {f"rig.{key}" for key in naming.wrong}
    rows.sort(key=lambda row: row[0] != best)
    whole = sum(weight for _, _, weight in rows[:MOST])
    return [Structure(names, fit, weight / whole) for names, fit, weight in rows[:MOST]]


def first_look(settings: Settings, bounds: Bounds) -> tuple[Experiment, list[Structure]]:
    """Return the rig as the config has it, and what may be missing there, all equally probable.

    Nothing is recorded yet: the sensors are those of ``simulation.publish``, with
    ``simulation.noise``.  Raises InputError if the config publishes too little to plan with.
    """
    middle, reach = 0.5 * (bounds.lower + bounds.upper), 0.5 * (bounds.upper - bounds.lower)
    period = max(2.0, 2.0 * np.pi * reach / (0.5 * bounds.speed))
    sine = Segment(kind="sine", duration=period, frequency=1.0 / period, offset=middle,
                   amplitude=0.5 * reach)
    there = settings.model_copy(update={"simulation": settings.simulation.model_copy(
        update={"excitation": {"sine": sine}, "faults": {}})})
    simulator = Simulator(there)
    recording = Recording(simulator.dt, simulator.batch(round(period / simulator.dt)),
                          source="config")
    experiment = experiment_of([recording], settings, hold_out=False)
    if experiment.mode != CLOSED or not recording.has("x_d"):
        raise InputError("config: simulation.publish: expected x and x_d, which the position loop "
                         "is planned with")
    experiment, fit = nominal(experiment)
    theta = fit.theta.copy()  # of B and beta_e the config knows more than this motion would tell
    theta[s.B], theta[s.BETA_E] = settings.rig.viscous_damping, settings.rig.bulk_modulus
    fit = replace(fit, theta=theta)
    return experiment, beside(experiment, Structure(frozenset(), fit, 1.0))


def beside(experiment: Experiment, structure: Structure) -> list[Structure]:
    """Return a structure, and it with each further effect at its start, all as probable.

    A start is 1 % of what the effect's balance does.
    """
    found, named = [structure], tuple(n for n in structure.fit.named if n in CATALOGUE)
    for name in effects_for(experiment, replace(structure.fit, named=named), NAMES):
        for start in starts_of(name, experiment)[:1]:
            if not own_sizes(start) or not all(np.isfinite(p.neutral) for p in own_sizes(start)):
                continue  # a limit, or a shape only: it has no size that matters
            fit = with_effect(structure.fit, start, (1.0,) * len(own_sizes(start)))
            # Its size is held: with it free, no data would speak against it.
            found.append(Structure(structure.names | {name}, replace(
                fit, free=structure.fit.free), 1.0))
    return [replace(one, probability=1.0 / len(found)) for one in found]


class Contest:
    """What data tell between structures: expected log evidence of each over each.

    All are seen as moves from the first, in the innovations of its filter; what another
    structure's own parameters can make up for is projected out.

    ``experiment`` is what is recorded, ``here`` what it tells; ``explained`` : effect -> log units
    that the recordings lose without it.
    """

    def __init__(self, experiment: Experiment, structures: Sequence[Structure],
                 recorded: bool = True, explained: Mapping[str, float] | None = None):
        self.experiment, self.structures = experiment, tuple(structures)
        self._same = [(i, j, form_error(one, other, explained or {}))
                      for i, one in enumerate(self.structures)
                      for j, other in enumerate(self.structures) if alike(one, other)]
        self.fit = self.structures[0].fit
        self._base = free_slopes(self.fit)
        shared = {slope.label for slope in self._base}
        self._slopes, self._absorbing = list(self._base), [list(self._base)]
        for i, one in enumerate(self.structures[1:], 1):
            model = one.fit.theta, one.fit.active
            own = tuple(f for f in one.fit.free if f.name not in shared)
            more = free_slopes(replace(one.fit, free=own), model, [f"{i}:{f.name}" for f in own])
            names = {f.name for f in one.fit.free}
            self._absorbing.append([one for one in self._base if one.label in names] + more)
            self._slopes += [Slope(f"set {i}", model), *more]
        self.labels = [slope.label for slope in self._slopes]
        self.here = (Traces(experiment, self.fit, self._slopes).gram(self.labels)
                     if recorded else None)

    def told_by(self, there: Experiment) -> Gram | None:
        """Return what a motion would tell; None where friction sticks, and slopes are none."""
        traces = Traces(there, self.fit, self._slopes, True)
        return traces.gram(self.labels) if traces.straight(self._base) else None

    def between(self, gram: Gram | None) -> np.ndarray:
        """Return the log units by which data that row i makes favour it over column j, (n, n)."""
        n = len(self.structures)
        found = np.zeros((n, n))
        if gram is None:
            return found
        moves = [f"set {i}" for i in range(1, n)]
        for j, slopes in enumerate(self._absorbing):
            left = np.zeros((n, n))
            left[1:, 1:] = gram.remaining(moves, [one.label for one in slopes],
                                          {one.label: one.weight for one in slopes})
            for i in range(n):
                if i != j:
                    found[i, j] = gain_of(left[i, i] + left[j, j] - 2.0 * left[i, j], gram.count)
        return found

    def leads(self, units: np.ndarray, longer: float = 1.0) -> np.ndarray:
        """Return what log units count between sets, as the diagnosis counts them, (n, n).

        Those between laws of one family count only as far as they are more than the form error
        of what the family explains; see :meth:`Refits.scores`.

        ``longer`` : how much more data there are than what is recorded.
        """
        found = -POLICY.temper * np.vectorize(lambda left: counted(left, POLICY))(units)
        for i, j, form in self._same:
            found[i, j] = min(found[i, j], units[i, j] * -np.log(POLICY.rival)
                              / max(longer * form, 1e-9))
        return found

    def expected(self, there: Gram) -> tuple[float, tuple[int, int], np.ndarray]:
        """Return what a motion is expected to leave.

        Returns
        -------
        probability : that the right structure is expected to have, the present ones' weighted.
        pair : the right structure and its rival where most is still to be gained now.
        units : (n, n) as :meth:`between` has them, with the motion.
        """
        now = self.between(self.here)
        then = self.between(there if self.here is None else self.here + there)
        weights = np.array([one.probability for one in self.structures])
        longer = 1.0 if self.here is None else 1.0 + there.count / max(self.here.count, 1)
        gained = self.leads(then, longer) - self.leads(now)
        with np.errstate(over="ignore"):
            odds = weights[None, :] / weights[:, None] * np.exp(-gained)
        np.fill_diagonal(odds, 0.0)
        right = 1.0 / (1.0 + odds.sum(axis=1))
        before = weights[None, :] * weights[:, None] * (1.0 - np.exp(-np.maximum(gained, 0.0)))
        np.fill_diagonal(before, -1.0)
        i, j = np.unravel_index(int(np.argmax(before)), before.shape)
        return float(weights @ right), (int(i), int(j)), then


def alike(one: Structure, other: Structure) -> bool:
    """Tell whether two structures differ in laws of one family only, of which both have one."""
    different = one.names ^ other.names
    return bool(different) and all(
        different <= family and one.names & family and other.names & family
        for family in ({law, *candidate(law).form_kin} for law in different))


def form_error(one: Structure, other: Structure, explained: Mapping[str, float]) -> float:
    """Return how many log units between two laws may be the form error of either."""
    return POLICY.law * max(explained.get(name, 0.0) for name in one.names ^ other.names)


TOTAL = "total_time"  # limit that leaves no motion where the time is up


class Planner:
    """Plans motions of a rig within limits.

    Parameters
    ----------
    bounds : complete limits; ``source`` names the config in errors.
    wanted : probability at which a structure stands.
    """

    def __init__(self, settings: Settings, bounds: Bounds, source: str, wanted: float = 0.95):
        rig = settings.rig
        self.settings, self.bounds, self.source = settings, bounds, source
        # binding: how often which limit left no size of the motions that were planned last
        self.wanted, self.binding = wanted, Counter()
        per_speed = rig.area_1 / rig.pump_displacement
        self.limits = Limits(0.5 * (bounds.lower + bounds.upper),
                             USED * 0.5 * (bounds.upper - bounds.lower), bounds.speed,
                             bounds.speed * per_speed, rig.position_gain,
                             per_speed / rig.position_gain)

    def first(self, position: float) -> Planned:
        """Return the first motion, from a position in m: what most that may be missing shows in.

        Raises InputError if the limits allow none.
        """
        b = self.bounds
        if not b.lower < position < b.upper:
            raise InputError(f"{self.source}: experiment: the piston stands at x = {position:g} "
                             f"m, expected between lower, {b.lower:g} m, and upper, "
                             f"{b.upper:g} m")
        experiment = self.blank.experiment
        found = self.best(self.blank, position, b.total_time)
        if found is None:
            raise InputError(f"{self.source}: experiment: the limits allow no motion of at least "
                             f"{100 * SMALLEST:.0f} % of the travel, and of "
                             f"{quantity(SEEN * experiment.noise[0], 'm', 2)} "
                             f"({SEEN:g} times the noise of the position), within "
                             f"{b.motion_time:g} s from x = {position:g} m; what binds is "
                             f"{self.binding.most_common(1)[0][0]}")
        return found

    @cached_property
    def blank(self) -> Contest:
        """What there may be before anything is recorded."""
        return Contest(*first_look(self.settings, self.bounds), recorded=False)

    def best(self, contest: Contest, position: float, left: float, ran: Collection[str] = ()
             ) -> Planned | None:
        """Return the motion to run next, none of ``ran``; None where none fits into ``left`` s.

        Or none keeps the limits; ``binding`` says then what binds.
        """
        found: list[Planned] = []
        self.binding.clear()
        for motion in candidates(self.limits):
            if motion.name in ran:
                continue
            one = self.within(contest, motion, position)
            if one is None:
                continue
            if len(one.x_d) * contest.experiment.dt > left:
                self._without(TOTAL)
                continue
            gram = contest.told_by(without_noise(
                demanded(contest.experiment, contest.fit, motion.name, one.x_d), contest.fit))
            if gram is None:
                continue
            expected, (i, j), units = contest.expected(gram)
            names = [structure.names for structure in contest.structures]
            seconds = len(one.x_d) * contest.experiment.dt
            after = [expected, *(contest.expected(times(gram, often))[0]
                                 for often in range(2, int(left / seconds) + 1))]
            found.append(replace(one, expected=expected, now=now_of(contest), at_last=after[-1],
                                 until=seconds * next((often for often, value in enumerate(
                                     after, 1) if value >= self.wanted), np.inf),
                                 pair=(names[i], names[j]) if i != j else None,
                                 log_units=float(units[i, j])))
        # Where the limits leave no motion that shows, a rest alone is no experiment.
        if not any(moving(one.motion) for one in found):
            return None
        chosen = most_decisive(found)
        return replace(chosen, at_last=max(chosen.at_last, *(one.at_last for one in found)))

    def within(self, contest: Contest, motion: Motion, position: float) -> Planned | None:
        """Return a motion at a size that keeps every limit; None where there is none.

        It must by the models of the likely structures, with B and beta_e off by what is not known.
        """
        dt, share, least = contest.experiment.dt, 1.0, SEEN * contest.experiment.noise[0]
        binding = "travel"
        recorded = contest.here is not None
        models = [fit for one in contest.structures[:SAFE_UNDER if recorded else 1]
                  for fit in around(one.fit, recorded)]
        for _ in range(ATTEMPTS):
            if any(one.amplitude < least for one in moving(motion)):
                return self._without(binding)
            x_d = self.led(demand_of(motion, dt), position, dt)
            if len(x_d) * dt > self.bounds.motion_time:
                return self._without("motion_time")
            blanks = [demanded(contest.experiment, fit, motion.name, x_d) for fit in models]
            shown = [free_run(blank, blank.stretches[0], fit)
                     for blank, fit in zip(blanks, models, strict=True)]
            peaks = [self.peaks(one, x_d, dt) for one in shown]
            most = {key: max(one[key] for one in peaks) for key in peaks[0]}
            used = self.used(most)
            worst = max(used.values())
            if worst <= 1.0:
                return Planned(motion, x_d, peaks=most, shown=shown[0])
            runs_away = not worst <= (RUNS_AWAY if share < SMALLEST else FAR_OFF)
            binding = UNSTABLE if runs_away else max(used, key=used.__getitem__)
            if not np.isfinite(worst) or share < SMALLEST:
                return self._without(binding)
            share /= worst
            motion = replace(motion, segments={
                name: resized(self.limits, segment, 0.98 / worst, True)
                for name, segment in motion.segments.items()})
        return self._without(binding)

    def _without(self, binding: str) -> None:
        """Note what leaves no size of a motion."""
        self.binding[binding] += 1

    def led(self, x_d: np.ndarray, position: float, dt: float) -> np.ndarray:
        """Return a demand with the way to it from a position, and rest before and after it."""
        b, distance = self.bounds, abs(x_d[0] - position)
        seconds = max(0.5 * np.pi * distance / (PACE * b.speed),
                      np.pi * np.sqrt(0.5 * distance / (PACE * b.acceleration)))
        way = 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, max(2, round(seconds / dt)))))
        rest = round((WAIT + 3.0 * self.limits.loop) / dt)
        return np.concatenate([position + (x_d[0] - position) * way, np.full(rest, x_d[0]), x_d,
                               np.full(rest, x_d[-1])])

    def peaks(self, shown: np.ndarray, x_d: np.ndarray, dt: float) -> dict[str, float]:
        """Return how far a predicted run (n, N_OUTPUTS) goes, SI."""
        return {"lower": -float(min(shown[:, 0].min(), x_d.min())),
                "upper": float(max(shown[:, 0].max(), x_d.max())),
                "speed": float(np.abs(shown[:, 1]).max()),
                "acceleration": float(np.abs(np.gradient(shown[:, 1], dt)).max()),
                "pressure": float(shown[:, 2:4].max())}

    def used(self, peaks: dict[str, float]) -> dict[str, float]:
        """Return the share of what each limit allows, less the margin, that a motion takes."""
        b, middle = self.bounds, self.limits.middle
        charge = self.settings.rig.charge_pressure
        return {"lower": (peaks["lower"] + middle) / self.limits.reach,
                "upper": (peaks["upper"] - middle) / self.limits.reach,
                "speed": peaks["speed"] / (MARGIN * b.speed),
                "acceleration": peaks["acceleration"] / (MARGIN * b.acceleration),
                "pressure": (peaks["pressure"] - charge) / (MARGIN * (b.pressure - charge))}


def moving(motion: Motion) -> list[Segment]:
    """Return the parts of a motion in which it moves."""
    return [one for one in motion.segments.values() if one.kind != "rest"]


def around(fit: Fit, recorded: bool) -> list[Fit]:
    """Return a fit, and it with B and beta_e at the ends of what is known of them.

    Before anything is recorded that is next to nothing: they are what the monitor is there for.
    At those ends hardly anything leaks, as leakage damps the resonance.
    """
    found = [fit]
    wide = [float(np.clip(np.exp(SIGMAS * fit.stddev(name) / fit.value(name)), SURE, UNSURE))
            if recorded and any(f.name == name for f in fit.free) else UNSURE
            for name in ("B", "beta_e")]
    for damping in (1.0 / wide[0], wide[0]):
        for modulus in (1.0 / wide[1], wide[1]):
            theta = fit.theta.copy()
            theta[s.B] *= damping
            theta[s.BETA_E] *= modulus
            theta[[s.C_T, s.G_MAKEUP]] *= TIGHT
            found.append(replace(fit, theta=theta))
    return found


def now_of(contest: Contest) -> float:
    """Return the probability that the right structure has now, on average."""
    weights = np.array([one.probability for one in contest.structures])
    return float(weights @ weights)


def most_decisive(found: Sequence[Planned]) -> Planned:
    """Return the motion that is expected to decide first, of equals the shortest.

    Where none does in the time that is left, the one after which most is expected to be known.
    """
    def plainness(one: Planned) -> tuple[int, int]:
        return len(one.x_d), len(one.motion.segments)

    deciding = [one for one in found if np.isfinite(one.until)]
    if deciding:
        return ties.best(deciding, lambda one: -one.until, plainness)
    return ties.best(found, lambda one: one.expected, plainness, ALIKE)


def times(gram: Gram, often: int) -> Gram:
    """Return what a motion tells that is run so many times."""
    return Gram(gram.labels, often * gram.whole, often * gram.part, often * gram.count,
                often * gram.count_part)
