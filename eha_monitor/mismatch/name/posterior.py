"""Every set that was refitted, what its evidence counts, and the probability of each."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from eha_monitor import ties
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.diagnosis import Gate
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.name.candidates import all_named, candidate, log_prior
from eha_monitor.mismatch.name.gates import too_small
from eha_monitor.mismatch.name.rank import Ranked
from eha_monitor.mismatch.name.refit import discrepancy, evidence_of, impossible
from eha_monitor.mismatch.policy import SearchPolicy

Names = frozenset[str]
PURSUED = 1.0  # log units of score: where less is gained the search does not go on
STRAYED = 5.0  # log units: a fit that is that far from its optimum is made again


@dataclass
class Refits:
    """Every set that was refitted."""

    policy: SearchPolicy  # what evidence counts
    fits: dict[Names, Fit] = field(default_factory=dict)  # names -> model
    # Names -> Laplace evidence, log units
    evidence: dict[Names, float] = field(default_factory=dict)
    left: dict[Names, float] = field(default_factory=dict)  # names -> cost of its unknowns
    # Names -> model and evidence of what cannot be (no damping, no stiffness), or does next
    # to nothing. It is no answer, but what it lacks may be what makes it possible: the
    # search goes on from there
    stations: dict[Names, tuple[Fit, float]] = field(default_factory=dict)
    # (model, set) that was refitted from a linearisation at that model, whatever came of it
    tried: set[tuple[Names, Names]] = field(default_factory=set)
    # Names -> model of a first look that others were ahead of then
    dropped: dict[Names, Fit] = field(default_factory=dict)
    # Names -> gates that the set does not pass: it is no answer, whatever its evidence
    refused: dict[Names, tuple[Gate, ...]] = field(default_factory=dict)
    # Names -> model from which the set without each of its members was fitted
    parted: dict[Names, Fit] = field(default_factory=dict)

    def add(self, experiment: Experiment, names: Names, fit: Fit, anyway: bool = False) -> None:
        """Keep a fit of a set, if it is one and better than what is there, or ``anyway``."""
        value = evidence_of(fit) if np.isfinite(fit.log_likelihood) else -np.inf
        if not np.isfinite(value):
            return
        if names and (impossible(fit, self.policy.sure) or too_small(experiment, fit)):
            if value > self.stations.get(names, (None, -np.inf))[1] + ties.SAME_FIT:
                self.stations[names] = fit, value
        elif anyway or value > self.evidence.get(names, -np.inf) + ties.SAME_FIT:
            self.fits[names], self.evidence[names] = fit, value
            self.refused.pop(names, None)  # a gate judged the fit that this one is better than
            self.left[names] = discrepancy(experiment, fit)

    def known(self, names: Names, here: Names, promised: float = -np.inf) -> bool:
        """Tell whether a set was looked at from the model at hand, or refitted from elsewhere.

        ``promised`` : evidence by the linear guess from the model at hand: what was fitted from
            elsewhere and would be better from here is not known yet.
        """
        station = self.stations.get(names, (None, -np.inf))[1]
        found = max(self.evidence.get(names, -np.inf), station)
        return (here, names) in self.tried or (found > -np.inf and promised <= found + STRAYED)

    def floor(self) -> float:
        """Return the evidence of a model that needs no unknowns, as far as it is known."""
        best = self.likeliest(self.evidence)
        return self.evidence[best] + self.left[best]

    def likeliest(self, sets: Iterable[Names]) -> Names:
        """Return the set with the highest evidence, the plainest of equals."""
        return ties.best(sets, self.evidence.get, plainness, ties.SAME_FIT)

    def highest(self) -> Names:
        """Return the set with the highest evidence, of those that no gate has refused."""
        return self.likeliest(names for names in self.evidence if names not in self.refused)

    def score(self, evidence: float, prior: float) -> float:
        """Return what an evidence counts, log units: see :func:`counted`."""
        return self.policy.temper * counted(self.floor() - evidence, self.policy) + prior

    def pursued(self, evidence: float, than: float) -> bool:
        """Tell whether evidence counts for so much more than another that it is worth a look."""
        floor = max(self.floor(), evidence)
        return self.policy.temper * (
            counted(floor - evidence, self.policy) - counted(floor - than, self.policy)) > PURSUED

    def scores(self) -> dict[Names, float]:
        """Return the score of every refitted set.

        No law of friction is right to the last newton, no law of a gap to the last litre: each
        picks up what another has wrong, and a second one beside it does.  So between sets that
        differ in the laws of one family only, evidence counts so much less that the share ``law``
        of what the family explains leaves the other set just a rival.
        """
        plain = {names: self.score(value, 0.0) for names, value in self.evidence.items()}
        found = {}
        for names, value in self.evidence.items():
            found[names] = plain[names] + log_prior(names, self.policy)
            for best, form in self.laws_of(names):
                apart = abs(value - self.evidence[best]) / max(form, 1e-9)
                most = -np.log(self.policy.rival) * apart
                gained = plain[names] - plain[best]
                found[names] -= gained - min(max(gained, -most), most)
        return found

    def laws_of(self, names: Names) -> list[tuple[Names, float]]:
        """Return for each family of a set the best set with one law in its laws' place.

        With it comes how many log units may be form error of that law.
        """
        found = []
        for family in dict.fromkeys(candidate(law).form_kin | {law} for law in sorted(names)
                                    if candidate(law).kin):
            rest = names - family
            with_one = [some for some in self.evidence
                        if some - family == rest and len(some & family) == 1]
            best = self.likeliest(with_one) if with_one else names
            without = max((known for some, known in self.evidence.items() if some <= rest),
                          default=self.evidence[best])
            found.append((best, self.policy.law * (self.evidence[best] - without)))
        return found

    def best(self) -> Names:
        """Return the plainest of the best sets, of those that no gate has refused."""
        scores = {names: score for names, score in self.scores().items()
                  if names not in self.refused}
        return ties.best(scores, scores.get, plainness, self.policy.temper * ties.SAME_FIT)

    def ahead(self, done: dict[Names, float]) -> tuple[Names, Fit] | None:
        """Return the model where the search goes on; None where it has been everywhere.

        That is the set with the highest evidence that no gate has refused, if it counts for
        something more than those that were linearised before; and at last the one with the highest
        score.

        ``done`` : names -> evidence with which a model was linearised before; one that has
            gained ``STRAYED`` since is linearised again.
        """
        best = self.best()
        known = {names: (self.fits[names], value) for names, value in self.evidence.items()
                 if names == best or (names not in self.refused and all(
                     one == names for one, _ in self.laws_of(names)))}
        every = {**known, **{names: item for names, item in self.stations.items()
                             if item[1] > self.evidence.get(names, -np.inf)}}
        highest = ties.best(every, lambda names: every[names][1] + log_prior(
            names, self.policy), plainness, ties.SAME_FIT)
        went = max((value for names, value in done.items() if names not in self.refused),
                   default=-np.inf)
        for names, (fit, value) in ((highest, every[highest]), (best, known[best])):
            if value > done.get(names, -np.inf) + STRAYED and (
                    names == best or self.pursued(value, went)):
                return names, fit
        return None


def counted(left: float, policy: SearchPolicy) -> float:
    """Return what evidence that is lacking counts: in full near the noise, less far above it.

    No model is exact to the last newton.  A likelihood (1 + left / form)^-form is that of a
    model whose form error is unknown in size: what takes a tenth of much that is left has
    gained little, what takes the last bit has gained all of it.
    """
    return -policy.form * float(np.log1p(max(left, 0.0) / policy.form))


def plainness(names: Names) -> tuple[int, int, list[str]]:
    """Return the key that puts the plainest set first: few members, common ones, by name."""
    return len(names), sum(candidate(name).rarity for name in names), sorted(names)


def beyond(evidence: float, least: float, form: float) -> float:
    """Return an evidence of which the gain over ``least`` counts as far as it is beyond form.

    ``form`` log units may be the form error of a plainer law: a gain of that size counts nothing,
    one of four times that nearly in full.
    """
    gained, form = evidence - least, max(form, 0.0)
    if gained <= 0.0:
        return evidence
    return least + gained * max(1.0 - (form / gained) ** 2, 0.0)


def posterior(refits: Refits, views: Sequence[tuple[Names, Sequence[Ranked]]],
              promising: bool = False) -> dict[Names, float]:
    """Return the probability of every set that was refitted, or known by the linear guess.

    Sets by the linear guess are those of a linearisation, measured from the model there.  What
    has names and seems better than that model was refitted, or is beyond what the guess can say.

    ``views`` : models that were linearised, each with the sets as they are ranked there.
    ``promising`` : also of what seems better and was never refitted.
    """
    scores = refits.scores()
    for names, value in refused_evidence(refits).items():
        scores[names] += refits.score(value, 0.0) - refits.score(refits.evidence[names], 0.0)
    for here, ranking in views:
        own = own_in(ranking, here)
        if own is None:
            continue
        least = evidence_at_start(refits, here)
        start = least - (own.evidence - own.prior)
        form = form_error(refits, least)
        for one in ranking:
            unnamed = not all_named(one.names)
            value = start + one.evidence - one.prior
            if unnamed:
                # A guess that is too high where a law is gone is too high with a function there.
                rest = frozenset(name for name in one.names if all_named({name}))
                bare = own_in(ranking, rest)
                if bare is not None and rest in refits.evidence:
                    value -= max(start + bare.evidence - bare.prior - refits.evidence[rest], 0.0)
                value = beyond(value, least, form)  # what laws have wrong is such a function
            if one.names not in scores and (unnamed or one.evidence <= own.evidence or (
                    promising and not refits.known(one.names, here))):
                scores[one.names] = refits.score(value, one.prior)
    weights = np.array(list(scores.values()))
    weights = np.exp(weights - weights.max())
    return dict(zip(scores, (weights / weights.sum()).tolist(), strict=True))


def refused_evidence(refits: Refits) -> dict[Names, float]:
    """Return the evidence of sets that no gate lets through, beyond the form error of the answer.

    They may fit by what its laws have wrong.
    """
    least = refits.evidence[refits.best()]
    form = form_error(refits, least)
    return {names: beyond(refits.evidence[names], least, form) for names in refits.refused}


def form_error(refits: Refits, evidence: float) -> float:
    """Return how many log units may be what the laws of a set with that evidence have wrong."""
    return refits.policy.law * max(evidence - refits.evidence.get(frozenset(), evidence), 0.0)


def evidence_at_start(refits: Refits, here: Names) -> float:
    """Return the evidence of a model that was linearised."""
    return refits.evidence[here] if here in refits.evidence else refits.stations[here][1]


def own_in(ranking: Sequence[Ranked], names: Names) -> Ranked | None:
    """Return a set's place in a ranking."""
    return next((one for one in ranking if one.names == names), None)
