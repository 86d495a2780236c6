"""What the mean of both pressures says: a make-up path that nothing empties holds it.

The flows into both chambers together, averaged over recordings in which the piston comes and goes,
A_2 / A_1 of the pump's flow going through chamber 2 (Merritt 1967, Eq. 6-39, with a make-up path):

    G (2 p_c - p_1 - p_2) = L (p_1 + p_2 - 2 p_a) + (A_1 - A_2) (v - D_p omega / A_1)

So a leakage across the piston leaves the mean pressure alone, and one to ambient lowers it, by
more than any tolerance of the source's pressure explains.  Check valves instead of that path let
both pressures rise above the source; then only the lowest is its own.  How large the leak is, is
known as well as G: where that leaves its size less than ``varied`` deviations from absent, no leak
is named, as no other effect is, and the source's pressure is what the recording contradicts.
"""

from collections.abc import Sequence

import numpy as np

from eha_monitor.balances.course import LOW, Course
from eha_monitor.balances.policy import Policy
from eha_monitor.mismatch.diagnosis import NamedEffect, RigFinding, Value
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import quantity, share
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig

EFFECT = "external_leakage"


def leak_or_source(courses: Sequence[Course], settings: Settings, displacement: float | None,
                   policy: Policy) -> NamedEffect | RigFinding | None:
    """Return the leak to ambient, or the source's pressure, that a mean pressure asks for.

    None where the config holds no make-up path, a source without pressure or that leak already,
    or where its mean pressure fits.

    Parameters
    ----------
    displacement : of the pump as the flow balance has it, m^3/rad.
    """
    rig = settings.rig
    if not rig.makeup_conductance or not rig.charge_pressure or EFFECT in settings.effects:
        return None
    if not displacement or not all(course.has_flow for course in courses):
        return None
    mean, piston, low = np.mean([_means(course, rig, displacement) for course in courses], axis=0)
    needed = mean + 0.5 * piston / rig.makeup_conductance
    if not needed > rig.ambient_pressure:
        return None
    factor = np.exp(rig.tolerance.log_spread("makeup_conductance"))
    doubt = 0.5 * abs(piston) / rig.makeup_conductance * factor / needed
    spread = float(np.hypot(rig.tolerance.log_spread("charge_pressure"), doubt))
    apart = float(np.log(rig.charge_pressure / needed)) / spread
    if abs(apart) < policy.varied:
        return None
    if apart < 0.0 and low < rig.charge_pressure * np.exp(policy.varied * spread):
        return None  # check valves hold the lower of both pressures there, and not their mean
    said = (f"the mean pressure of {quantity(mean, 'Pa', 3)} is {{}} the "
            f"{quantity(rig.charge_pressure, 'Pa', 3)} of its source by "
            f"{share(abs(mean / rig.charge_pressure - 1.0), 2)}")
    source = RigFinding("charge_pressure", rig.charge_pressure,
                        Value(needed, needed * doubt, "Pa"), policy.certain,
                        said.format("above" if apart < 0.0 else "below"),
                        () if apart < 0.0 else (EFFECT, "makeup_conductance"))
    if apart < 0.0:
        return source
    head = 2.0 * (mean - rig.ambient_pressure)
    size = 2.0 * rig.makeup_conductance * (rig.charge_pressure - needed) / head
    entry, value = CATALOGUE[EFFECT], Value(
        size, size * rig.tolerance.log_spread("makeup_conductance"), "m³/(s·Pa)")
    if not (value.value > 0.0 and policy.sure(value.value, value.stddev)):
        return source
    return NamedEffect(
        EFFECT, entry.balance, f"{said.format('below')}: a leak of both chambers to ambient", {
            "L_1": value, "L_2": value}, apart**2 / 2.0, ("charge_pressure", "makeup_conductance"),
        entry.equation, entry.rig_check, quantity(size * 0.5 * head, "m³/s", 2),
        probability=policy.certain)


def _means(course: Course, rig: Rig, displacement: float) -> tuple[float, float, float]:
    """Return the means of both absolute pressures and of the rod's flow, and the lowest; SI."""
    good = course.good
    both = np.stack([course.absolute(p, rig) for p in (course.p1, course.p2)])[:, good]
    more = (rig.area_1 - rig.area_2) * (course.v - displacement * course.omega / rig.area_1)
    return (float(both.mean()), float(more[good].mean()),
            float(np.quantile(both.min(axis=0), LOW)))
