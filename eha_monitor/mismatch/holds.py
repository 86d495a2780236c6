"""A search under the hold of the drive's command, and under the other where that explains more.

``estimation.hold_choice`` asks a recording once whether its command is held, without any law but
the config's.  What is missing may have been taken for a hold there, or hide it: a search that ends
with something unexplained asks for the other.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, reduce
from typing import Any

import numpy as np

from eha_monitor import ties
from eha_monitor.estimation.hold_choice import CLEARLY, HoldDecision, other_hold
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.name.before import informative, with_effects
from eha_monitor.mismatch.name.columns import effects_of
from eha_monitor.mismatch.name.naming import Naming, follows
from eha_monitor.mismatch.name.nominal import nominal_model
from eha_monitor.mismatch.name.refit import looked, settled
from eha_monitor.mismatch.name.select import GAINED, Elsewhere, Search, Unfollowed
from eha_monitor.mismatch.name.starts import without_effect
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import LATE
from eha_monitor.settings.monitor import Settings

SHORT = 2.0  # samples: what stands for a hold is no longer
STARTS = 0.25, 1.0  # samples, of a drive that is late: on either side of what a hold adds


@dataclass(frozen=True)
class Searched:
    """What a search ended with, and where.

    Attributes
    ----------
    experiment : the samples, under the hold that stands.
    decision : about the hold; None where it is not asked.
    named : the windows that names were sought in, and the names; None where the piston hardly
        moves, or no filter follows.
    followed : whether a filter follows the recording at all.
    apart : ``B`` and ``beta_e`` -> by how much each moves under the other hold, SI, where
        nothing decides between them.
    """

    experiment: Experiment
    decision: HoldDecision | None
    named: tuple[Experiment, Naming] | None
    followed: bool
    apart: Mapping[str, float] = field(default_factory=dict)


Begun = tuple[Experiment, Search]


def searched(under: Callable[[Settings], Experiment], held: Settings,
             decision: HoldDecision | None, may_end: bool,
             begin: Callable[[Experiment, bool, Elsewhere | None, Sequence[Fit]], Begun | None],
             name: Callable[[Search], Naming]) -> Searched:
    """Search under the hold that was decided, and under the other where that explains more.

    Where the hold is not decided, the other is asked for as soon as a gate refuses what was found
    first; in any case where no set that is refitted first follows, where no filter does, where the
    answer leaves something unexplained, and where it names what a held command resembles; and
    where its innovations are not those of the noise, against what has decided the hold.  Where a
    search that was left early turns out to have been the better one, it is made to its end.

    Parameters
    ----------
    under : settings with a hold -> experiment.
    held : settings with the hold of the decision.
    may_end : whether a search may end by ``Unfollowed``.
    begin : (experiment, whether it may end so, whether a fit is better off under the other hold,
        fits to begin with) -> windows, and a search begun in them; None where the piston hardly
        moves.
    name : ends a search.
    """
    experiment = under(held)
    if decision is None:
        begun, followed = _followed(begin, experiment, may_end, None, ())
        return Searched(experiment, None, *_named(name, begun, followed))
    other = cache(lambda: under(other_hold(held)))
    there = cache(lambda: informative(other()))
    bare = cache(lambda: nominal_of(there()))
    gained, best = 0.0, None

    def elsewhere(fit: Fit) -> bool:
        nonlocal gained, best
        gained, best = gained_under(there(), bare(), fit)
        return gained > max(GAINED * experiment.policy.lacking * experiment.n, decision.evidence)

    begun, followed = _followed(begin, experiment, may_end, elsewhere, ())
    gained = 0.0 if followed else gained
    if begun is not None and not decision.decided and begun[1].doubtful:
        gained, best = gained_under(there(), bare(), begun[1].found)
    early = gained > 0.0  # the search here is not made to its end
    if not early:
        named, followed = _named(name, begun, followed)
        found = named and named[1]
        short = found is not None and bool(short_times(found.after, experiment.dt))
        late = short and not decision.decided and late_as_held(found)
        stands = Searched(experiment, decision, named, followed)
        open_ = not followed or short or (
            found is not None and found.unexplained > experiment.policy.rival)
        if not open_ and (found is None or follows(found)):
            return stands if decision.decided or found is None else replace(
                stands, apart=apart_under(there(), found.after))
        gained, best = gained_under(there(), bare(), found.after if found else
                                    nominal_of(informative(experiment)))
        # What explains all that has a name takes more than what has decided the hold.
        owed = -CLEARLY if late else 0.0 if open_ else decision.evidence
        if gained <= owed:
            return stands
        may_end = may_end and not followed

    def made(where: Experiment) -> Searched:
        """Return a search to its end, begun with the set that is likelier there."""
        known = () if best is None or not best.named else (best,)
        return Searched(where, replace(
            decision, hold=where.settings.command_hold, evidence=gained, decided=True), *_named(
                name, *_followed(begin, where, may_end, None, known)))

    end = made(other())
    if not early or end.named is None or follows(end.named[1]):
        return end
    windows = informative(experiment)
    gained, best = gained_under(windows, nominal_of(windows), end.named[1].after)
    return made(experiment) if gained > 0.0 else end


def _followed(step: Callable, *arguments) -> tuple[Any, bool]:
    """Return what a step of a search gives, and whether a filter follows the recording at all."""
    try:
        return step(*arguments), True
    except (Unfollowed, np.linalg.LinAlgError):  # no law is near, or no filter runs
        return None, False


def _named(name: Callable[[Search], Naming], begun: Begun | None, followed: bool
           ) -> tuple[tuple[Experiment, Naming] | None, bool]:
    """Return windows and the names there, and whether a filter follows the recording."""
    if begun is None:
        return None, followed
    naming, followed = _followed(name, begun[1])
    return (begun[0], naming) if followed else None, followed


def late_as_held(naming: Naming) -> bool:
    """Tell whether a set names a time of half a sample, by which a held command is late.

    Any other length would be as likely: it is taken for a hold unless it is clearly better.
    """
    half, policy, after = 0.5 * naming.experiment.dt, naming.experiment.policy, naming.after
    return any(LATE.get(f.name) in ("omega", "x") and f.owner in after.named and abs(
        after.theta[f.place] - half) <= np.hypot(
            2.0 * policy.timing * half, policy.sure * after.stddev(f.name)) for f in after.free)


def short_times(found: Fit, dt: float) -> list[str]:
    """Return the named effects that are a time of a few samples, as what a hold adds is."""
    return [f.owner for f in found.free if f.name in LATE and f.owner in found.named
            and abs(found.theta[f.place]) < SHORT * dt]


def apart_under(windows: Experiment, found: Fit) -> dict[str, float]:
    """Return by how much B and beta_e of a set move under another hold, SI; refitted from there.

    ``windows`` : of the same samples, under the other hold.
    """
    try:
        there = settled(windows, with_unknowns(windows, found))
    except np.linalg.LinAlgError:
        return {}
    return {name: abs(float(there.theta[place] - found.theta[place]))
            for name, place in (("B", s.B), ("beta_e", s.BETA_E))
            if np.isfinite(there.theta[place] - found.theta[place])}


def as_it_reads(experiment: Experiment) -> Experiment:
    """Return the experiment with a digital drive reading what explains more.

    Either the recorded position with its noise, of which its command then has a share, or a
    cleaner one: by the nominal model, at the numbers of the better of two fits.
    """
    if not experiment.held or experiment.mode != CLOSED or experiment.wanted_speed:
        return experiment
    windows = informative(experiment)
    ways = {hears: replace(windows, hears=hears) for hears in (True, False)}
    fits = [fit for way in ways.values() if (fit := nominal_of(way)) is not None]
    if not fits:
        return experiment
    best = ties.best(fits, lambda fit: fit.log_likelihood, within=ties.SAME_FIT)
    reached = {hears: with_unknowns(way, best).log_likelihood for hears, way in ways.items()}
    return replace(experiment, hears=reached[True] >= reached[False] - ties.SAME_FIT)


def nominal_of(windows: Experiment) -> Fit | None:
    """Return the nominal model with the rig's numbers free, fitted; None where none runs."""
    try:
        return nominal_model(windows, within=True)
    except np.linalg.LinAlgError:
        return None


def gained_under(windows: Experiment, bare: Fit | None, found: Fit | None
                 ) -> tuple[float, Fit | None]:
    """Return by how much a set fits better under another hold, log units, and its fit there.

    The likeliest of it, of it without one of its effects, with one late drive or none in place of
    its short times, and of the nominal model there, after a first look: what is missing beside the
    set may be what was taken for a hold (a position that is read late), and an effect of it may be
    the hold (a line that delays the flow), or several that share its time.

    Parameters
    ----------
    windows : of the same samples and outputs, under another hold of the drive's command.
    bare : the nominal model there; None where none runs.
    found : None where no filter runs.
    """
    def each(fit: Fit) -> float:
        return fit.log_likelihood / np.isfinite(fit.e).sum()

    if found is None:
        return (0.0 if bare is None else np.inf), bare
    sets = [found, *(without_effect(windows, found, name) for name in effects_of(found))]
    if short := short_times(found, windows.dt):
        rest = reduce(lambda fit, name: without_effect(windows, fit, name), short, found)
        sets += [rest, *(with_effects(windows, rest, {name: {symbol: start * windows.dt}})
                         for name, symbol in (key.split(".") for key, what in LATE.items()
                                              if what == "omega") for start in STARTS)]
    there = [*spread(lambda one: looked(windows, with_unknowns(windows, one)), sets),
             *filter(None, [bare])]
    best = max(there, key=each)
    return float((each(best) - each(found)) * np.isfinite(best.e).sum()), best
