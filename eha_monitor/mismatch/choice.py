"""Choice among the candidates of a round: enough evidence, a size that matters, rivals."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.contest import CONTENDING, comparable, contested, slack_of
from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, refine, spread, with_unknowns
from eha_monitor.mismatch.gains import Unknowns, expected_covariance
from eha_monitor.mismatch.innovations import CLOSED
from eha_monitor.mismatch.merge import merged
from eha_monitor.mismatch.resonance import stubborn
from eha_monitor.mismatch.screen import Start, starts_of
from eha_monitor.mismatch.search import (
    THRESHOLD,
    Candidate,
    Round,
    completed,
    expected_likelihood,
    first_fit,
    from_prior,
    limits_of,
    round_of,
    settle,
    stiffened,
    without_effect,
    yielding,
)
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.parameters import effect_values

MOST_EFFECTS = 4
MOST_OF_ALL = 6  # where each balance has a likelihood of its own
FORM_SHARE = 0.01  # of the evidence so far: the named effects' own error of form
FAMILY_SHARE = 0.05  # the same within a family
EXPLAINED = 0.75  # share of the evidence that names must take away, or it is unexplained
IN_THE_WAY = 0.2  # of what speaks against the nominal model: a resonance that hides the rest
NIBBLE = 0.05  # of what is left: what takes no more does not lead to a name for it
TIGHT = 100.0  # times the smallest unknowns, 1 % of what the record covers
NOTHING = 0.01  # log units a sample: what speaks against a model with no more is nothing
UNKNOWN = 0.01  # of what a balance does: an unknown above is a mismatch, named or not
SHRUNK, LITTLE = 0.2, 0.03  # of the nominal model's unknown, and of what the balance does
EXPECTED = 1.5  # times the variance that a filter expects of its innovations
FURTHER = 0.1  # of the evidence that is left: what gains no more has no claim on it
WEAK, WEAK_SHARE = 100.0, 0.01  # log units, and of the samples: evidence that is looked into
FLOOR, QUIET = 1.5, 0.1  # times the smallest unknowns: as good as there, and where it leans more
NEGLIGIBLE = 0.25  # times an effect's start, which is about 1 % of what its balance does

Report = Callable[[str, float], None]


@dataclass(frozen=True)
class Naming:
    """Result of the search.

    Attributes
    ----------
    before, after : nominal model with B and beta_e fitted; the model with the named effects.
    rounds : what each round screened, refitted and took, in order.
    evidence : effect -> log units that the final model loses without it.
    rivals : effect -> names that this record cannot tell from it.
    """

    before: Fit
    after: Fit
    rounds: tuple[Round, ...]
    evidence: dict[str, float]
    rivals: dict[str, tuple[str, ...]]


def preference(candidate: Candidate) -> tuple[int, int, float]:
    """Return the key by which candidates that the data cannot separate are ordered."""
    effect = CATALOGUE[candidate.effect]
    return (effect.rarity, len(candidate.fit.free), -candidate.gain)


def material(experiment: Experiment, fit: Fit, name: str) -> bool:
    """Tell whether an effect is of a size that matters, not only significant."""
    smallest: dict[str, float] = {}
    for start in starts_of(name, experiment):
        for key, value in start.values:
            smallest[key] = min(abs(value), smallest.get(key, np.inf))
    values = effect_values(fit.theta, name)
    for p in CATALOGUE[name].sizes:
        if not np.isfinite(p.neutral):  # a limit: it was reached, or it would have no evidence
            return True
        if abs(values[p.name]) > NEGLIGIBLE * smallest.get(p.name, 0.0):
            return True
    return False


def demanded_gain(fit: Fit, first: Fit, name: str, threshold: float) -> float:
    """Return what a further effect must gain beside the named ones, log units.

    The named effects' own form is never exact; a share of their evidence may be left for others
    to pick up.
    """
    sofar = fit.log_likelihood - first.log_likelihood
    family = CATALOGUE[name].family
    kin = family and any(CATALOGUE[other].family == family for other in fit.named)
    share = FAMILY_SHARE if kin else FORM_SHARE
    return max(threshold, share * sofar)


def take(experiment: Experiment, found: Round, first: Fit, threshold: float
         ) -> tuple[Candidate | None, tuple[str, ...]]:
    """Return the candidate that a round takes, or None, and its rivals.

    One whose evidence is weak must have it with a quieter filter too (:func:`quiet_gain`).
    """
    while True:
        taken, rivals = choose(experiment, found, first, threshold)
        if taken is None or not weak(experiment, taken) or quiet_gain(
                experiment, found.before, taken) >= demanded_gain(
                    found.before, first, taken.effect, threshold):
            return taken, rivals
        found = replace(found, candidates=tuple(c for c in found.candidates if c is not taken))


def choose(experiment: Experiment, found: Round, first: Fit, threshold: float
           ) -> tuple[Candidate | None, tuple[str, ...]]:
    """Return the best candidate of a round that has enough evidence, or None, and its rivals.

    What takes most of the same evidence away does about the same there and is about as large,
    whatever the scale of its own size, so where one of them matters the best is taken: not a gain
    of the pump because a leakage that explains more has another scale.
    """
    fit = found.before
    able = [c for c in found.candidates
            if c.gain >= demanded_gain(fit, first, c.effect,
                                       threshold * lasting(experiment, fit, c))]
    leading = next((c for c in able if material(experiment, c.fit, c.effect)), None)
    if leading is None:
        return None, ()
    if (leading.gain > CONTENDING * able[0].gain
            and comparable(experiment, leading.effect, able[0].effect)):
        leading = able[0]
    near = [c for c in able if abs(c.gain - leading.gain) <= slack_of(leading.gain)
            and comparable(experiment, leading.effect, c.effect)]
    taken = min(near, key=preference)
    rivals = tuple(c.effect for c in near if c is not taken
                   and taken.effect not in CATALOGUE[c.effect].contains)
    return taken, rivals


def weak(experiment: Experiment, candidate: Candidate) -> bool:
    """Tell whether a candidate's evidence may be the filter's own (:func:`quiet_gain`)."""
    return not experiment.inverse and candidate.gain < max(WEAK, WEAK_SHARE * experiment.n)


def quiet_gain(experiment: Experiment, before: Fit, candidate: Candidate) -> float:
    """Return what a candidate gains where the filter leans on the model ten times more, log units.

    Even the smallest unknowns leave some noise in what the filter predicts.  What pins a state,
    such as a relief valve that just opens on each plateau, makes it quieter, and gains by that
    where nothing is missing: 31 to 37 log units on clean triangles of 24 s.  With less of that
    noise its gain is gone, and that of what the record does show grows.
    """
    small = limits_of(experiment)[0].as_array()

    def one(fit: Fit) -> Fit:
        unknowns = fit.unknowns.as_array()
        quiet = np.where(unknowns <= FLOOR * small, QUIET * small, unknowns)
        return refine(experiment, with_unknowns(experiment, fit, Unknowns(*quiet)), 6, 0.1)

    alone, beside = spread(one, (before, candidate.fit))
    return beside.log_likelihood - alone.log_likelihood


def lasting(experiment: Experiment, before: Fit, candidate: Candidate) -> float:
    """Return how many compared samples count as one for a candidate's evidence, 1 or more.

    Innovations are white.  What a circuit that no model knows leaves in a balance is not, and the
    noise of a regressor's size grows by 1 + 2 sum(r_e r_d), with the correlations of what is left
    and of what the candidate makes (Bartlett 1946).
    """
    if not experiment.inverse:
        return 1.0
    column = ("force", "flow", "drive").index(CATALOGUE[candidate.effect].balance)
    left, made = candidate.fit.e[:, column], before.e[:, column] - candidate.fit.e[:, column]
    good = np.isfinite(left) & np.isfinite(made)
    left, made = left[good] - left[good].mean(), made[good] - made[good].mean()
    n, total = len(left), 1.0
    size = max(float(left @ left) * float(made @ made), 1e-300)
    for lag in range(1, n // 4):
        of_left = float(left[lag:] @ left[:-lag])
        if of_left < 2.0 / np.sqrt(n) * float(left @ left):  # chance, from here on
            break
        total += 2.0 * of_left * float(made[lag:] @ made[:-lag]) / size
    return max(total, 1.0)


Way = tuple[Fit, tuple[Round, ...], dict[str, tuple[str, ...]]]


def add_effects(experiment: Experiment, first: Fit, threshold: float, say: Report, fit: Fit,
                rounds: tuple[Round, ...] = ()) -> Way:
    """Take effect after effect until none is worth it; returns the model, rounds and rivals.

    Parameters
    ----------
    fit, rounds : where to begin.
    """
    rivals: dict[str, tuple[str, ...]] = dict.fromkeys(fit.named, ())
    most = MOST_OF_ALL if experiment.inverse else MOST_EFFECTS
    while len(fit.named) < most and len(rounds) < most + 2:
        say(f"trying the catalogue, round {len(rounds) + 1}", min(0.15 + 0.25 * len(rounds), 0.8))
        found = round_of(experiment, fit,
                         lambda name, fit=fit: demanded_gain(fit, first, name, threshold))
        rounds = (*rounds, found)
        taken, near = take(experiment, found, first, threshold)
        if taken is None or hopeless(experiment, fit, taken):
            break
        if not experiment.inverse and CATALOGUE[taken.effect].resonant:
            other = stubborn(experiment, taken.fit)
            taken = other if other is not None and other.gain > 0.0 else taken
        fit = settle(experiment, completed(taken.fit))
        rivals = {name: others for name, others in rivals.items() if name in fit.named}
        rivals[taken.effect] = near
    return fit, rounds, rivals


def hopeless(experiment: Experiment, fit: Fit, best: Candidate) -> bool:
    """Tell whether even the best effect takes next to nothing of much that is left.

    What has no name is nibbled at by one effect after the other, and each round costs a search.
    Only a closed loop says what is left: elsewhere the input's own noise is in every innovation.
    """
    if experiment.mode != CLOSED or experiment.inverse or not yielding(experiment, fit):
        return False
    left = expected_likelihood(experiment, fit) - fit.log_likelihood
    return left > NOTHING * len(fit.e) and best.gain < NIBBLE * left


def strictly(experiment: Experiment, first: Fit, threshold: float, say: Report,
             rounds: tuple[Round, ...]) -> Way | None:
    """Search once more while little may stay unknown.

    Where several large effects come together, the nominal model needs unknowns that follow nearly
    everything; what is then left for an effect to explain says little.  Held tight, and with B
    and beta_e where the config has them, each effect shows.
    """
    tight = replace(experiment, largest_unknown=TIGHT)
    start = settle(tight, stiffened(tight, from_prior(first)))
    fit, rounds, rivals = add_effects(tight, start, threshold, say, start)
    if not fit.named:
        return None
    return settle(experiment, fit, 3), rounds, rivals


def resonant(experiment: Experiment, first: Fit, threshold: float, say: Report,
             rounds: tuple[Round, ...]) -> Way | None:
    """Search once more from the effects whose score tells nothing."""
    other = stubborn(experiment, first)
    against = expected_likelihood(experiment, first) - first.log_likelihood
    if other is None or other.gain < IN_THE_WAY * against:
        return None
    start = Round(first, rounds[0].scores, (other, *rounds[0].candidates))
    return add_effects(experiment, first, threshold, say, other.fit, (start,))


def unexplained(experiment: Experiment, first: Fit, fit: Fit) -> bool:
    """Tell whether most of what speaks against the nominal model is still there."""
    against = expected_likelihood(experiment, first) - first.log_likelihood
    return against > NOTHING * len(first.e) and (
        fit.log_likelihood - first.log_likelihood < EXPLAINED * against)


def lacking(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether a fit needs an unknown that matters, named or not."""
    small = limits_of(experiment)[0].as_array()
    return bool((fit.unknowns.as_array() > UNKNOWN / 1e-4 * small).any())


def little_left(experiment: Experiment, naming: Naming, left: float) -> bool:
    """Tell whether what is left is small in newtons or litres per minute, however certain it is.

    Evidence grows with the logarithm of what is left: beside good sensors a tenth of a hard
    stick-slip's force is half of it.  Four things are asked.  Each unknown that the nominal model
    needs has shrunk to ``SHRUNK``, 4 % of its variance, and is ``LITTLE``.  Unknowns of that size
    account for the innovations; larger ones show something that no unknown stands for, such as a
    wrong mean pressure.  And nothing else in the catalogue has a claim on what is left.

    Parameters
    ----------
    left : evidence against the final model, log units.
    """
    before, after = naming.before, naming.after
    last = naming.rounds[-1] if naming.rounds else None
    if last is None or set(last.before.named) != set(after.named) or any(
            one.gain > FURTHER * left for one in (*last.candidates, *last.scores)):
        return False
    small = limits_of(experiment)[0].as_array()
    needed, still = before.unknowns.as_array(), after.unknowns.as_array()
    lacked = needed > UNKNOWN / 1e-4 * small
    expected = expected_covariance(experiment, after.theta, after.active, after.unknowns,
                                   after.gains)
    return bool(lacked.any() and (still[lacked] <= SHRUNK * needed[lacked]).all()
                and (still <= LITTLE / 1e-4 * small).all()
                and (np.diag(after.s) <= EXPECTED * np.diag(expected)).all())


def name_effects(experiment: Experiment, threshold: float = THRESHOLD,
                 report: Report | None = None, first: Fit | None = None) -> Naming:
    """Find the effects that an experiment supports.

    Parameters
    ----------
    threshold : log units that an effect must gain (:mod:`eha_monitor.mismatch.calibrate`).
    report : told what is done and how far it is, 0 to 1.
    """
    say = report or (lambda text, share: None)
    say("fitting the nominal model", 0.05)
    first = first_fit(experiment) if first is None else first
    fit, rounds, rivals = add_effects(experiment, first, threshold, say, first)
    # Balances that are compared as they stand have neither unknowns nor a resonance.
    for other_way in () if experiment.inverse else (strictly, resonant):
        if not unexplained(experiment, first, fit):
            break
        say("trying again from elsewhere", 0.8)
        other = other_way(experiment, first, threshold,
                          lambda text, share: say(text, max(share, 0.8)), rounds)
        if other is not None and other[0].log_likelihood > fit.log_likelihood + threshold:
            fit, rounds, rivals = other
    say("comparing what was named with its rivals", 0.85)
    fit, evidence = prune(experiment, fit, first, threshold)
    if len(fit.named) > 1:  # the rounds judged each effect beside an incomplete model
        fit, evidence, rivals = contested(experiment, fit, rounds, evidence, rivals)
        one = None if experiment.inverse else merged(
            experiment, fit, lambda other, name: demanded_gain(other, first, name, threshold))
        if one is not None:
            rivals = {name: others for name, others in rivals.items()
                      if CATALOGUE[name].balance not in {
                          CATALOGUE[gone].balance for gone in set(fit.named) ^ set(one.named)}}
            fit, evidence = prune(experiment, one, first, threshold)
    if fit.named and yielding(experiment, fit):  # from the wrong side of large unknowns
        again = settle(experiment, stiffened(experiment, fit))
        gained = again.log_likelihood - fit.log_likelihood
        if gained > 0.0:
            fit, evidence = again, {name: value + gained for name, value in evidence.items()}
    rivals = {name: others for name, others in rivals.items() if name in fit.named}
    return Naming(first, fit, rounds, evidence, rivals)


def prune(experiment: Experiment, fit: Fit, first: Fit, threshold: float
          ) -> tuple[Fit, dict[str, float]]:
    """Take out what the others have made superfluous; returns the evidence of each that stays."""
    if len(fit.named) == 1:
        return fit, {fit.named[0]: fit.log_likelihood - first.log_likelihood}
    while True:
        without = spread(lambda name, fit=fit: settle(
            experiment, without_effect(experiment, fit, name), 1), fit.named)
        # A fit that went astray without an effect says no more than the nominal model does.
        evidence = {name: fit.log_likelihood - max(other.log_likelihood, first.log_likelihood)
                    for name, other in zip(fit.named, without, strict=True)}
        if not evidence:
            return fit, evidence
        weakest = min(evidence, key=evidence.get)
        sofar = fit.log_likelihood - first.log_likelihood
        least = max(threshold, 0.5 * FORM_SHARE * sofar)
        other = without[list(evidence).index(weakest)]
        own = Candidate(Start(weakest, ()), fit, evidence[weakest])
        if evidence[weakest] >= least and (not weak(experiment, own) or quiet_gain(
                experiment, other, own) >= least):
            return fit, evidence
        fit = settle(experiment, other)
