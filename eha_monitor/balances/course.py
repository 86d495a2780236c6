"""The measured motion of a recording on a coarse grid, and which of its samples count.

The balances are compared as they stand, with velocity and acceleration from the position
(inverse dynamics: Gautier, Janot, Vandanjon 2013).  Both sides of a balance pass the same
low-pass without phase, so that a linear law stays exactly that law whatever the band.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from eha_monitor.physics import signals as s
from eha_monitor.quantity import share
from eha_monitor.settings.rig import Rig

LOW = 0.05  # of the samples of an emptier chamber: what stands for its lowest pressure
AWHILE = 1e-3  # of the samples: a pressure that is reached, and not by noise
EMPTY = 0.1  # of the samples in which a chamber is the emptier one, for that to be said
# Hz: pass bands of the balances, the next one where a motion is too quick for the one before.
BANDS = 5.0, 20.0
BAND = BANDS[0]
MOTION = 4.0  # bands: pass band of the motion
GRID, COARSE = 32, 4  # points in a period of the band; each so-many-th of them is compared
NO_MOTION = "nothing moves in it"
FED = 0.05  # of the highest pressure over the source's: below, check valves may feed a chamber
TOP = 0.98  # quantile of a pressure that counts as its highest
MIXED = 0.5  # periods of the band over which its low-pass mixes a sample with its neighbours
STEADY = 16  # compared samples that go steadily one way
HUNTS = 0.1  # of the motion: less of it steady is a drive that hunts, and shows no friction
STANDING = 0.02  # of the top speed: below it dry friction takes any value
COMMANDED, MEASURED = 0.005, 0.05  # of its size: a smaller demand has no sign; noise-free, noisy
TRAVEL = 20.0  # times the position's noise: less is no motion
DESIGNS = 64  # low-passes that are kept
# Whose oil a pump presses: of the chamber that it is asked to fill, or that has the higher
# pressure, always of chamber 1, of both.
IN_TURN, HIGHER, CHAMBER_1, BOTH = "in_turn", "higher_pressure", "chamber_1", "both"
ONE_PUMP = "one_pump"  # fills the chamber of the higher pressure, whose area its flow moves
CLOSED = 0.75  # of what the higher pressure rises, the lower one falls
ROUNDING = 1e-9  # of its size: what changes less keeps one value


@dataclass(frozen=True)
class Course:
    """A recording on a grid of ``GRID`` points a period of the band; (m,) each, SI, not yet in it.

    Attributes
    ----------
    source : file it came from.
    band : pass band of its balances, Hz.
    dt : spacing of the grid, s.
    steps : of the effects' memory in it.
    x, v, a : position, velocity, acceleration.
    force : A1 p1 - A2 p2, or the measured force.
    p1, p2, rate_1, rate_2 : pressures and their rates; None where not recorded.
    omega : pump speed, rad/s; None where not recorded.
    wanted : speed that the drive is commanded, as the config's own drive would follow it, rad/s;
        None where it is not recorded or no measured speed stands beside it.
    demand : what the drive or valve is commanded, any unit: only its sign is used; None if no
        channel says.
    quiet : share of its usual size below which the demand has no sign.
    known : balance -> what the config's own effects add to it, (m,), or as of either chamber
        (2, m); ``at_rest`` is the force that they hold at each place without any motion, (m,) N;
        ``stroke`` is the rate at which volumes that change over the stroke take up oil at
        the pressure of 1 Pa, m³·Pa/s.  See :meth:`added`.
    sensors : (n_x, n_p, n_omega, n_force) noise of the channels in one sample, SI.
    skew : by how much one channel may be late against another, s: half a sample.
    passed : (band's response to white noise, and to its derivative in 1/s), rms.
    gauge : the pressures are read above the ambient one.
    ratio : area of chamber 2 over that of chamber 1; None of a rig without areas.
    good : (m,) bool, measured on all channels and away from stops.
    moving : (m,) bool, fast enough for dry friction to have a sign.
    oil : whose oil the pump's flow presses, ``IN_TURN``, ``HIGHER``, ``CHAMBER_1``, ``BOTH`` or
        ``ONE_PUMP``, the same in all recordings of a machine
        (:func:`~eha_monitor.balances.together.of_one_machine`); "" where the motion itself is to
        say so.
    apart : share by which the pump moves chamber 2 farther than the config's areas say.
    viscosity : of the oil at the temperature that the recording measures, over that at the
        reference temperature (``viscosity`` of the config); NaN where no channel has it.
    effects : of the config, by name, SI; they are in ``known``.
    wide : the same motion in a wider band; None where this is the widest that it has.
    """

    source: str
    band: float
    dt: float
    steps: int
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    force: np.ndarray
    p1: np.ndarray | None
    p2: np.ndarray | None
    rate_1: np.ndarray | None
    rate_2: np.ndarray | None
    omega: np.ndarray | None
    wanted: np.ndarray | None
    demand: np.ndarray | None
    quiet: float
    known: dict[str, np.ndarray]
    sensors: dict[str, float]
    skew: float
    passed: tuple[float, float]
    gauge: bool
    ratio: float | None
    good: np.ndarray
    moving: np.ndarray
    oil: str = ""
    apart: float = 0.0
    viscosity: float = np.nan
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    wide: "Course | None" = None

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def quick(self) -> "Course":
        """The same motion in the widest band that it has, with the samples of this one."""
        if self.wide is None:
            return self
        at = np.arange(len(self.wide)) * self.wide.dt / self.dt
        here = self.good[np.minimum(at.astype(int), len(self) - 1)]
        return replace(self.wide, oil=self.oil, apart=self.apart, good=self.wide.good & here,
                       moving=self.wide.moving & here)

    @property
    def speed(self) -> float:
        """Top speed, m/s."""
        return float(np.quantile(np.abs(self.v[self.good]), 0.998))

    @property
    def direction(self) -> np.ndarray:
        """Sign of the velocity, linear through zero below the standing speed; (m,)."""
        return np.clip(self.v / max(STANDING * self.speed, 1e-12), -1.0, 1.0)

    @property
    def every(self) -> int:
        """Of the grid's points each so-many-th is compared; the finer ones keep signs in place."""
        return max(1, round(COARSE / (GRID * self.band * self.dt)))

    @property
    def step(self) -> float:
        """Spacing of the compared points, s."""
        return self.every * self.dt

    @property
    def seconds(self) -> float:
        """How long it can be compared, s."""
        return float(self.good.sum()) * self.dt

    @property
    def shows(self) -> bool:
        """Whether the piston moves in it, and the force with it."""
        return not self.still

    @cached_property
    def steady(self) -> float:
        """Share of its motion that goes steadily one way, as its band shows it."""
        fast = int(np.sum(self.good & (np.abs(self.v) >= STANDING * self.speed)))
        return int(self.moving.sum()) / fast if fast else 1.0

    @property
    def too_quick(self) -> bool:
        """Whether it reverses too often for its band."""
        return self.steady < HUNTS

    @cached_property
    def still(self) -> str:
        """What does not move in it, in words; empty where the piston does, and its force."""
        steady = int(self.moving.sum())
        rested = not steady and (not self.good.any() or np.ptp(self.x[self.good])
                                 <= TRAVEL * self.sensors["x"])
        if rested:
            return NO_MOTION
        if self.too_quick:
            turns = np.sum(self.v[1:] * self.v[:-1] < 0.0) / (len(self) * self.dt)
            return (f"it reverses {turns:.2g} times a second (a drive that hunts?): too little "
                    f"of its motion, {share(self.steady, 2)}, goes steadily one way")
        if self.compared(self.moving).sum() < STEADY:
            return f"it goes steadily one way for {steady * self.dt:.2g} s only: too little"
        pressures = [one for one in (self.p1, self.p2) if one is not None]
        if pressures and not any(_changes(one[self.good]) for one in pressures):
            return "the pressures keep one value, to the last digit"
        return "" if _changes(self.force[self.good]) else (
            "the force on it keeps one value, to the last digit: it is not measured, or changes "
            "by less than a digit")

    @property
    def has_flow(self) -> bool:
        """Whether it holds a flow balance."""
        needed = (self.ratio, self.p1, self.p2, self.omega)
        return all(one is not None for one in needed) and bool(np.any(self.omega[self.good]))

    @cached_property
    def mean_of_both(self) -> bool:
        """Whether the flow balance is the mean of both chambers', which halves the noise."""
        return (self.oil or oil_of([self])) == BOTH

    @cached_property
    def commanded(self) -> np.ndarray:
        """Side to which valve or pump act, (m,): the sign of the last real demand.

        Where no channel says what is demanded, that of the last motion; 0 before the first.
        """
        signal = self.v if self.demand is None else self.demand
        return last_sign(signal, self.quiet * float(np.quantile(np.abs(signal), 0.98)))

    @cached_property
    def pumped_side(self) -> np.ndarray:
        """Chamber whose oil the pump presses, (m,): 1, -1, or 0 before the first demand.

        Behind valves it is the demand that says so, not the pressure: that falls at each switch.
        Where check valves feed the chamber of the lower pressure, it is the other one, whichever
        way the pump turns: a load or a source's own force may drive it.
        """
        if self.oil == CHAMBER_1:
            return np.ones(len(self))
        if self.demand is None or self.ratio == 1.0 or self.oil in (HIGHER, ONE_PUMP):
            return np.where(self.p1 > self.p2, 1.0, -1.0)
        return self.commanded

    @cached_property
    def as_of_chamber_1(self) -> np.ndarray | float:
        """What a flow of the filled chamber is worth at chamber 1's area, (m,)."""
        return 1.0 if self.ratio == 1.0 else np.where(self.pumped_side > 0.0, 1.0,
                                                      1.0 / self.ratio)

    def of_pump(self, values: np.ndarray) -> np.ndarray:
        """Return a speed of the pump, or what goes with it, as of chamber 1, (m,).

        Of two pumps, or a pump and a valve, whose flows match the areas it is the speed itself; a
        single one moves A2 x' = D_p omega where it fills chamber 2.
        """
        return values * self.as_of_chamber_1 if self.oil == ONE_PUMP else values

    def taken(self, rig: Rig) -> np.ndarray:
        """Return the flow that the piston takes, as of chamber 1, (m,) m³/s."""
        flow = rig.area_1 * self.v
        if self.apart and not self.mean_of_both:
            flow = np.where(self.pumped_side < 0.0, flow / (1.0 + self.apart), flow)
        return flow

    def of_filled(self, one: np.ndarray, two: np.ndarray) -> np.ndarray:
        """Return what holds for the chamber that the pump fills, or the mean of both chambers."""
        if self.mean_of_both:
            return 0.5 * (one + two)
        return np.where(self.pumped_side > 0.0, one, two)

    def added(self, balance: str) -> np.ndarray:
        """Return what the config's own effects add to a balance, (m,) SI."""
        known = self.known[balance]
        return known if known.ndim == 1 else self.of_filled(*known)

    def resting(self, balance: str) -> np.ndarray:
        """Return what the config's loads hold at rest of a balance, (m,): of the force alone."""
        nothing = np.zeros(len(self))
        return self.known.get("at_rest", nothing) if balance == "force" else nothing

    def in_band(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (m, k) or (m,) after the low-pass of every balance, compared points."""
        return low_pass(columns, self.band, self.dt)[:: self.every]

    def compared(self, values: np.ndarray) -> np.ndarray:
        """Return values (m,) at the compared points."""
        return values[:: self.every]

    def counted(self, balance: str) -> np.ndarray:
        """Return which samples of a balance count, (m,) bool.

        Those of the force only at a steady direction: dry friction at rest is a reaction, which
        holds whatever the pressures make up to its limit, and of which no law of motion knows.
        Of the flow not those where check valves feed both chambers: a load moves the piston then,
        and the pump's flow goes round.
        """
        if balance == "force":
            return self.moving
        if balance == "flow" and self.oil in (HIGHER, ONE_PUMP):
            return self.good & ~self.fed
        return self.good

    @cached_property
    def fed(self) -> np.ndarray:
        """Where both chambers are at the pressure of what feeds the emptier one, (m,) bool."""
        if not self.good.any():
            return np.zeros(len(self), dtype=bool)
        high, low = np.maximum(self.p1, self.p2), np.minimum(self.p1, self.p2)
        source = np.quantile(low[self.good], LOW)
        both = high - source < FED * (np.quantile(high[self.good], TOP) - source)
        near = max(1, round(MIXED / self.band / self.dt))
        return np.convolve(both, np.ones(2 * near + 1), mode="same") > 0.5

    def track(self) -> np.ndarray:
        """Return the signals of the catalogue's terms, (m, N_SIGNALS)."""
        found = np.zeros((len(self), s.N_SIGNALS))
        found[:, s.T] = np.arange(len(self)) * self.dt
        found[:, s.X], found[:, s.V] = self.x, self.v
        for place, values in ((s.P1, self.p1), (s.P2, self.p2), (s.OMEGA, self.omega)):
            if values is not None:
                found[:, place] = values
        if self.omega is not None:
            found[:, s.ANGLE] = self.dt * np.cumsum(self.omega)
        return found

    def absolute(self, pressure: np.ndarray, rig: Rig) -> np.ndarray:
        """Return the absolute pressure of a reading, Pa."""
        return pressure + rig.ambient_pressure if self.gauge else pressure

    def lowest(self, rig: Rig) -> tuple[float, float]:
        """Return the lowest absolute pressure of each chamber, Pa; NaN where nothing says it.

        What feeds a chamber that runs empty (an accumulator through its make-up valve, the tank)
        sets it, and neither load nor temperature moves it much.  Of a chamber that is hardly ever
        the emptier one it is not known.
        """
        if self.p1 is None or self.p2 is None or not self.good.any():
            return np.nan, np.nan
        p1, p2 = (self.absolute(p, rig)[self.good] for p in (self.p1, self.p2))
        # Which one is emptier a zero that is off says wrongly where both are as low.
        return tuple(float(np.quantile(p, LOW * part)) if (part := emptier.mean()) > EMPTY
                     else np.nan for p, emptier in ((p1, p1 < p2), (p2, p2 < p1)))

    def as_low(self, rig: Rig, chamber: int, pressure: float) -> bool:
        """Tell whether the absolute pressure of a chamber comes below another, Pa, for a while."""
        p = self.absolute(self.p1 if chamber == 1 else self.p2, rig)[self.good]
        return bool(np.mean(p < pressure) > AWHILE)

    def floor(self, balance: str, rig: Rig) -> float:
        """Return the rms that the sensors alone leave in a balance in its band, SI."""
        level, slope = self.passed
        n = self.sensors
        if balance == "force":
            measured = (np.hypot(rig.area_1, rig.area_2) * n["p"] if self.p1 is not None
                        and rig.area_1 and rig.area_2 else n["force"])
            return float(np.hypot(measured * level, rig.viscous_damping * n["x"] * slope))
        if balance == "drive":
            return float(n["omega"] * level)
        soft = (rig.volume_1 or 0.0) / rig.bulk_modulus
        return float(np.sqrt((rig.area_1 * n["x"] * slope) ** 2 + (soft * n["p"] * slope) ** 2
                             + ((rig.pump_displacement or 0.0) * n["omega"] * level) ** 2))


def last_sign(signal: np.ndarray, level: float) -> np.ndarray:
    """Return the sign of a signal's (m,) last value beyond a level; 0 before the first."""
    marks = np.where(signal > level, 1.0, np.where(signal < -level, -1.0, 0.0))
    places = np.where(marks != 0.0, np.arange(len(marks)), 0)
    return marks[np.maximum.accumulate(places)]


def oil_of(courses: Sequence[Course]) -> str:
    """Return whose oil a pump presses in a machine, as the pressures of all its motions say.

    Of two closed chambers the lower pressure falls by what the higher one rises; where check
    valves hold it at the source's it stays, and only the filled chamber's oil is compressed.  The
    balance of the filled chamber holds for either, with more noise: that of both only where the
    chambers are clearly closed, and of equal areas.
    """
    if any(course.ratio != 1.0 for course in courses):
        return IN_TURN
    shared = high = 0.0
    for course in courses:
        pressures = np.sort(np.stack([course.p1, course.p2])[:, course.good], axis=0)
        (_, together), (_, upper) = np.cov(pressures)
        shared, high = shared + together, high + upper
    return BOTH if -shared >= CLOSED * high else IN_TURN


def _changes(values: np.ndarray) -> bool:
    """Tell whether values are more than one, but for rounding."""
    return bool(np.ptp(values) > ROUNDING * np.abs(values).max())


@lru_cache(DESIGNS)
def passed(dt: float, band: float) -> tuple[float, float]:
    """Return the rms of white noise of one, and of its derivative, behind a balance's low-pass."""
    half = max(8, round(3.0 / band / dt))
    impulse = np.zeros(2 * half + 1)
    impulse[half] = 1.0
    response = low_pass(impulse, min(band, 0.2 / dt), dt)
    return (float(np.sqrt(np.sum(response**2))),
            float(np.sqrt(np.sum(slope(response, dt) ** 2))))


def slope(values: np.ndarray, dt: float) -> np.ndarray:
    """Return the derivative of samples (n,), of fourth order but for two at either end.

    A difference of two neighbours loses (omega dt)^2/6 of a velocity, which stands beside the
    pump's flow like inertia on soft oil: at 2 ms a fifth of the compliance of a usual cylinder.
    """
    found = np.gradient(values, dt)
    if len(values) > 4:
        found[2:-2] = (8.0 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])) / (
            12.0 * dt)
    return found


@lru_cache(DESIGNS)
def _sections(cutoff: float, dt: float) -> np.ndarray:
    """Return the second-order sections of the low-pass; a design takes as long as a use of it."""
    from scipy.signal import butter  # takes half of the start of a command

    return butter(4, cutoff, fs=1.0 / dt, output="sos")


def low_pass(values: np.ndarray, cutoff: float, dt: float) -> np.ndarray:
    """Return values (n,) or (n, k) behind a Butterworth low-pass of ``cutoff`` Hz, both ways."""
    from scipy.signal import sosfiltfilt

    return sosfiltfilt(_sections(cutoff, dt), values, axis=0,
                       padlen=min(len(values) - 1, round(1.0 / dt)))
