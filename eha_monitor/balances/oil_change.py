"""Whether the oil of a recording became another while it ran: air that enters, or has left.

1/beta_e shows in a wider band than the other numbers (:mod:`oil`), and a few strokes hold it: so
it is fitted to parts of a recording, and the mean before is compared with the mean since.
"""

from dataclasses import replace

import numpy as np

from eha_monitor import ties
from eha_monitor.balances.course import Course
from eha_monitor.balances.oil import compressibility
from eha_monitor.balances.policy import Policy
from eha_monitor.mismatch.diagnosis import ChangePoint, Value
from eha_monitor.quantity import with_uncertainty
from eha_monitor.settings.rig import Rig

PART_S = 5.0  # of motion: some strokes
MOST = 12  # parts; those of a long recording are longer
FEWEST = 2  # parts on either side, of which a step is the mean


def oil_change(course: Course, rig: Rig, policy: Policy) -> ChangePoint | None:
    """Return when 1/beta_e stepped, None where it did not.

    A step is surely there, and more than the ``between`` by which the oil of a machine differs
    from recording to recording.  The deviations hold what the rest of the flow may look like, the
    same before and since: of healthy oil no step of 200 recordings came to 2 of them.  Parts whose
    motion does not determine the oil count for none.
    """
    count = min(MOST, int(course.seconds / PART_S))
    if count < 2 * FEWEST or not course.has_flow:
        return None
    t = np.arange(len(course)) * course.dt
    edges = np.linspace(t[course.good][0], t[course.good][-1], count + 1)
    parts = np.searchsorted(edges, t, side="right") - 1
    cut = [replace(course, good=course.good & (parts == i), moving=course.moving & (parts == i))
           for i in range(count)]
    known = [(i, term.value, term.stddev) for i, part in enumerate(cut)
             if part.has_flow and (term := compressibility(part, rig)) is not None]
    if len(known) < 2 * FEWEST:
        return None
    place, value, stddev = (np.array(column) for column in zip(*known, strict=True))
    weight = 1.0 / stddev**2
    steps = []
    for k in range(FEWEST, len(known) - FEWEST + 1):
        before, since = (float(np.average(value[some], weights=weight[some]))
                         for some in (slice(None, k), slice(k, None)))
        # Their form is the same in all parts: it is no chance, and no number of parts narrows it.
        apart = float(np.hypot(*(np.median(stddev[some]) for some in (
            slice(None, k), slice(k, None)))))
        steps.append((abs(since - before) / apart, before, since, apart, k))
    size, before, since, apart, k = ties.best(steps, lambda step: step[0])
    if size < policy.varied or abs(since - before) < policy.between * before:
        return None
    start, stop = float(edges[place[k - 1]]), float(edges[place[k] + 1])
    moduli = [1.0 / one for one in (before, since)]
    error = apart / since**2
    words = " to ".join((with_uncertainty(moduli[0], apart / before**2, "Pa"),
                         with_uncertainty(moduli[1], error, "Pa")))
    return ChangePoint(
        course.source, start, stop, "bulk_modulus", "beta_e", "flow",
        Value(moduli[1] - moduli[0], float(np.hypot(apart / before**2, error)), "Pa"), 0.0,
        f"between {start:.1f} and {stop:.1f} s the effective bulk modulus "
        f"{'rose' if moduli[1] > moduli[0] else 'fell'} from {words}")
