"""A parameter that changed while a recording ran, or between recordings of one rig.

No physics is left out then: the nominal model explains each piece of the data, with other values
of B and beta_e.  Where something changed is found by the two stages, which follow the parameters;
that nothing else is missing, by the nominal model fitted to each piece for itself.
"""

from itertools import pairwise

import numpy as np

from eha_monitor.estimation.pipeline import estimate
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import cut
from eha_monitor.mismatch.diagnosis import HEALTH_WORDS, Piece, Value
from eha_monitor.mismatch.likelihood.fit import (
    innovations,
    log_likelihood_of,
    spread,
    with_unknowns,
)
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.nominal import needing_least, nominal_model
from eha_monitor.mismatch.name.starts import expected_likelihood, needs
from eha_monitor.mismatch.policy import SearchPolicy
from eha_monitor.mismatch.show.model import robust, values_of
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import Recording

# Left out around a change, s: the stages see it later than it begins, and it may take its time.
BEFORE_S, AFTER_S = 1.5, 0.5
SHORTEST_S = 2.0  # of the fitted samples of a piece


def changed_between(recordings: list[Recording], naming: Naming) -> Naming | None:
    """Return the nominal model in pieces, where they explain the data better than named physics.

    Its pieces are in order of time; neighbours of one recording differ in B or beta_e.  Data and
    model are those of the last piece, beside the nominal model of all data.

    ``recordings`` : at least one, compared by a filter, not by balances.
    ``naming`` : the best model of constant parameters.
    """
    experiment, named, policy = naming.experiment, naming.after, naming.experiment.policy
    parts = parts_of(experiment, recordings)
    if len(parts) < 2:
        return None
    fits = [needing_least(part, nominal_model(part)) for part in parts]  # each on all cores
    if any(needs(part, fit, policy.matters) for part, fit in zip(parts, fits, strict=True)):
        return None  # the nominal model does not explain them piece by piece either
    expected = sum(expected_likelihood(part, fit) for part, fit in zip(parts, fits, strict=True))
    reached = sum(fit.log_likelihood for fit in fits)
    constant = sum(spread(lambda part: log_likelihood_of(innovations(
        part, named.theta, named.active, named.gains)), parts))
    if reached - constant < max(
            policy.effect / -policy.temper, policy.explained * (expected - constant)):
        return None
    pieces = tuple(Piece(
        part.stretches[0].source, float(part.stretches[0].start),
        float(part.stretches[-1].start + len(part.stretches[-1]) * part.dt),
        values_of(part, robust(part, fit, of_rig=False)))
        for part, fit in zip(parts, fits, strict=True))
    if not any(differ(one.values, other.values, policy) for one, other in pairwise(pieces)):
        return None
    return Naming(parts[-1], with_unknowns(parts[-1], naming.before), fits[-1],
                  consistent=naming.unexplained, unexplained=0.0, pieces=pieces)


def parts_of(experiment: Experiment, recordings: list[Recording]) -> list[Experiment]:
    """Return the experiment between the changes that the stages saw, where enough is fitted."""
    found = []
    for recording in recordings:
        answer = estimate(recording, experiment.settings)
        rows = np.concatenate([answer.stage_one.changes, answer.stage_two.changes])
        at, dt = np.sort(rows[:, 0]) * recording.sample_time, recording.sample_time
        found += [part_of(experiment, recording.source, start + AFTER_S, stop - BEFORE_S)
                  for start, stop in pairwise([-np.inf, *at, np.inf])
                  if stop - start > BEFORE_S + AFTER_S + dt]
    return [part for part in found if part is not None]


def part_of(experiment: Experiment, source: str, start: float, stop: float) -> Experiment | None:
    """Return the experiment cut to a time of one recording; None if too little is fitted there."""
    stretches = []
    for stretch in experiment.stretches:
        time = stretch.start + np.arange(len(stretch)) * experiment.dt
        here = np.flatnonzero((time >= start) & (time <= stop))
        if stretch.source == source and len(here):
            stretches.append(cut(stretch, here[0], here[-1] + 1, experiment.dt))
    fitted = sum(int(stretch.counted.sum()) for stretch in stretches) * experiment.dt
    return experiment.only(tuple(stretches)) if fitted >= SHORTEST_S else None


def differ(one: dict[str, Value], other: dict[str, Value], policy: SearchPolicy) -> list[str]:
    """Return the parameters that have changed between two pieces."""
    return [name for name, before in one.items() if name in other
            and abs(other[name].value - before.value) > max(
                policy.worse * abs(before.value),
                policy.sure * float(np.hypot(before.stddev, other[name].stddev)))]


def change_words(pieces: tuple[Piece, ...], policy: SearchPolicy) -> str:
    """Return the message: what changed, when, and that no physics is missing."""
    said = []
    for one, other in pairwise(pieces):
        names = differ(one.values, other.values, policy)
        when = (f"between {one.stop_s:.1f} and {other.start_s:.1f} s" if one.bag == other.bag
                else f"from {one.bag} to {other.bag}")
        said += [f"{HEALTH_WORDS[name]} changed {when} from {words_of(one.values[name])} to "
                 f"{words_of(other.values[name])}" for name in names]
    return (f"{'; '.join(said)}. No effect is missing: the nominal model fits each piece "
            "separately, and estimate tracks the change")


def words_of(value: Value) -> str:
    """Return a value with its uncertainty."""
    return with_uncertainty(value.value, value.stddev, value.unit)
