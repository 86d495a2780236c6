"""The lowest pressure of the chambers, that of what feeds them: accumulator, check valves."""

from collections.abc import Sequence

import numpy as np

from eha_monitor.balances.course import BOTH, Course
from eha_monitor.balances.judged import Moved
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.scatter import t_of_next
from eha_monitor.mismatch.diagnosis import Change, Value
from eha_monitor.quantity import with_uncertainty
from eha_monitor.settings.rig import Rig

LOWEST = 0.05  # of the lowest pressure: less of it is no change
LEAST_SPREAD = 1e-3  # of the lowest pressure: what healthy recordings differ by at least


def source_of(machine: Machine, courses: Sequence[Course], rig: Rig, load: Moved | None
            ) -> Change | None:
    """Return how the lowest pressure of the chambers has changed, if farther than healthy.

    By Student's t for one further recording, and by more than ``LOWEST`` of itself.  What feeds
    both has changed where both have; one alone has its own make-up valve, or sensor.  Behind a
    valve, and where chambers are closed to each other, a load moves the lower pressure.  Nor has a
    source risen below which a chamber still comes: a load leaves it less time there.
    """
    if machine.oil == BOTH or machine.pieces or not all(course.has_flow for course in courses):
        return None
    means = np.mean([course.lowest(rig) for course in courses], axis=0)
    off, alike = {}, []  # chamber -> healthy and present pressure; those that are as before
    for chamber, row, here in zip((1, 2), machine.lowest, means.tolist(), strict=True):
        if not np.isfinite(here) or len(row) < machine.policy.fewest:
            continue
        of = float(np.mean(row))
        spread = max(float(np.std(row, ddof=1)), LEAST_SPREAD * of)
        t, limit = t_of_next(here - of, spread, len(row), machine.policy.false)
        still = here > of and any(
            course.as_low(rig, chamber, 0.5 * (here + of)) for course in courses)
        if abs(t) > limit and abs(here - of) > LOWEST * of and not still:
            off[chamber] = (of, here, spread)
        else:
            alike.append(chamber)
    if not off:
        return None
    of, here, spread = np.mean(list(off.values()), axis=0).tolist()
    if load is not None and abs(here - of) * min(rig.area_1, rig.area_2) <= abs(
            load.here - load.machine):
        return None
    what, whose, rest = "charge_pressure", (
        "the lowest pressure of a chamber, that of what feeds it (accumulator, check valve),"), ""
    if alike:
        what, whose, rest = "makeup_valve", f"the lowest pressure of chamber {min(off)}", (
            f", and that of chamber {alike[0]} as before: its own make-up valve or line has "
            "changed, not what feeds both")
    return Change(what, "", "flow", Value(of, spread, "Pa"), Value(here, spread, "Pa"), "Pa", (
        f"{whose} is {with_uncertainty(here, spread, 'Pa')}, where {machine.runs} have "
        f"{with_uncertainty(of, spread, 'Pa')}{rest}"), ("pressure_offset",))
