"""A search under the hold of the drive's command, and under the other where that explains more.

``estimation.hold_choice`` asks a recording once whether its command is held, without any law but
the config's.  What is missing may have been taken for a hold there, or hide it: a search that ends
with something unexplained asks for the other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from eha_monitor.estimation.hold_choice import CLEARLY, HoldDecision, other_hold
from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.name.before import informative
from eha_monitor.mismatch.name.columns import effects_of
from eha_monitor.mismatch.name.naming import Naming
from eha_monitor.mismatch.name.refit import looked
from eha_monitor.mismatch.name.select import Unfollowed, nominal_model
from eha_monitor.mismatch.name.starts import without_effect
from eha_monitor.settings.monitor import Settings

HALF_LATE = ("command_delay.T", "position_delay.T")  # what a held command resembles


class OtherHold(Exception):
    """What a search has found first fits better under the other hold."""

    def __init__(self, gained: float):
        super().__init__(f"{gained:.0f} log units")
        self.gained = gained


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
    """

    experiment: Experiment
    decision: HoldDecision | None
    named: tuple[Experiment, Naming] | None
    followed: bool


# (experiment, whether it may end by ``Unfollowed``, doubt) -> windows and names.
Search = Callable[[Experiment, bool, Callable[[Fit], None] | None],
                  tuple[Experiment, Naming] | None]


def searched(under: Callable[[Settings], Experiment], held: Settings,
             decision: HoldDecision | None, may_end: bool, search: Search) -> Searched:
    """Search under the hold that was decided, and under the other where that explains more.

    Where the hold is not decided, the other is asked for as soon as a gate refuses what was found
    first; in any case where no filter follows, where the answer leaves something unexplained, and
    where it names what a held command resembles.

    Parameters
    ----------
    under : settings with a hold -> experiment.
    held : settings with the hold of the decision.
    may_end : whether a search may end by ``Unfollowed``.
    search : gives the names in an experiment.
    """
    experiment = under(held)
    if decision is None:
        return Searched(experiment, None, *_followed(search, experiment, may_end, None))
    other = cache(lambda: under(other_hold(held)))

    def doubt(fit: Fit) -> None:
        gained = gained_under(other(), fit)
        if gained > 0.0:
            raise OtherHold(gained)

    try:
        named, followed = _followed(search, experiment, may_end,
                                    None if decision.decided else doubt)
    except OtherHold as better:
        gained, followed = better.gained, False
    else:
        late = named is not None and not decision.decided and late_as_held(named[1])
        if followed and not late and not (
                named and named[1].unexplained > experiment.policy.rival):
            return Searched(experiment, decision, named, followed)
        gained = gained_under(other(), named[1].after if named else
                              nominal_of(informative(experiment)))
        if gained <= (-CLEARLY if late else 0.0):
            return Searched(experiment, decision, named, followed)
    return Searched(other(), replace(
        decision, hold=other().settings.command_hold, evidence=gained, decided=True),
        *_followed(search, other(), may_end and not followed, None))


def _followed(search: Search, experiment: Experiment, may_end: bool,
              doubt: Callable[[Fit], None] | None
              ) -> tuple[tuple[Experiment, Naming] | None, bool]:
    """Return the names, and whether a filter follows the recording at all."""
    try:
        return search(experiment, may_end, doubt), True
    except (Unfollowed, np.linalg.LinAlgError):  # no law is near, or no filter runs
        return None, False


def late_as_held(naming: Naming) -> bool:
    """Tell whether a set names a time of half a sample, by which a held command is late.

    Any other length would be as likely: it is taken for a hold unless it is clearly better.
    """
    half, policy, after = 0.5 * naming.experiment.dt, naming.experiment.policy, naming.after
    return any(f.name in HALF_LATE and f.owner in after.named and abs(
        after.theta[f.place] - half) <= np.hypot(
            2.0 * policy.timing * half, policy.sure * after.stddev(f.name)) for f in after.free)


def nominal_of(windows: Experiment) -> Fit | None:
    """Return the nominal model with the rig's numbers free, fitted; None where none runs."""
    try:
        return nominal_model(windows, within=True)
    except np.linalg.LinAlgError:
        return None


def gained_under(other: Experiment, found: Fit | None) -> float:
    """Return by how much a set fits better under another hold than where it was found, log units.

    The likeliest of it, of it without one of its effects and of the nominal model there, after a
    first look: what is missing beside the set may be what was taken for a hold (a position that is
    read late), and an effect of it may be the hold (a line that delays the flow).

    Parameters
    ----------
    other : the same samples and outputs, under another hold of the drive's command.
    found : None where no filter runs.
    """
    def each(fit: Fit) -> float:
        return fit.log_likelihood / np.isfinite(fit.e).sum()

    windows = informative(other)
    bare = nominal_of(windows)
    if found is None:
        return 0.0 if bare is None else np.inf
    sets = [found, *(without_effect(windows, found, name) for name in effects_of(found))]
    there = [*spread(lambda one: looked(windows, with_unknowns(windows, one)), sets),
             *filter(None, [bare])]
    best = max(there, key=each)
    return float((each(best) - each(found)) * np.isfinite(best.e).sum())
