"""Numbers of the config that least squares on the balances contradict, and what reads so.

Each line says what to write, or to look at, at which key.

F = M x'' + B x' + ... and A x' = D_p ω - ... give the moving mass and the pump's displacement of a
recording.  A number of the data sheet is rarely wrong by more than its tolerance; a filter on the
pressures, τ late, takes B·τ from the mass, and areas that are off by a factor take it from both.
"""

from collections.abc import Sequence
from itertools import permutations
from math import hypot, inf, isfinite, log

from eha_monitor.balances.baseline import BalanceFit, Baseline, Term
from eha_monitor.balances.policy import POLICY
from eha_monitor.plausibility.judge import units_in
from eha_monitor.plausibility.mistakes import PRESSURES
from eha_monitor.quantity import number, quantity, with_uncertainty
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import rounded

APART = 2.0  # deviations of both numbers from which on they contradict each other
OPEN = 0.05  # of a balance: with more unexplained, its mass may be something else
TURNING = 2.0  # times the mass or its inverse, that seals which turn round with the piston read as
LATEST = 0.03  # s: later than that no filter makes a pressure


def against_sheet(first: Baseline, settings: Settings) -> list[str]:
    """Return what a recording's least squares say against mass, pump and load of the config."""
    return [*cylinder_against(first, settings), *sizes_against(first, settings),
            *load_against((first,), settings)]


def cylinder_against(first: Baseline, settings: Settings) -> list[str]:
    """Return that areas or volumes are another cylinder's, or exchanged; at most two lines.

    The oil of a chamber, V_1 + A_1 x and V_2 - A_2 x, is left at either end of the motion.  With
    exchanged areas of a single rod the pump's displacement reads A_2/A_1 of the config's.
    """
    rig, found = settings.rig, []
    one, two, oil = rig.area_1, rig.area_2, (rig.volume_1, rig.volume_2)
    if not one or not two:
        return []
    # Areas that are off by a factor take the mass along.
    unequal = abs(log(one / two)) > APART * hypot(
        rig.tolerance.area_1, rig.tolerance.area_2) and not _off(
            first.force, "M", rig.mass, hypot(rig.tolerance.mass, rig.tolerance.area_1))
    pump = first.flow and first.flow["D_p"]
    if unequal and pump and pump.determined and rig.pump_displacement and any(
            abs(log(pump.value / rig.pump_displacement * ratio)) < APART * hypot(
                _share(pump), rig.tolerance.pump_displacement) for ratio in (one / two, two / one)
            ) and _off(first.flow, "D_p", rig.pump_displacement, rig.tolerance.pump_displacement):
        found.append(f"{_both(pump, rig.pump_displacement)}: area_1 and area_2 that are exchanged "
                     "read so")
    if None in oil or not all(map(isfinite, first.span)):
        return found

    def least(volume_1: float, volume_2: float) -> tuple[float, float]:
        return volume_1 + one * first.span[0], volume_2 - two * first.span[1]

    left = least(*oil)
    if min(left) < 0.0:
        which, unit = 1 + (left[1] < left[0]), "rad" if rig.motion == "rotary" else "m"
        swapped = "; exchanged they would do" if min(least(*oil[::-1])) > 0.0 else ""
        found.append(
            f"chamber {which} would hold {quantity(min(left), 'm³', 3)} of oil at x = "
            f"{quantity(first.span[which - 1], unit, 3)}: volume_1 and volume_2 are those at "
            f"x = 0, and βe is off as they are{swapped}")
    return found


def load_against(views: Sequence[Baseline], settings: Settings,
                 left: float | None = None) -> list[str]:
    """Return what is to be written where a constant load is not the config's: one line, or none.

    Of several recordings only where all have the same load; the first is told.
    F = A1 p1 - A2 p2 = ... + F_0: zeros of the pressures that are off read as a load, and so does
    the air that presses on the rod's own section, p_a (A1 - A2).

    Parameters
    ----------
    left : rms that the config leaves of the force, N, where no load is named: one that makes
        half of it is told, also where areas within their tolerance may read so.
    """
    if not views or any(one.force is None or not one.force.error_share < OPEN for one in views):
        return []
    rig, first, effects = settings.rig, views[0], settings.effects
    loads = [one.force["F_0"].value for one in views]
    if len(views) > 1 and max(loads) - min(loads) > APART * hypot(
            first.force["F_0"].stddev, first.leaning):
        return []
    load, given = first.force["F_0"], effects.get("constant_load", {}).get("F_0", 0.0)
    more = load.value - given
    known = hypot(load.stddev, rig.tolerance.effects * given)  # a weight has the mass's error
    beyond = APART * hypot(known, first.leaning)
    leans = abs(more) <= beyond
    if not load.determined or abs(more) <= (
            beyond if left is None else max(APART * known, 0.5 * left)):
        return []
    had = quantity(given, load.unit, 4) if given else "none"
    said = (f"constant load {with_uncertainty(load.value, load.stddev, load.unit)}, where the "
            f"config has {had}: if something weighs or pulls on the rod, write effects: "
            f"{{constant_load: {{F_0: {rounded(load.value):g}}}}}")
    if not (first.leaning and rig.area_1 and rig.area_2):
        return [said]
    high, low = ("high", "low") if more > 0 else ("low", "high")
    zeros = [f"{name} that reads {abs(more) / area / 1e5:.2g} bar too {way}"
             for name, area, way in (("p1", rig.area_1, high), ("p2", rig.area_2, low))]
    air = rig.ambient_pressure * (rig.area_1 - rig.area_2)
    rod = (f"; {quantity(air, load.unit, 3)} is what the open air does to the end of the rod"
           if not given and abs(air) > APART * load.stddev and rig.motion == "linear" else "")
    areas = ", and so may areas within their tolerance" if leans else ""
    return [f"{said}; a {zeros[0]}, or a {zeros[1]}, reads so too (offset of the channel){areas}"
            f"{rod}"]


def sizes_against(first: Baseline, settings: Settings) -> list[str]:
    """Return what the mass and the pump are by a recording, where the config has others."""
    rig = settings.rig
    mass, area = rig.tolerance.mass, rig.tolerance.area_1
    heavy = _off(first.force, "M", rig.mass, hypot(mass, area))
    if heavy and _turns(first.force, *heavy):
        heavy = None
    pumped = _off(first.flow, "D_p", rig.pump_displacement,
                  hypot(rig.tolerance.pump_displacement, area))
    if heavy and pumped:
        one, other = (log(term.value / given) for term, given in (heavy, pumped))
        if abs(one - other) < APART * hypot(_share(heavy[0]), _share(pumped[0]), mass):
            factor = pumped[0].value / pumped[1]
            size = f"{factor if factor > 1 else 1 / factor:.3g} times too " + (
                "large" if factor > 1 else "small")
            return [f"{_both(*heavy)}, {_both(*pumped)}: piston areas that are {size} read so"]
    found = []
    if heavy:
        written = units_in(settings).get("p1")
        found.append(_both(*heavy) + (_unit(*heavy, hypot(mass, area), written)
                                      or _late(first.force, *heavy)))
    if pumped:
        found.append(f"{_both(*pumped)}: is it right, and a revolution not taken for a radian?  "
                     "Areas that are off by the same factor, or a pump that slips, read so too")
    return found


def _off(fit: BalanceFit | None, name: str, given: float | None, tolerance: float
         ) -> tuple[Term, float] | None:
    """Return a term and the config's number where they contradict each other."""
    if fit is None or not given or not fit.error_share < OPEN:
        return None
    term = fit[name]
    if not term.determined or not term.value > 0:
        return None
    return (term, given) if abs(log(term.value / given)) > APART * hypot(
        _share(term), tolerance) else None


def _turns(fit: BalanceFit, mass: Term, given: float) -> bool:
    """Tell whether a mass may be dry friction that turns round where the acceleration is largest.

    It reads so by the form of its law, and leaves as much of the balance unexplained.
    """
    dry, factor = fit["F_c"], mass.value / given
    return (dry.determined and POLICY.sure(dry.value, dry.stddev)
            and abs(log(factor)) < log(TURNING)
            and abs(1.0 - 1.0 / factor) * mass.weight < fit.error_share)


def _share(term: Term) -> float:
    return term.stddev / term.value


def _both(term: Term, given: float) -> str:
    return (f"{term.words} {with_uncertainty(term.value, term.stddev, term.unit)}, where the "
            f"config has {quantity(given, term.unit)}")


def _unit(term: Term, given: float, tolerance: float, written: float | None) -> str:
    """Return which unit of the pressures, taken for another, makes that mass, where one does.

    ``written`` is the unit that the config gives, Pa; no other was taken for the right one.
    """
    spread = hypot(_share(term), tolerance)
    mixed = [(abs(log(given / term.value * PRESSURES[taken] / PRESSURES[meant])), taken, meant)
             for taken, meant in permutations(PRESSURES, 2)
             if not written or abs(log(PRESSURES[taken] / written)) < 1e-3]
    off, taken, meant = min(mixed, default=(inf, "", ""))
    return f": pressures in {meant} that are taken for {taken} read so" if (
        off < APART * spread) else ""


def _late(fit: BalanceFit, term: Term, given: float) -> str:
    """Return which channel's delay reads as that much less or more mass, where one can."""
    damping = fit["B"]
    delay = (given - term.value) / damping.value if damping.determined and damping.value else 0.0
    if not 0.0 < abs(delay) < LATEST:
        return ": is it right?"
    size = f"{number(abs(delay) * 1e3, 2)} ms late (a filter, another logger)"
    return ": is it right?  If so, " + (
        f"pressures that are {size} read so: set p1.delay and p2.delay" if delay > 0 else
        f"a position that is {size} reads so: set x.delay")
