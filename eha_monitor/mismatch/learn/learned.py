"""The learned term: a table's values fitted in the likelihood, beside all that the model has."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.learn.forms import (
    BALANCE,
    KNOTS,
    Form,
    Guess,
    Table,
    free_slot,
    ranked_forms,
    tables_of,
)
from eha_monitor.mismatch.likelihood.fit import Fit, Free, remade, spread, with_unknowns
from eha_monitor.mismatch.name.candidates import log_prior
from eha_monitor.mismatch.name.informative import informative
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.refit import (
    evidence_of,
    joined,
    looked,
    settled,
    unfitted,
)
from eha_monitor.mismatch.name.select import (
    CLOSE,
    SKETCH,
    SKETCH_WINDOW,
    lesser,
    with_rig,
)
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.own_term import SCALE, VALUES, cardinal
from eha_monitor.settings.own_terms import slot_for

SHARES = (1.0, 0.3, 0.1, 0.0)  # of the way to a linear guess
TRIED = 3  # forms that are looked at from each place, of those weighed
GOING = 3  # forms that are then fitted to the end
MORE = (17, 33)  # values of a table, while the evidence grows
WIDE = 3.0  # times the root mean square of the guess: the prior deviation of a table's values
SHARPEST = 1e-5  # of the largest speed


@dataclass(frozen=True)
class Learned:
    """A model with a learned term.

    Attributes
    ----------
    table : as it was entered; ``count`` of its values, ``which`` place of its own term among all
        effects.
    fit : the model; ``evidence`` of it, log units, prior odds of its names included.
    without : the best model without it; ``gained`` log units over that.
    decides : it explains more than the form error of what was named can be.
    """

    table: Table
    count: int
    which: int
    fit: Fit
    evidence: float
    without: Fit
    gained: float
    decides: bool = True

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

    def places(self) -> list[int]:
        """Return the places of the values in the fit's covariance."""
        names = [f.name for f in self.fit.free]
        return [names.index(knot_name(self.which, i)) for i in range(self.count)]

    def covariance(self) -> np.ndarray:
        """Return the covariance of the values, (count, count)."""
        places = self.places()
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


def entered(experiment: Experiment, base: Fit, which: int, guess: Guess, values: np.ndarray
            ) -> Fit:
    """Return a model with a table entered, not yet refitted; ``values`` (n,) SI."""
    form, slot = guess.table.form, slot_of(which)
    theta, active = base.theta.copy(), base.active.copy()
    theta[slot] = slot_for(guess.table.entry(values))
    active[which] = True
    width = WIDE * max(float(np.sqrt(np.mean(guess.values**2))), 1e-30)
    free = tuple(Free(knot_name(which, i), slot.start + VALUES + i, -1e3 * width, 1e3 * width,
                      0.0, width) for i in range(len(values)))
    if form.times == "direction":
        fastest = max(experiment.ranges.speed, 1e-9)
        free += (Free(f"{ALL_NAMES[which]}.scale", slot.start + SCALE, SHARPEST * fastest,
                      fastest, float(np.log(guess.table.scale)), experiment.policy.shape, True),)
    return remade(experiment, base, theta=theta, active=active, free=base.free + free)


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
    return evidence_of(experiment, fit) + log_prior(fit.named, experiment.policy)


def fitted(experiment: Experiment, start: Fit, which: int, guess: Guess, count: int,
           without: Fit) -> Learned:
    """Fit a table of ``count`` values that was entered; ``without`` is the model without it."""
    made = settled(experiment, start)
    score = score_of(experiment, made) + experiment.policy.unnamed
    return Learned(guess.table, count, which, made, score, without,
                   score - score_of(experiment, without))


def finer(experiment: Experiment, coarse: Learned, count: int) -> Learned:
    """Return a learned term with more values, fitted from where it stands."""
    places = coarse.table.knots(count)
    guess = Guess(replace(coarse.table, scale=coarse.scale), coarse.evidence, coarse.values)
    plain = replace(coarse.fit, free=tuple(
        f for f in coarse.fit.free if f.owner != ALL_NAMES[coarse.which]))
    start = entered(experiment, plain, coarse.which, guess, coarse.curve(places)[0])
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
