"""The form of one entry of the catalogue of left-out physics."""

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from eha_monitor.compiled import njit
from eha_monitor.quantity import quantity, share, signed


@njit
def no_term(s, p, m, c):
    """Add nothing to the balances."""


@njit
def no_update(s, p, h, m):
    """Remember nothing."""


@njit
def no_circuit(p, w):
    """Leave drive and sensors as they are."""


def adds_to(*places: int) -> Callable:
    """Return a circuit that adds an effect's parameters to constants, the first to the first."""
    @njit(cache=False)  # kept with what calls it
    def circuit(p, w):
        for i, place in enumerate(places):
            w[place] += p[i]

    return circuit


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes
    ----------
    name : symbol as it stands in configs and results, e.g. ``F_c``.
    unit : SI unit, e.g. ``N``.
    description : one phrase.
    lower, upper : bounds in ``unit``; values outside are refused by the config.
    scale : typical size in ``unit``; the prior's standard deviation.
    default : value that the config takes when the parameter is not given; None means required.
        A required parameter is a *size*: with all sizes at ``neutral`` the effect is absent.  One
        with a default is a *shape* inside the non-linearity; it is fitted too.
    neutral : value of a size at which the effect is absent.
    fitted : False keeps a shape at its default when the effect is fitted.
    log : a size that is fitted as its logarithm: what it does is not proportional to it.
    resolved : integration steps that a time lasts at least: the equations leave out what is
        shorter, so in a fit its range ends there.
    """

    name: str
    unit: str
    description: str
    lower: float
    upper: float
    scale: float
    default: float | None = None
    neutral: float = 0.0
    fitted: bool = True
    log: bool = False
    resolved: float = 0.0


@dataclass(frozen=True)
class _Said:
    """A value in a statement: ``{F_c}`` with its unit, ``{k:%}`` in per cent, ``+`` with sign."""

    value: float
    unit: str
    rough: bool = False

    def __format__(self, form: str) -> str:
        if not math.isfinite(self.value):
            return "∞"
        if self.rough:
            return f"about {quantity(float(f'{self.value:.1e}'), self.unit, 2)}"
        if form.endswith("%"):
            return ("+" if form[0] == "+" and self.value > 0 else "") + share(self.value)
        return (signed if form == "+" else quantity)(self.value, self.unit, 3)


@dataclass(frozen=True)
class Ranges:
    """What a record covers; thresholds are looked for inside (SI, absolute values).

    Attributes
    ----------
    speed, position : largest |v| (m/s), largest |x - middle| (m).
    middle : position half way between the ends of the motion, m.
    acceleration : large |v'| (m/s^2).
    pressure_difference : (q50, q90, q98, max) of |p1 - p2|, Pa.
    lowest_pressure : (q0.2, q2, q20) of the lower chamber pressure, Pa.
    mean_pressure : Pa.
    pump_speed : (q50, q90, q98, max) of |omega|, rad/s.
    pump_acceleration : (q90, q98, max) of |omega'|, rad/s^2.
    force : large |A1 p1 - A2 p2|, N.
    flow : large |A v|, m^3/s.
    sample_time, duration : s.
    """

    speed: float
    position: float
    acceleration: float
    pressure_difference: tuple[float, float, float, float]
    lowest_pressure: tuple[float, float, float]
    mean_pressure: float
    pump_speed: tuple[float, float, float, float]
    pump_acceleration: tuple[float, float, float]
    force: float
    flow: float
    sample_time: float
    duration: float
    middle: float = 0.0


@dataclass(frozen=True)
class Effect:
    """One piece of physics beyond the linear model: equation, parameters, words.

    Attributes
    ----------
    name : name in the interface contract, e.g. ``coulomb_friction``.
    balance : ``force``, ``flow``, ``drive`` or ``sensor``.
    equation : the equation as text for the report.
    source : where the equation comes from.
    parameters : at most ``signals.MAX_PARAMETERS`` of them.
    statement : sentence with ``{symbol}`` places, see :meth:`said`.
    rig_check : what to look at on the rig.
    term : compiled ``term(s, p, m, c)``; reads signals ``s``, parameters ``p`` and memory ``m``
        and adds to the contributions ``c`` (indices in :mod:`eha_monitor.physics.signals`).
    adds, reads : the contributions that the term adds to and the signals that it reads, by their
        indices.
    rig_numbers : places of the rig's numbers that stand in ``p`` behind the term's parameters.
    update : compiled ``update(s, p, h, m)``; carries the memory ``m`` over an integration step of
        ``h`` seconds that has ended at the signals ``s``.  A new memory is all zero.
    circuit : compiled ``circuit(p, w)``; adds to the constants ``w`` of drive and sensors.
    remembers_place : m[1] is a position; it moves along when a filter corrects the position.
    contains : simpler effects that are a special case of this one.
    family : effects of one family explain one another's errors of form ("dry" friction, the flow
        through a "gap"); two of them are named only where the second one is large.
    passive : what it takes power from, ``motion`` (friction) or ``pressure`` (a leak), or "": one
        that would give power instead is no such effect.
    mimics : family whose errors of form it takes up; beside a law of that family it is named only
        where it is large.
    within : (size, other) pairs: the first is at most as large as the second, or it is another
        effect (friction that differs by more than itself is a load).
    valve : where one of conductance ``k`` opens, ``below`` a pressure of a chamber or ``beyond`` a
        difference of both; the pressure is its second parameter.
    rig_twin : number of the rig that does the same when it is wrong: one cannot be distinguished
        from the other.
    rarity : the larger, the less common on rigs; decides where a recording cannot.
    starts : ``starts(ranges)`` returns where a fit begins: dicts of parameter values, each a
        *small but visible* instance of the effect.  Several where the effect has a threshold.
    """

    name: str
    balance: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    statement: str
    rig_check: str
    starts: Callable[[Ranges], tuple[dict[str, float], ...]]
    term: Callable = no_term
    adds: tuple[int, ...] = ()
    reads: tuple[int, ...] = ()
    rig_numbers: tuple[int, ...] = ()
    update: Callable = no_update
    circuit: Callable = no_circuit
    remembers_place: bool = False
    contains: tuple[str, ...] = ()
    family: str = ""
    passive: str = ""
    within: tuple[tuple[str, str], ...] = ()
    mimics: str = ""
    valve: str = ""
    rig_twin: str = ""
    rarity: int = 1

    @property
    def sizes(self) -> tuple[Parameter, ...]:
        """The parameters without which the effect is absent."""
        return tuple(p for p in self.parameters if p.default is None)

    def said(self, values: Mapping[str, float], rough: Collection[str] = ()) -> str:
        """Return the statement with its numbers; a limit that is infinite is left out.

        Parameters
        ----------
        values : value of each parameter in the statement by its name, SI.
        rough : those that stand for what lies around them, and are no estimates.
        """
        text = self.statement.format(**{p.name: _Said(values[p.name], p.unit, p.name in rough)
                                        for p in self.parameters if p.name in values})
        return re.sub(r" and ∞|∞ and ", "", text)
