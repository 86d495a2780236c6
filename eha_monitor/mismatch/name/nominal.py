"""The model without effects: fitted to the end, and what it lacks of the recording."""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import JAGGED, SMOOTH, Experiment, resolving
from eha_monitor.mismatch.data.inputs import FORCED
from eha_monitor.mismatch.likelihood.along import filtered_tracks
from eha_monitor.mismatch.likelihood.fit import (
    Fit,
    innovations,
    likeliest,
    remade,
    sensitivities,
    step_of,
    whitener,
    with_unknowns,
)
from eha_monitor.mismatch.name.columns import rig_free
from eha_monitor.mismatch.name.refit import FIRST, Slopes, at_level, polished, settled, unfitted
from eha_monitor.mismatch.name.starts import expected_likelihood, limits_of, needs
from eha_monitor.physics import signals as of
from eha_monitor.physics.signals import BETA_E, B

LARGER = (FIRST, 10.0 * FIRST, 100.0 * FIRST)  # where a model far off runs away under less
LEANING = 30.0  # times the smallest unknowns: below, the nominal model needs next to nothing
BENT = 0.2  # of the logarithm of B or beta_e


def nominal_model(experiment: Experiment, within: bool = False) -> Fit:
    """Fit the nominal model, first with unknowns so large that it cannot run away.

    ``within`` : with the rig's numbers free within their tolerances.  Where only B and beta_e may
        give, they make up for all that the config has a little wrong, and go where nothing is
        linear.
    """
    for factor in LARGER:
        start = unfitted(experiment, factor)
        held = polished(experiment, with_rig(experiment, start) if within else start,
                        Slopes(experiment), 8, 0.5)
        if held.gains.size and np.isfinite(held.log_likelihood):
            break
    else:
        raise np.linalg.LinAlgError("the nominal model's likelihood is singular")
    if not leans_less(experiment, at_level(experiment, held)):
        return held
    return settled(experiment, held)


def needing_least(experiment: Experiment, first: Fit) -> Fit:
    """Return the nominal model fitted to the end: from a first fit, and from the config itself.

    Numbers and unknowns are fitted in turn, and a first fit begins with large unknowns.  In slow
    motion it may end there with a soft fluid and a large unknown flow, where the config's fluid
    needs none: a right model is found from the config without unknowns, in a few steps.
    """
    bare = polished(experiment, unfitted(experiment, 1.0), Slopes(experiment))
    found = settled(experiment, first)
    if not np.isfinite(bare.log_likelihood):
        return found
    return likeliest((found, settled(experiment, at_level(experiment, bare))))


def from_config(experiment: Experiment) -> Fit:
    """Return the nominal model with the rig's numbers free, fitted from the config itself.

    What B and beta_e make up for alone they are fitted to first, and a narrow valley leads no
    further: in slow motion a leak nine times the config's ended as an oil less than half as stiff.
    """
    bare = polished(experiment, with_rig(experiment, unfitted(experiment, 1.0)),
                    Slopes(experiment))
    if not np.isfinite(bare.log_likelihood):
        return bare
    return with_unknowns(experiment, settled(experiment, at_level(experiment, bare)))


def lacks(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether a model needs unknowns that show."""
    return needs(experiment, fit, LEANING)


def leans_less(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether a nominal model asks for smaller unknowns than it was first given."""
    small = limits_of(experiment)[0].as_array()
    return bool((fit.unknowns.as_array() < FIRST * small).all())


def bent(start: Fit, fit: Fit) -> bool:
    """Tell whether a fit of the nominal model has gone far from the config.

    What is left out bends B and beta_e, and what is linear at the config is not so there.
    """
    return any(abs(np.log(fit.theta[place] / start.theta[place])) > BENT for place in (B, BETA_E)
               if fit.theta[place] != start.theta[place])


def resolved_nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model with integration steps that resolve the damping it finds.

    The experiment that is returned has the ranges of the pressures that this model finds, where
    no sensor reads them: a relief valve is sought where the pressures are.
    """
    while True:
        first = nominal_model(experiment)
        finer = resolving(experiment, first.theta[B])
        if jagged(finer, first):
            finer = replace(finer, log_step=JAGGED)
        if (finer.steps, finer.log_step) == (experiment.steps, experiment.log_step):
            found = with_pressures(experiment, first)
            return found, first if found is experiment else with_unknowns(found, first)
        experiment = finer


def jagged(experiment: Experiment, fit: Fit) -> bool:
    """Tell whether the innovations leap with beta_e over a small step, and not over a large one.

    A check valve that opens within an integration step makes them so.  A slope over the small step
    is then one of leaps: no fit moves, and what it is sure of is nothing.
    """
    f = next((one for one in fit.free if one.name == "beta_e"), None)
    if f is None or experiment.log_step == JAGGED or not np.isfinite(fit.log_likelihood):
        return False
    small, large = (np.nan_to_num(slope) @ whitener(fit.s).T for slope in sensitivities(
        experiment, fit.active, fit.gains, innovations(
            experiment, fit.theta, fit.active, fit.gains),
        [step_of(f, fit.theta, step) for step in (SMOOTH, JAGGED)]))
    return bool(np.linalg.norm(small - large) > np.linalg.norm(large))


def with_pressures(experiment: Experiment, fit: Fit) -> Experiment:
    """Return an experiment with the ranges of the pressures that a fit finds and nobody reads."""
    if experiment.mode == FORCED or (experiment.used[2] and experiment.used[3]):
        return experiment
    # A filter that starts from a wrong pressure is off until its gains are steady.
    tracks = np.concatenate([track[len(fit.gains) :]
                             for track in filtered_tracks(experiment, fit)])
    p1, p2 = tracks[:, of.P1], tracks[:, of.P2]
    if not len(tracks) or not (np.isfinite(p1) & np.isfinite(p2)).all():
        return experiment
    low = np.quantile(np.minimum(p1, p2), [0.002, 0.02, 0.2])  # as ranges_of, no extremes
    apart = np.quantile(np.abs(p1 - p2), [0.5, 0.9, 0.98, 0.998])
    return replace(experiment, ranges=replace(
        experiment.ranges, pressure_difference=tuple(apart.tolist()),
        lowest_pressure=tuple(low.tolist()), mean_pressure=float(np.median(p1 + p2)) / 2.0))


def nominal(experiment: Experiment) -> tuple[Experiment, Fit]:
    """Fit the nominal model to the end; returns the experiment with steps that resolve its B."""
    experiment, first = resolved_nominal(experiment)
    return experiment, needing_least(experiment, first)


def with_rig(experiment: Experiment, fit: Fit) -> Fit:
    """Return a fit with every number of the rig free within its tolerance, not yet refitted.

    One that is the same equation as an effect of the model stays at the config's.
    """
    known = {f.name for f in fit.free}
    free = fit.free + tuple(f for f in rig_free(experiment, fit.named) if f.name not in known)
    return remade(experiment, fit, free=free)


def lack_of(experiment: Experiment, fit: Fit) -> float:
    """Return what a model lacks on the expected likelihood of a right one, log units a sample."""
    return float(expected_likelihood(experiment, fit) - fit.log_likelihood) / experiment.n
