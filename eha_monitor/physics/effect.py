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

    A required one is a *size*: with all sizes at ``neutral`` the effect is absent.  One with a
    default is a *shape* inside the non-linearity; it is fitted too.
    """

    name: str  # symbol as it stands in configs and results, e.g. F_c
    unit: str  # SI, e.g. N
    description: str  # one phrase
    lower: float  # bounds, SI; values outside are refused by the config
    upper: float
    scale: float  # typical size, SI; the prior's standard deviation
    default: float | None = None  # of the config where it is not given; None: required
    neutral: float = 0.0  # value of a size at which the effect is absent
    fitted: bool = True  # False keeps a shape at its default when the effect is fitted
    log: bool = False  # a size fitted as its logarithm: what it does is not proportional to it
    # Integration steps that a time lasts at least: the equations leave out what is shorter, so in
    # a fit its range ends there.
    resolved: float = 0.0
    late: str = ""  # of a time: the signal that it makes late


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
    """What a record covers; thresholds are looked for inside (SI, absolute values)."""

    speed: float  # largest |v|
    position: float  # largest |x - middle|
    acceleration: float  # large |v'|
    pressure_difference: tuple[float, float, float, float]  # q50, q90, q98, max of |p1 - p2|
    lowest_pressure: tuple[float, float, float]  # q0.2, q2, q20 of the lower chamber pressure
    mean_pressure: float
    pump_speed: tuple[float, float, float, float]  # q50, q90, q98, max of |omega|
    pump_acceleration: tuple[float, float, float]  # q90, q98, max of |omega'|
    force: float  # large |A1 p1 - A2 p2|
    flow: float  # large |A v|
    sample_time: float
    duration: float
    middle: float = 0.0  # position half way between the ends of the motion


@dataclass(frozen=True)
class Effect:
    """One piece of physics beyond the linear model: equation, parameters, words."""

    name: str  # in the interface contract, e.g. coulomb_friction
    balance: str  # force, flow, drive or sensor
    equation: str  # as text for the report
    source: str  # where the equation comes from
    parameters: tuple[Parameter, ...]  # at most signals.MAX_PARAMETERS of them
    statement: str  # sentence with {symbol} places, see said()
    rig_check: str  # what to look at on the rig
    # Where a fit begins, of what a record covers: values of the parameters, each a *small but
    # visible* instance of the effect.  Several where the effect has a threshold.
    starts: Callable[[Ranges], tuple[dict[str, float], ...]]
    # Compiled term(s, p, m, c): reads signals s, parameters p and memory m and adds to the
    # contributions c (indices in physics.signals).
    term: Callable = no_term
    adds: tuple[int, ...] = ()  # contributions that the term adds to
    reads: tuple[int, ...] = ()  # signals that it reads
    rig_numbers: tuple[int, ...] = ()  # places of the rig's numbers behind the term's own in p
    # Compiled update(s, p, h, m): carries the memory m over an integration step of h seconds that
    # has ended at the signals s.  A new memory is all zero.
    update: Callable = no_update
    # Compiled circuit(p, w): adds to constants w of drive and sensors.
    circuit: Callable = no_circuit
    remembers_place: bool = False  # m[1] is a position; it moves along when a filter corrects it
    contains: tuple[str, ...] = ()  # simpler effects that are a special case of this one
    # Effects of one family explain one another's errors of form ("dry" friction, the flow through
    # a "gap"); two of them are named only where the second one is large.
    family: str = ""
    # What it takes power from, ``motion`` (friction) or ``pressure`` (a leak), or "": one that
    # would give power instead is no such effect.
    passive: str = ""
    # (size, other): the first is at most as large as the second, or it is another effect (friction
    # that differs by more than itself is a load).
    within: tuple[tuple[str, str], ...] = ()
    mimics: str = ""  # family whose errors of form it takes up: beside one, named only where large
    # Where one of conductance ``k`` opens, ``below`` a pressure of a chamber or ``beyond`` a
    # difference of both; the pressure is its second parameter.
    valve: str = ""
    rig_twin: str = ""  # number of the rig that does the same when it is wrong
    rarity: int = 1  # the larger, the less common on rigs; decides where a recording cannot

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
