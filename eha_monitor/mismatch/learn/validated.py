"""What is said of a learned term: curve and band, formula, and how it fares on unseen data.

And the user's hypothesis, in the same ranking as all that has a name, by the same likelihood.
"""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import LearnedTerm, NamedEffect, SignalFit, Value
from eha_monitor.mismatch.learn.formula import (
    RIPPLES,
    SHAPES,
    SHOWN,
    Formula,
    constants_in,
    curve_of,
    formulas_of,
    in_signal,
    unit_of,
)
from eha_monitor.mismatch.learn.learned import (
    Form,
    Learned,
    alone,
    bases_of,
    free_slot,
    learned_of,
    score_of,
    signal_along,
    with_own,
)
from eha_monitor.mismatch.likelihood.along import contributed
from eha_monitor.mismatch.likelihood.fit import Fit, Free, spread
from eha_monitor.mismatch.locate.terms import Missing, modelled_flow, modelled_force, needed
from eha_monitor.mismatch.name.naming import Naming, beyond_form
from eha_monitor.mismatch.name.refit import looked, settled
from eha_monitor.mismatch.show.held_out import shown, unseen_gates
from eha_monitor.mismatch.show.model import robust
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import ALL_NAMES, slot_of
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.own_term import OF_UNITS, parsed
from eha_monitor.quantity import quantity
from eha_monitor.settings.hypothesis import Hypothesis
from eha_monitor.settings.own_terms import slot_for

PLACES = 161  # of a drawn curve
BINS, FEWEST = 41, 15  # of what was measured; samples in one
LARGEST = 0.98  # quantile of a term's size that counts as its largest
ACTS = {"none": "", "direction": " and acts against the motion", "v": " and of the velocity",
        "dp": " and of the pressure difference", "omega": " and of the speed of the shaft"}
WHAT = {"force": "force", "flow": "flow between the chambers", "flow_1": "flow into chamber 1",
        "flow_2": "flow into chamber 2", "speed": "shaft speed"}


@dataclass(frozen=True)
class ValidatedTerm:
    """A model with a term that no catalogue has, which holds on unseen data."""

    # The model that runs, with the formula where one is given; its names are ``fit.named``
    fit: Fit
    signals: dict[str, SignalFit]  # errors on unseen data, of the nominal model and of this one
    missing: Missing  # the term along the recording, measured and modelled
    gained: float  # log units over the best model without it
    decides: bool  # it explains more than the form error of what was named can be
    entry: dict  # of a config's ``effects``
    name: str  # of it there
    term: LearnedTerm | None = None  # the record of a learned one
    effect: NamedEffect | None = None  # the record of the user's own


def validated_term(experiment: Experiment, unseen: Experiment, naming: Naming
                   ) -> ValidatedTerm | None:
    """Learn what has no name; None where no model of it holds on data that no fit has seen.

    ``unseen`` : with held-out samples, or another recording of the rig.
    """
    learned = learned_of(experiment, naming)
    if learned is None:
        return None
    judged = shown(unseen, learned.without, learned.fit)
    share, signals = removed(judged), shown(unseen, naming.before, learned.fit)
    policy = experiment.policy
    if not share >= policy.likely or unseen_gates(judged, policy) or unseen_gates(signals, policy):
        return None
    learned = replace(learned, fit=robust(experiment, learned.fit))
    formulas = formulas_of(experiment, learned)
    # As any law a formula is right to a share of what it explains; a table follows the rest, too.
    least = learned.evidence - policy.law * max(learned.gained, 0.0)
    fit, honest = learned.fit, bool(formulas) and formulas[0].evidence > least
    if honest:
        # A formula may be all that a name and the rest of a table were together.
        fit = robust(experiment, alone(experiment, formulas[0].fit))
        signals = shown(unseen, naming.before, fit)
        share = removed(shown(unseen, learned.without, fit))
    missing = missing_of(experiment, fit, learned.which, learned.balance)
    term = term_of(learned, formulas, honest, share, missing,
                   factors_of(experiment, learned, fit, missing))
    return ValidatedTerm(fit, signals, missing, learned.gained, learned.decides, term.entry,
                         f"learned_{term.adds}", term=term)


def removed(signals: dict[str, SignalFit]) -> float:
    """Return the share of the squared error beyond the noise that is gone, all signals; <= 1."""
    pairs = [(fit.before_rms / fit.noise_rms, fit.after_rms / fit.noise_rms)
             for fit in signals.values() if fit.noise_rms > 0]
    before = sum(max(one**2 - 1.0, 0.0) for one, _ in pairs)
    after = sum(max(other**2 - 1.0, 0.0) for _, other in pairs)
    return 1.0 - after / before if before > 0.0 else 0.0


def missing_of(experiment: Experiment, fit: Fit, which: int, balance: str) -> Missing:
    """Return a model's own term along the recording, as measured and as modelled.

    ``measured`` is what the record needs when the term is switched off, at the B and beta_e that
    stand beside it.
    """
    active = fit.active.copy()
    active[which] = False
    lacking = needed(experiment, replace(fit, active=active), balance)
    return replace(lacking, modelled=tuple(
        made_by(experiment, fit, which, balance, track) for track in lacking.tracks))


def factors_of(experiment: Experiment, learned: Learned, fit: Fit, missing: Missing
               ) -> tuple[np.ndarray, ...]:
    """Return what a curve of one would make along the recording, (n,) for each stretch."""
    ones = fit.theta.copy()
    ones[slot_of(learned.which)] = slot_for({**learned.entry(), "values": [1.0] * learned.count})
    return tuple(made_by(experiment, replace(fit, theta=ones), learned.which, learned.balance,
                         track) for track in missing.tracks)


def made_by(experiment: Experiment, fit: Fit, which: int, balance: str, track: np.ndarray
            ) -> np.ndarray:
    """Return the force, flow or speed that an own term makes along a trajectory, (n,)."""
    fit = replace(fit, named=tuple(name for name in fit.named if name in CATALOGUE))
    name = (ALL_NAMES[which],)
    if balance == "force":
        return modelled_force(experiment, fit, track, name)
    if balance == "flow":
        return modelled_flow(experiment, fit, track, name)
    return contributed(experiment, fit.theta, track, name)[:, s.SPEED]


def size_of(missing: Missing) -> str:
    """Return how much a term does at its largest, in words."""
    return quantity(float(np.quantile(np.abs(np.concatenate(missing.modelled)), LARGEST)),
                    missing.unit, 3)


def measured_at(learned: Learned, missing: Missing, factors: tuple[np.ndarray, ...]
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places, values and spread of a curve as the recording shows it, (k,) each.

    In each bin of the signal the value g that makes ``g * factor`` nearest to the missing term.
    """
    table = learned.table
    at = np.concatenate([signal_along(track, table.form.of) for track in missing.tracks])
    if table.form.periodic:
        at = table.first + np.mod(at - table.first, table.last - table.first)
    what, factor = np.concatenate(missing.measured), np.concatenate(factors)
    edges = np.linspace(table.first, table.last, BINS + 1)
    which = np.digitize(at, edges) - 1
    rows = []
    for i in range(BINS):
        here = (which == i) & np.isfinite(what) & np.isfinite(factor)
        power = float(factor[here] @ factor[here])
        if here.sum() < FEWEST or not power > 0.0:
            continue
        value = float(factor[here] @ what[here]) / power
        left = what[here] - value * factor[here]
        spread = np.sqrt(np.mean(left**2) / (power / here.sum()))
        rows.append((0.5 * (edges[i] + edges[i + 1]), value, spread))
    return tuple(np.array(rows).T) if rows else (np.zeros(0),) * 3


def signals_of(form: Form) -> tuple[str, ...]:
    """Return the signals that a form is a function of, its curve's first."""
    factor = {"direction": "v", "none": form.of}.get(form.times, form.times)
    return tuple(dict.fromkeys((form.of, factor)))


def statement_of(form: Form, formula: str, size: str) -> str:
    """Return what a learned term is, in words.

    ``formula`` : "" where none says as much as its curve; ``size`` at its largest.
    """
    law = f", {formula}" if formula else (
        f" that is a function of {SHOWN.get(form.of, form.of)}{ACTS[form.times]}")
    return f"an unknown {WHAT[form.adds]}{law}, {size} at its largest"


def term_of(learned: Learned, formulas: list[Formula], honest: bool, share: float,
            missing: Missing, factors: tuple[np.ndarray, ...]) -> LearnedTerm:
    """Return the record of a learned term."""
    form = learned.table.form
    x = np.linspace(learned.table.first, learned.table.last, PLACES)
    curve, band = learned.curve(x)
    divisor = learned.divisor
    best = formulas[0] if formulas else None
    drawn = np.full(len(x), np.nan)
    if best is not None:
        shape = next(shape for shape in (*SHAPES, *RIPPLES) if shape.name == best.shape)
        drawn = curve_of(in_signal(shape.text, form.of), best.values, form.of, x)
    at, measured, spread = measured_at(learned, missing, factors)
    size = size_of(missing)
    formula = best.shown if honest else ""
    reference = best.evidence if honest else learned.evidence
    rivals = formulas[1:] if honest else formulas
    return LearnedTerm(
        learned.balance, form.adds, signals_of(form), statement_of(form, formula, size), size,
        unit_of(form, "y"), OF_UNITS[form.of], x, curve / divisor,
        band / divisor, at, measured / divisor, spread / divisor, formula,
        best.shape if honest else "",
        tuple((one.shown, reference - one.evidence) for one in rivals), drawn, share,
        learned.gained, best.entry(form.adds) if honest else learned.entry())


GOING = 2  # starts that are fitted to the end
SHARES = (0.15, 0.5, 0.85)  # of the way from bound to bound: where a parameter is tried besides


@dataclass(frozen=True)
class Tested:
    """A hypothesis fitted to a recording."""

    hypothesis: Hypothesis
    which: int  # place of its own term
    fit: Fit  # the model with it
    without: Fit  # the best one without it
    gained: float  # log units over that one, prior odds included
    temper: float  # of them, how much counts
    values: dict[str, float]  # its parameters, SI

    @property
    def probability(self) -> float:
        """Probability that it is there, against the best model without it."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self.temper * self.gained, -600.0, 600.0))))


def tested(experiment: Experiment, naming: Naming, hypothesis: Hypothesis) -> Tested | None:
    """Fit a hypothesis beside what was named, or nothing; None where there is no room for it.

    Fits begin at its start, and where each parameter in turn is elsewhere between its bounds,
    beside the better of the two models without it.
    """
    which = free_slot(experiment)
    if which is None:
        return None
    without = ties.best(bases_of(experiment, naming), lambda fit: score_of(experiment, fit),
                        lambda fit: len(fit.named), ties.SAME_FIT)
    looks = ties.ordered(spread(lambda values: looked(experiment, entered(
        experiment, without, which, hypothesis, values)), starts_of(hypothesis)),
        lambda fit: fit.log_likelihood, within=ties.GUESS)
    best = ties.best(spread(lambda fit: settled(experiment, fit), looks[:GOING]),
                     lambda fit: score_of(experiment, fit), within=ties.SAME_FIT)
    best = alone(experiment, best)
    gained = score_of(experiment, best) + experiment.policy.effect - score_of(experiment, without)
    return Tested(hypothesis, which, best, without, gained, experiment.policy.temper, {
        key: float(best.theta[at])
        for key, at in constants_in(which, hypothesis.expression).items()})


def starts_of(hypothesis: Hypothesis) -> list[dict[str, float]]:
    """Return where fits begin: parameter -> value, SI."""
    first = {key: one.start for key, one in hypothesis.parameters.items()}
    found = [first]
    for key, one in hypothesis.parameters.items():
        for share in SHARES:
            value = (one.lower * (one.upper / one.lower) ** share if one.log
                     else one.lower + share * (one.upper - one.lower))
            found.append({**first, key: value})
    return found


def entered(experiment: Experiment, base: Fit, which: int, hypothesis: Hypothesis,
            values: dict[str, float]) -> Fit:
    """Return a model with the hypothesis at some values of its parameters, not yet refitted."""
    free = []
    for key, at in constants_in(which, hypothesis.expression).items():
        one = hypothesis.parameters[key]
        prior, width = (float(np.log(one.start)), 0.5 * float(np.log(one.upper / one.lower))) \
            if one.log else (one.start, 0.5 * (one.upper - one.lower))
        free.append(Free(f"{ALL_NAMES[which]}.{key}", at, one.lower, one.upper, prior, width,
                         one.log))
    return with_own(experiment, base, which, parsed(hypothesis.expression).slot(
        hypothesis.adds, values), free)


def supported(experiment: Experiment, unseen: Experiment, naming: Naming, test: Tested
              ) -> ValidatedTerm | None:
    """Return the model with a hypothesis, if it is likely and holds on unseen data."""
    judged = shown(unseen, test.without, test.fit)
    policy = experiment.policy
    if not test.probability > policy.likely or unseen_gates(judged, policy):
        return None
    # What takes away a small part only, and leaves the rest without a name, is no answer.
    rest = beyond_form(experiment, naming.before, test.fit, test.fit.unknowns)
    if rest > policy.likely and removed(judged) < policy.likely:
        return None
    fit = robust(experiment, test.fit)
    signals = shown(unseen, naming.before, fit)
    if unseen_gates(signals, policy):
        return None
    missing = missing_of(experiment, fit, test.which, test.hypothesis.balance)
    return ValidatedTerm(fit, signals, missing, test.gained, True,
                         test.hypothesis.entry(test.values), test.hypothesis.name,
                         effect=effect_of(test, fit, size_of(missing)))


def effect_of(test: Tested, fit: Fit, size: str) -> NamedEffect:
    """Return the record of a hypothesis that is supported; ``fit`` with its covariance."""
    hypothesis, own = test.hypothesis, ALL_NAMES[test.which]
    parameters = {key: Value(value, fit.stddev(f"{own}.{key}"), hypothesis.parameters[key].unit)
                  for key, value in test.values.items()}
    numbers = {key: quantity(value.value, value.unit, 3) for key, value in parameters.items()}
    sentence = hypothesis.sentence.format(**numbers) or (
        f"{hypothesis.name.replace('_', ' ')}: "
        + ", ".join(f"{key} = {text}" for key, text in numbers.items()))
    return NamedEffect(hypothesis.name, hypothesis.balance, sentence, parameters, test.gained, (),
                       hypothesis.expression, hypothesis.check, size, test.probability)
