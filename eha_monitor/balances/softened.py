"""What another stiffness of the oil makes of the flow, to be seen and judged on unseen parts."""

from collections.abc import Sequence

import numpy as np

from eha_monitor.balances.candidates import SIDES
from eha_monitor.balances.course import Course
from eha_monitor.balances.least_squares import beside
from eha_monitor.balances.oil import clearest, flow_of
from eha_monitor.balances.places import binned
from eha_monitor.mismatch.diagnosis import Curve, SignalFit
from eha_monitor.settings.rig import Rig


def softened(courses: Sequence[Course], rig: Rig, healthy: float, now: float
             ) -> tuple[Curve, SignalFit] | None:
    """Return the flow that another stiffness takes up, against the rate of the pressure.

    And what either stiffness leaves of the flow on unseen parts, all else fitted.

    Parameters
    ----------
    healthy, now : 1/beta_e, 1/Pa.
    """
    rates, missing, made, squares = [], [], [], []
    for course in courses:
        found = clearest(course, rig)
        balance = None if found is None else flow_of(found[0], rig)
        fits = [] if balance is None else [
            (fit, pressed) for pressed in balance.pressed
            if (fit := balance.left(pressed, now)) is not None]
        if not fits:
            continue
        fit, pressed = min(fits, key=lambda one: one[0].error_share)
        rows = balance.rows(balance.flow, pressed, *(column[-1] for column in balance.columns),
                            *balance.off)
        rest = beside(rows[:, 0] + now * rows[:, 1], rows[:, 2:])
        taken = (healthy - now) * rows[:, 1]
        rates.append(rows[:, 1] / rig.volume_1)
        missing.append(rest + taken)
        made.append(taken)
        before = balance.left(pressed, healthy)
        squares.append(fit.samples * np.square([
            before.unseen_share * np.std(rows[:, 0] + healthy * rows[:, 1]),
            fit.unseen_share * np.std(rows[:, 0] + now * rows[:, 1]),
            balance.course.floor("flow", rig), np.std(rows[:, 0]), 1.0]))
    if not rates:
        return None
    x, middle, width, shown = binned(*map(np.concatenate, (rates, missing, made)))
    total = np.sum(squares, axis=0)
    left = np.sqrt(total[:-1] / total[-1]).tolist()
    unit = SIDES["flow"]
    return (Curve("flow", "pressure_rate", "Pa/s", unit, x, middle, width, shown),
            SignalFit(unit, *left[:3], signal_rms=left[3]))
