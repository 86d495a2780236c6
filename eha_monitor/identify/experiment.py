"""The experiment: move, diagnose, and move again until it is decided what the rig has."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.identify.otherwise import otherwise
from eha_monitor.identify.plan import (
    WORTH,
    Contest,
    Planned,
    Planner,
    beside,
    running,
    standing,
)
from eha_monitor.identify.rig import Ran, Rig
from eha_monitor.mismatch.diagnose import diagnose_and_name
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.mismatch.name.naming import Names, Naming
from eha_monitor.recordings.recording import Recording

DECIDED, INSEPARABLE, TIME, ABORTED = "decided", "inseparable", "time", "aborted"
ENDS = (DECIDED, INSEPARABLE, TIME, ABORTED)
FEW = 0.05  # probability of all rivals together, below which what has no model yet is looked for
Report = Callable[[str, float], None]


@dataclass(frozen=True)
class Round:
    """One motion, and what is known after it.

    Attributes
    ----------
    planned, ran : the motion, and what came of it.
    seconds : of motion so far, this one included.
    diagnosis : of all recordings so far; None where the motion was aborted.
    names, probability : the set that stands, and its probability; ``rivals`` the others from
        1 % on, the most probable first.
    following : the motion that is planned next, or None; ``end`` then says why, one of ``ENDS``.
    would : what would tell the rest apart, in words, where no motion does.
    """

    planned: Planned
    ran: Ran
    seconds: float
    diagnosis: Diagnosis | None = None
    names: Names = frozenset()
    probability: float = np.nan
    rivals: dict[Names, float] = field(default_factory=dict)
    following: Planned | None = None
    end: str = ""
    would: tuple[str, ...] = ()


def identify(rig: Rig, planner: Planner, wanted: float,
             check: Callable[[Recording], object] = lambda recording: None,
             report: Report | None = None) -> Iterator[Round]:
    """Run motions until a set of effects has the probability asked for, or none can get it.

    Parameters
    ----------
    rig : what moves; ``planner`` knows config and limits.
    wanted : probability at which a set stands.
    check : of each recording before it is diagnosed; raises what is wrong with it.
    report : told what is done and how far it is, 0 to 1.

    Yields
    ------
    Round
        After each motion; the last one has an ``end``.

    Raises
    ------
    InputError
        If the limits allow no motion, or what came cannot be diagnosed.
    """
    say = report or (lambda text, share: None)
    say("planning the first motion", 0.0)
    planned: Planned | None = planner.first(rig.position())
    recordings: list[Recording] = []
    seconds, number = 0.0, 0
    while planned is not None:
        number += 1
        say(f"motion {number}: {planned.motion.words}", 0.0)
        ran = rig.run(planned.x_d, f"motion_{number:02d}")
        seconds += ran.recording.duration
        if ran.aborted:
            yield Round(planned, ran, seconds, end=ABORTED)
            return
        check(ran.recording)
        recordings.append(ran.recording)
        found, naming = diagnose_and_name(recordings, planner.settings, say)
        if naming is None:
            raise InputError(f"{ran.recording.source}: " + (
                f"{found.message}; expected a piston that follows the command"
                if found.verdict == "insufficient_data" else
                "the balances judge what this rig records, and plan nothing: advise says what to "
                "record"))
        one = judged(planned, ran, seconds, found, naming)
        one = following(planner, naming, one, wanted, rig.position())
        planned = one.following
        yield one


def judged(planned: Planned, ran: Ran, seconds: float, found: Diagnosis, naming: Naming
           ) -> Round:
    """Return what is known after a motion.

    Nothing stands beside a verdict that something without a name is there.
    """
    sets = standing(naming)
    order = [names for names in sets if found.verdict != "unexplained"] or [frozenset()]
    return Round(planned, ran, seconds, found, order[0],
                 sets[order[0]] if order[0] in sets and found.verdict != "unexplained" else 0.0,
                 {names: sets[names] for names in order[1:] if sets[names] >= 0.01})


def following(planner: Planner, naming: Naming, now: Round, wanted: float, position: float
              ) -> Round:
    """Return a round with the motion to run next; or why there is none."""
    if now.probability >= wanted:
        return replace(now, end=DECIDED)
    structures = running(naming)
    if 1.0 - structures[0].probability < FEW:  # what else may be there has no model yet
        structures = beside(naming.experiment, structures[0])
    contest = Contest(naming.experiment, structures, explained=naming.evidence)
    planned = planner.best(contest, position, planner.bounds.total_time - now.seconds)
    if planned is None:
        return replace(now, end=TIME)
    if planned.at_last > planned.now + WORTH:
        return replace(now, following=planned)
    return replace(now, end=INSEPARABLE, would=otherwise(contest, planned.x_d, planner.bounds))
