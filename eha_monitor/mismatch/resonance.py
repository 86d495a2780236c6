"""A resonance tells nothing in the score test until it is in place: fitted from every start."""

import numpy as np

from eha_monitor.mismatch.experiment import Experiment
from eha_monitor.mismatch.fit import Fit, spread
from eha_monitor.mismatch.screen import Start, own_sizes, possible, starts_of
from eha_monitor.mismatch.search import (
    Candidate,
    candidate_of,
    from_prior,
    settle,
    stiffened,
    with_effect,
    without_effect,
)
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE, NAMES

LAST, APART = 3, 0.3  # ways into a resonance that are followed to the end; of the log of beta_e


def stubborn(experiment: Experiment, fit: Fit) -> Candidate | None:
    """Refit the effects whose score tells nothing from every start, and return the best.

    A resonance that is a little off its place explains nothing, so a score test does not see it;
    and from most starts a fit ends at another one's foot.
    """
    starts = [start for name in NAMES
              if CATALOGUE[name].resonant
              and (name in fit.named or not experiment.active[NAMES.index(name)])
              and possible(name, experiment) for start in starts_of(name, experiment)]

    def tried(task: tuple[Fit, Start]) -> Candidate:
        base, start = task
        entered_fit = with_effect(base, start, (1.0,) * len(own_sizes(start)))
        return candidate_of(start, fit, settle(experiment, entered_fit, 1, 6, False, 2.0))

    bare = fit
    for name in {start.effect for start in starts} & set(fit.named):
        bare = without_effect(experiment, bare, name)
    # Large unknowns take the flow that tells a line from soft oil: the filter must lean on the
    # model, or beta_e ends at the other end of that valley.
    quick = spread(tried, [(stiffened(experiment, base), start) for start in starts
                           for base in (bare, from_prior(bare))])
    chosen: list[Candidate] = []
    for c in sorted((c for c in quick if np.isfinite(c.gain)), key=lambda c: -c.gain):
        if len(chosen) < LAST and all(apart(c.fit, other.fit) for other in chosen):
            chosen.append(c)
    final = spread(lambda c: candidate_of(c.start, fit, settle(experiment, c.fit, 6, 12)), chosen)
    return max(final, key=lambda c: c.gain, default=None)


def apart(fit: Fit, other: Fit) -> bool:
    """Tell whether two fits lie at different places of the valley of beta_e."""
    return abs(np.log(fit.theta[s.BETA_E] / other.theta[s.BETA_E])) > APART
