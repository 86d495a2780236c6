"""The learned term: of which signal it is a function, and its table, fitted in the likelihood.

All forms are weighed from one Gram matrix; the values of the best are fitted beside all that the
model has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import Fit, Free, remade, spread, with_unknowns
from eha_monitor.mismatch.likelihood.gains import smallest_unknowns
from eha_monitor.mismatch.name.before import informative
from eha_monitor.mismatch.name.candidates import log_prior
from eha_monitor.mismatch.name.columns import Column, Columns, Unnamed, columns_at
from eha_monitor.mismatch.name.finalists import CLOSE, lesser
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.nominal import with_rig
from eha_monitor.mismatch.name.proposals import weighed
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.refit import evidence_of, joined, looked, settled, unfitted
from eha_monitor.mismatch.name.select import SKETCH, SKETCH_WINDOW
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.own_term import OWN_NAMES, SCALE, VALUES, cardinal
from eha_monitor.settings.own_terms import slot_for

KNOTS = 9  # of a table when the forms are weighed
COVERED = 0.001  # quantile of the signal at which a table ends: beyond it nothing was measured
MOST_PERIODS, HARMONICS = 24, 2  # of a ripple: in a revolution of the shaft; of each
SHARP = 0.02  # of the largest speed: over which a term that follows the direction turns round
# What a term adds to -> which unknown of the filter stands for it, and its balance.
UNKNOWN = {"force": "force", "flow": "flow", "flow_1": "flow_1", "flow_2": "flow_2",
           "speed": "drive"}
BALANCE = {adds: unknown.partition("_")[0] for adds, unknown in UNKNOWN.items()}


@dataclass(frozen=True)
class Form:
    """A way in which a missing term may depend on the signals; keys of an own term's table."""

    adds: str  # ``force`` N, ``flow``, ``flow_1``, ``flow_2`` m³/s or ``speed`` rad/s
    of: str  # signal of the table
    times: str = "none"  # factor of its value: ``none``, ``direction``, ``v``, ``dp`` or ``omega``

    @property
    def name(self) -> str:
        """Name of its group of columns."""
        return f"learned {self.adds} of {self.of} times {self.times}"

    @property
    def periodic(self) -> bool:
        """Tell whether its table goes round: the shaft's angle begins anew."""
        return self.of == "angle"


def forms_of(experiment: Experiment) -> tuple[Form, ...]:
    """Return the forms that an experiment's channels can tell apart."""
    found = [Form("force", "v"), Form("force", "x"), Form("force", "x", "direction"),
             Form("force", "x", "v")]
    if experiment.mode == FORCED:  # the pressures are the force itself
        return tuple(found)
    found += [Form("force", "p", "direction"), Form("force", "dp", "direction"),
              Form("flow", "dp"), Form("flow", "x"), Form("flow", "v"), Form("flow", "x", "dp"),
              Form("flow_1", "p1"), Form("flow_2", "p2"), Form("flow", "angle", "omega")]
    if experiment.mode == CLOSED:
        found += [Form("speed", "omega"), Form("speed", "x")]
    return tuple(found)


def signal_along(track: np.ndarray, of: str) -> np.ndarray:
    """Return a signal of :data:`own_term.OF` along a trajectory, (n,) SI."""
    if of == "dp":
        return track[:, s.P1] - track[:, s.P2]
    if of == "p":
        return 0.5 * (track[:, s.P1] + track[:, s.P2])
    return track[:, {"x": s.X, "v": s.V, "omega": s.OMEGA, "p1": s.P1, "p2": s.P2,
                     "angle": s.ANGLE}[of]]


def factor_along(track: np.ndarray, times: str, scale: float) -> np.ndarray:
    """Return what a table is multiplied by along a trajectory, (n,)."""
    if times == "direction":
        return np.tanh(track[:, s.V] / scale)
    return np.ones(len(track)) if times == "none" else signal_along(track, times) / scale


@dataclass(frozen=True)
class Table:
    """A form over the range that a recording covers."""

    form: Form
    first: float  # ends of the table, SI
    last: float
    scale: float  # of its factor
    unit: float  # of its values, SI

    def knots(self, count: int) -> np.ndarray:
        """Return the places of its values, (count,) SI."""
        return np.linspace(self.first, self.last, count, endpoint=not self.form.periodic)

    def entry(self, values: np.ndarray) -> dict:
        """Return it with values (n,), SI, as an entry of a config's ``effects``."""
        return {"adds": self.form.adds, "of": self.form.of, "times": self.form.times,
                "scale": self.scale, "first": self.first, "last": self.last,
                "values": values.tolist()}


@dataclass(frozen=True)
class Guess:
    """A table with its curve by the linear guess."""

    table: Table
    evidence: float  # log units
    values: np.ndarray  # (KNOTS,) SI
    # The same guess of all other numbers, at its level of the unknowns
    ranked: Ranked | None = None
    what: tuple[Column, ...] = ()  # whose its columns are


def tables_of(experiment: Experiment, fit: Fit) -> tuple[Table, ...]:
    """Return every form over what the recordings cover."""
    tracks = filtered_tracks(experiment, fit)
    # The prior deviation of a table's values in each balance, SI.
    units = dict(zip(("force", "flow", "drive"), (
        experiment.policy.matters * smallest_unknowns(experiment).as_array()).tolist(),
        strict=True))
    difference = np.abs(np.concatenate([signal_along(track, "dp") for track in tracks]))
    scales = {"direction": max(SHARP * experiment.ranges.speed, 1e-9),
              "v": max(experiment.ranges.speed, 1e-9),
              "dp": max(float(np.quantile(difference, 0.98)), 1e-9)}
    speed = np.abs(np.concatenate([track[:, s.OMEGA] for track in tracks]))
    scales["omega"] = max(float(np.quantile(speed, 0.98)), 1e-9)
    found = []
    for form in forms_of(experiment):
        whole = np.concatenate([signal_along(track, form.of) for track in tracks])
        first, last = np.quantile(whole, [COVERED, 1.0 - COVERED])
        if form.periodic:
            first, last = 0.0, 2.0 * np.pi / periods_of(experiment, fit, tracks)
        if last - first > 1e-6 * np.abs(whole).max():
            found.append(Table(form, float(first), float(last),
                               float(scales.get(form.times, 1.0)), units[BALANCE[form.adds]]))
    return tuple(found)


def periods_of(experiment: Experiment, fit: Fit, tracks: list[np.ndarray]) -> int:
    """Return how often in a revolution of the shaft what a model leaves comes again.

    A pump's flow ripples with its pistons or teeth, in proportion to its speed, with harmonics.
    An innovation is what entered over the sample before it, so the angle in its middle counts.
    """
    angle = experiment.counted([np.concatenate(
        [[0.0], 0.5 * (track[1:, s.ANGLE] + track[:-1, s.ANGLE])]) for track in tracks])
    speed = experiment.counted([track[:, s.OMEGA] for track in tracks])
    left = np.nan_to_num(fit.e / np.nanstd(fit.e, axis=0))
    shares = np.zeros(HARMONICS * MOST_PERIODS + 1)
    for k in range(1, len(shares)):
        waves = speed[:, None] * np.stack([np.cos(k * angle), np.sin(k * angle)], axis=1)
        shares[k] = np.sum((waves.T @ left) ** 2) / max(np.sum(waves**2), 1e-300)
    of = np.arange(1, MOST_PERIODS + 1)
    return int(of[ties.largest(sum(shares[of * h] for h in range(1, HARMONICS + 1)))])


def columns_with(experiment: Experiment, fit: Fit, tables: Sequence[Table]) -> Columns:
    """Return the columns at a fit with those of every knot of tables, a group for each."""
    tracks, terms = filtered_tracks(experiment, fit), []
    for one in tables:
        form = one.form
        terms.append(Unnamed(form.name, UNKNOWN[form.adds], tuple(
            cardinal(signal_along(track, form.of), KNOTS, one.first, one.last, form.periodic)
            * factor_along(track, form.times, one.scale)[:, None] for track in tracks)))
    return columns_at(experiment, fit, suspects=False, terms=terms)


def free_slot(experiment: Experiment) -> int | None:
    """Return the place of an own term that the config leaves free, None where it has all."""
    return next((i for i in range(len(NAMES), len(NAMES) + len(OWN_NAMES))
                 if not experiment.active[i]), None)


def ranked_forms(experiment: Experiment, tables: Sequence[Table], fit: Fit) -> list[Guess]:
    """Return the forms that would gain anything beside a model, best first."""
    by_name = {table.form.name: table for table in tables}
    view = weighed(experiment, frozenset(fit.named), fit,
                   columns_with(experiment, fit, tables), more=1)
    found: dict[str, Guess] = {}
    for one in view.ranking:
        name = next((name for name in one.names if name in by_name), None)
        if name is None or name in found or one.names - {name} != frozenset(fit.named):
            continue
        table = by_name[name]
        values = np.array([value for place, value in sorted(one.amplitudes.items())
                           if view.what[place].owner == name])
        rest = tuple(member for member in one.members if member.owner != name)
        found[name] = Guess(table, one.evidence, table.unit * values,
                            replace(one, members=rest), view.what)
    return ties.ordered(found.values(), lambda guess: guess.evidence,
                        lambda guess: guess.table.form.name, ties.GUESS)


SHARES = (1.0, 0.3, 0.1, 0.0)  # of the way to a linear guess
TRIED = 3  # forms that are looked at from each place, of those weighed
GOING = 3  # forms that are then fitted to the end
MORE = (17, 33)  # values of a table, while the evidence grows
WIDE = 3.0  # times the root mean square of the guess: the prior deviation of a table's values
SHARPEST = 1e-5  # of the largest speed


@dataclass(frozen=True)
class Learned:
    """A model with a learned term."""

    table: Table  # as it was entered
    count: int  # of its values
    which: int  # place of its own term among all effects
    fit: Fit  # the model
    evidence: float  # of it, log units, prior odds of its names included
    without: Fit  # the best model without it
    gained: float  # log units over that
    decides: bool = True  # it explains more than the form error of what was named can be

    @property
    def balance(self) -> str:
        """Balance whose missing part it is."""
        return BALANCE[self.table.form.adds]

    @property
    def values(self) -> np.ndarray:
        """Values at the knots, (count,) SI."""
        start = slot_of(self.which).start + VALUES
        return self.fit.theta[start : start + self.count].copy()

    @property
    def scale(self) -> float:
        """Scale of what the table is multiplied by, in that one's unit."""
        return float(self.fit.theta[slot_of(self.which).start + SCALE])

    @property
    def divisor(self) -> float:
        """What a formula's curve is less than the table's: its factor stands without a scale."""
        return self.scale if self.table.form.times in ("v", "dp", "omega") else 1.0

    @property
    def knots(self) -> np.ndarray:
        """Places of the values, (count,) SI."""
        return self.table.knots(self.count)

    def covariance(self) -> np.ndarray:
        """Return the covariance of the values, (count, count)."""
        names = [f.name for f in self.fit.free]
        places = [names.index(knot_name(self.which, i)) for i in range(self.count)]
        return self.fit.covariance[np.ix_(places, places)]

    def curve(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the curve and its standard deviation at places of the signal, (n,) each."""
        table = self.table
        basis = cardinal(at, self.count, table.first, table.last, table.form.periodic)
        band = np.einsum("ij,jk,ik->i", basis, self.covariance(), basis)
        return basis @ self.values, np.sqrt(np.maximum(band, 0.0))

    def entry(self) -> dict:
        """Return it as an entry of a config's ``effects``."""
        return replace(self.table, scale=self.scale).entry(self.values)


def knot_name(which: int, i: int) -> str:
    """Return the name of a value of an own term's table, as :class:`Free` has it."""
    return f"{ALL_NAMES[which]}.{i}"


def entered_at_best(experiment: Experiment, base: Fit, which: int, guess: Guess) -> Fit:
    """Return a model at a linear guess of the table and of all else, or a shorter way along it."""
    return max((entered(experiment, joined(experiment, base, guess.what, guess.ranked, share),
                        which, guess, share * guess.values) for share in SHARES),
               key=lambda fit: fit.log_likelihood)


def with_own(experiment: Experiment, base: Fit, which: int, numbers: np.ndarray,
             free: Sequence[Free]) -> Fit:
    """Return a model with ``numbers`` in the slot of an own term, not yet refitted.

    ``free`` : how they are fitted, in place of what the model has there.
    """
    theta, active = base.theta.copy(), base.active.copy()
    theta[slot_of(which)], active[which] = numbers, True
    return remade(experiment, base, theta=theta, active=active, free=(
        *(f for f in base.free if f.owner != ALL_NAMES[which]), *free))


def entered(experiment: Experiment, base: Fit, which: int, guess: Guess, values: np.ndarray
            ) -> Fit:
    """Return a model with a table entered, not yet refitted; ``values`` (n,) SI."""
    form, slot = guess.table.form, slot_of(which)
    width = WIDE * max(float(np.sqrt(np.mean(guess.values**2))), 1e-30)
    free = [Free(knot_name(which, i), slot.start + VALUES + i, -1e3 * width, 1e3 * width,
                 0.0, width) for i in range(len(values))]
    if form.times == "direction":
        fastest = max(experiment.ranges.speed, 1e-9)
        free.append(Free(f"{ALL_NAMES[which]}.scale", slot.start + SCALE, SHARPEST * fastest,
                         fastest, float(np.log(guess.table.scale)), experiment.policy.shape, True))
    return with_own(experiment, base, which, slot_for(guess.table.entry(values)), free)


def bases_of(experiment: Experiment, naming: Naming) -> list[Fit]:
    """Return what an own term is fitted beside: what was named, and nothing.

    Wrong numbers of the rig are among the names, and all its numbers are free in both.
    """
    named = replace(naming.after, named=(
        *naming.after.named, *(f"rig.{key}" for key in naming.wrong)))
    return spread(lambda fit: settled(experiment, with_rig(experiment, fit)),
                  [named, naming.before])


def score_of(experiment: Experiment, fit: Fit) -> float:
    """Return the evidence of a model, prior odds of its names included, log units."""
    if not np.isfinite(fit.log_likelihood):
        return -np.inf
    return evidence_of(fit) + log_prior(fit.named, experiment.policy)


def fitted(experiment: Experiment, start: Fit, which: int, guess: Guess, count: int,
           without: Fit) -> Learned:
    """Fit a table of ``count`` values that was entered; ``without`` is the model without it."""
    made = settled(experiment, start)
    score = score_of(experiment, made) + experiment.policy.unnamed
    return Learned(guess.table, count, which, made, score, without,
                   score - score_of(experiment, without))


def finer(experiment: Experiment, coarse: Learned, count: int) -> Learned:
    """Return a learned term with more values, fitted from where it stands."""
    guess = Guess(replace(coarse.table, scale=coarse.scale), coarse.evidence, coarse.values)
    start = entered(experiment, coarse.fit, coarse.which, guess,
                    coarse.curve(coarse.table.knots(count))[0])
    return fitted(experiment, start, coarse.which, guess, count, coarse.without)


def as_fine(experiment: Experiment, best: Learned) -> Learned:
    """Return a learned term with as many values as its evidence asks for."""
    for count in MORE:
        one = finer(experiment, best, count)
        if not one.evidence > best.evidence:
            break
        best = one
    return best


def learned_of(experiment: Experiment, naming: Naming) -> Learned | None:
    """Learn what has no name as a function of one signal; None where no function helps.

    It begins beside the nominal model, and beside what was named: a wrong name bends what is
    left, and a right one leaves less.  Form and number of knots are chosen by evidence.
    """
    which = free_slot(experiment)
    if which is None:
        return None
    bases = bases_of(experiment, naming)
    scores = [score_of(experiment, fit) for fit in bases]
    without = bases[ties.largest(scores, ties.SAME_FIT)]
    # Named laws are right to a share of what they explain, and that is nothing that is missing.
    policy = experiment.policy
    form = policy.form + policy.law * max(scores[0] - scores[1], 0.0)
    # What is left out bends these fits, and what is linear at the config is not so there.
    bases.append(with_rig(experiment, unfitted(experiment)))
    # What a term is a function of shows in a third of the samples, over the range of all of them.
    some = informative(experiment, SKETCH, SKETCH_WINDOW)
    places = [(with_unknowns(some, base), guess) for base in bases
              for guess in ranked_forms(some, tables_of(experiment, base),
                                        with_unknowns(some, base))[:TRIED]]

    def look(place: tuple[Fit, Guess]) -> tuple[float, Fit, Guess]:
        base, guess = place
        made = looked(some, entered_at_best(some, base, which, guess))
        return made.log_likelihood + log_prior(made.named, policy), made, guess

    ahead: dict[Form, tuple[float, Fit, Guess]] = {}
    for one in spread(look, places):
        if one[0] > ahead.get(one[2].table.form, (-np.inf,))[0] + ties.GUESS:
            ahead[one[2].table.form] = one
    going = ties.ordered(ahead.values(), lambda one: one[0], lambda one: one[2].table.form.name,
                         ties.GUESS)[:GOING]
    found = spread(lambda one: fitted(experiment, with_unknowns(experiment, one[1]), which,
                                      one[2], KNOTS, without), going)
    if not found:
        return None
    # A form that is far behind with few values is not the one that more of them would do for.
    ahead_of = max(one.evidence for one in found) - CLOSE
    best = ties.best(spread(lambda one: as_fine(experiment, one), [
        one for one in found if one.evidence >= ahead_of]), lambda one: one.evidence,
        within=ties.SAME_FIT)
    if not best.gained > 0.0:
        return None
    fit = alone(experiment, best.fit)
    evidence = score_of(experiment, fit) + policy.unnamed
    return replace(best, fit=fit, evidence=evidence, decides=best.gained > form,
                   gained=best.gained + evidence - best.evidence)


def alone(experiment: Experiment, fit: Fit) -> Fit:
    """Return a model with a term that no catalogue has, less the names that it can do without."""
    for name in fit.named:
        made = settled(experiment, lesser(experiment, fit, name))
        if score_of(experiment, made) > score_of(experiment, fit):
            fit = made
    return fit
