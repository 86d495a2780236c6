"""Relations that hold on every rig, checked on a recording as one hypothesis reads it.

Each is a regression of one side on the other with what honest physics adds beside it, and each
answers with a ratio that is 1 where signals and config are of one rig.  ``penalty`` is how many
log units it costs to believe the reading all the same: rig numbers are a little wrong, physics is
missing, and a correlation that is weak says little.  The penalty has a long tail (Student's t
with 3 degrees of freedom), so that one odd relation never decides by itself how odd it is.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import copysign, inf, log, log10, sqrt

import numpy as np

from eha_monitor.plausibility.moments import DIRECTION, Moments
from eha_monitor.quantity import ROTARY
from eha_monitor.settings.channels import CHANNEL_UNITS

# Of the share of a side that the others cannot explain: below, they are the same thing.
DISTINCT = 1e-3
NOISY = 0.3  # of a side's variance must be signal
# Of the left side's mean, what honest physics and numbers a little wrong may vary unexplained
# in a stroke at constant speed.
UNSURE = 0.05
VARIES = 2.0  # times that much must the left side vary, to be asked at all
COLLINEAR = 1e-9  # share of a side that others leave of it, below which it is one of them


@dataclass(frozen=True)
class Source:
    """A channel as a hypothesis reads it: SI value = factor * recorded + offset."""

    channel: str
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Reading:
    """A recording and a rig as one hypothesis reads them."""

    moments: Moments
    roles: dict[str, Source]  # role (``x``, ``p1``, ...) -> where it is read; those recorded
    rig: dict[str, float | None]  # numbers of the rig by key, SI; None where it has none
    # keys of the rig that somebody wrote; the others are defaults and bind nobody
    said: frozenset[str] = frozenset()
    clock: float = 1.0  # true seconds for one recorded second
    rotary: bool = False  # x is an angle
    # role -> unit that the config gives its column or topic, SI; absent where it gives none
    units: dict[str, float] = field(default_factory=dict)

    def has(self, *roles: str) -> bool:
        """Tell whether each role is recorded and varies."""
        return all(role in self.roles and (self.roles[role].channel, 0) in self.moments.place
                   for role in roles)

    @property
    def one_way(self) -> float:
        """Share of the piston's speed that is its mean, 0 to 1: 1 for a constant speed.

        Beside motion both ways, a mean is a load or a zero error, which does not vary.
        """
        place = self.moments.place.get((self.roles["x"].channel, 1)) if "x" in self.roles else None
        mean = self.moments.mean[place] if place is not None else inf
        return 1.0 / sqrt(1.0 + 1.0 / mean**2) if mean else 0.0

    def column(self, role: str, order: int = 0, scale: float = 1.0) -> np.ndarray:
        """Return ``scale`` times a derivative of a role as (m,) weights of the columns."""
        source, out = self.roles[role], np.zeros(len(self.moments.scale))
        place = self.moments.place[source.channel, order]
        by = np.sign(source.factor) if order == DIRECTION else source.factor / self.clock**order
        out[place] = scale * by * self.moments.scale[place]
        return out


@dataclass(frozen=True)
class Ratio:
    """Slope of one side on the other beside the rest, and their partial correlation.

    In a stroke at constant speed, what varies is what the relation leaves out: ``UNSURE`` of the
    left side's mean counts as unexplained there.  ``share`` is the part of the left side's
    variance that all of the right side explains.
    """

    slope: float
    rho: float
    share: float


def ratio(reading: Reading, left: np.ndarray, right: np.ndarray, *beside: np.ndarray
          ) -> Ratio | None:
    """Regress ``left`` on ``right`` and ``beside``, each (m,) weights of the columns.

    None where they do not vary on their own.
    """
    sides = np.array([left, right, *beside])
    c = (sides @ reading.moments.gram @ sides.T).tolist()
    if not (0.0 < c[0][0] < inf and 0.0 < c[1][1] < inf):
        return None
    left_blur, right_blur = (sides[:2] ** 2 @ reading.moments.noise).tolist()
    whole, other = c[0][0], c[1][1]
    unsure = (UNSURE * reading.one_way * float(left @ reading.moments.mean)) ** 2
    swept(c)
    if (c[1][1] < DISTINCT * other or c[0][0] < 1e-12 * whole or whole < VARIES**2 * unsure):
        return None
    # White noise of the sensors is no physics that is missing, and draws no slope to zero.
    signal = c[1][1] - right_blur
    if signal < NOISY * c[1][1]:
        return None
    explains = c[0][1] ** 2 / signal
    rest = c[0][0] - explains
    if left_blur < c[0][0]:  # more than all there is cannot be noise: then none is known
        rest -= left_blur
    rest = max(rest, 1e-9 * c[0][0])
    rho = copysign(sqrt(explains / (explains + rest + unsure)), c[0][1])
    return Ratio(c[0][1] / signal, rho, min(max(1.0 - rest / whole, 0.0), 1.0))


def swept(c: list[list[float]]) -> None:
    """Take what the sides from the third on explain out of the products of the first two.

    ``c`` (k, k) products, changed in place: Gauss's elimination without a pivot that is nothing
    but rounding.  Plain floats: numpy takes ten times as long for so few.
    """
    own = [c[p][p] for p in range(len(c))]
    for p in range(len(c) - 1, 1, -1):
        pivot = c[p][p]
        if pivot <= COLLINEAR * own[p]:  # the other sides have explained it: rounding is left
            continue
        row = c[p]
        for i in range(p):
            if f := c[i][p] / pivot:
                line = c[i]
                for j in range(p):
                    line[j] -= f * row[j]


MOST = 12.0  # log units that one relation can say
# Honest spread of each ratio, as a relative standard deviation: configured numbers and the
# physics of the catalogue at its usual size.
SPREAD = {"mass": 0.15, "damping": 0.7, "guessed": 2.0, "flow": 0.10, "drive": 0.10, "fed": 0.3,
          "tracking": 0.05, "stroke": 0.15, "speed": 0.05, "size": 0.7, "both_forces": 0.2,
          "stiffness": 0.3, "charge": 0.7}
# Log units against a recording whose sample time is a power of ten away from the one that
# somebody wrote.
OTHER_CLOCK = 6.0
OIL = (5e6, 5e9)  # Pa: no oil is stiffer, and none softer that still moves a piston
NOTHING = 300.0  # times the mass, which no two mistakes make of one
FORWARD = 0.1  # of what a gain leaves of the speed, that a feed-forward beside it leaves
SLIGHT = 0.02  # of the motion: a lag below this may be a feed-forward's lead
# A relation whose left side is explained but for a share u counts FIT ln u: as many independent
# samples as a motion has corners, not as many as the recording has.
FIT = 1.5
FITS = 3e-3  # share that may stay unexplained for free
# What moving things of a rig measure, SI: from, to.  Outside it takes a reason.
SIZES = {"x": (1e-4, 5.0), "x_d": (1e-4, 5.0), "omega": (1.0, 3000.0), "v": (1e-4, 20.0),
         "p1": (3e4, 1e8), "p2": (3e4, 1e8)}
TURNED = {"x": (1e-3, 1e5), "x_d": (1e-3, 1e5), "v": (1e-3, 1e4)}  # a rotary rig, rad


@dataclass(frozen=True)
class Phrase:
    """A figure in a sentence, and alone."""

    text: str
    short: str


@dataclass(frozen=True)
class Check:
    """One relation under one reading."""

    name: str  # of the relation
    penalty: float  # log units that it costs to believe the reading, for its sign and size
    size: Phrase  # what the relation shows, in words
    sign: Phrase | None = None  # the same where its sign is the news; None without one
    reversed: bool = False  # the sign is wrong
    ratio: float | None = None  # what should be 1, where the relation has such a thing
    # log units for what it leaves unexplained; it distinguishes readings, and says little by
    # itself; None where another check of the same relation has it
    fit: float | None = None
    silent: bool = False  # what it shows is something else's: it says nothing of the reading

    def phrase(self, by_sign: bool) -> Phrase:
        """Return the words on the sign, or on the size."""
        return self.sign if by_sign and self.sign is not None else self.size


def odd(ln_ratio: float, spread: float, rho: float = 1.0) -> float:
    """Return the penalty of a ratio away from 1, of ``spread`` as honest standard deviation.

    ``rho`` is the correlation that it rests on.  Where all that is unexplained were coherent with
    the regressor, the slope would be off by sqrt(1/rho^2 - 1); half of that is taken.
    """
    unsure = 0.5 * sqrt(max(1.0 / max(rho * rho, 1e-12) - 1.0, 0.0))
    z = ln_ratio / sqrt(spread**2 + unsure**2)
    return min(2.0 * log(1.0 + z * z / 3.0), MOST)


def backwards(rho: float) -> float:
    """Return the penalty of a correlation that should be positive."""
    if rho >= 0:
        return 0.0
    return min(2.0 * rho * rho / max(1.0 - rho * rho, 1e-6), MOST)


def cost(slope: float, rho: float, spread: float) -> float:
    """Return the penalty of a slope that should be 1: its sign and its size."""
    size = odd(log(abs(slope)) if slope else -inf, spread, rho)
    return min(size + backwards(rho), MOST)


def unexplained(share: float) -> float:
    """Return what a relation of which only ``share`` is explained costs, log units."""
    return FIT * log(max(1.0 - share, FITS) / FITS)


def checks(reading: Reading) -> Iterator[Check]:
    """Yield every relation that the reading's channels and numbers allow."""
    for relation in RELATIONS:
        found = relation(reading)
        yield from [found] if isinstance(found, Check) else found or ()


def driving_force(reading: Reading) -> np.ndarray | None:
    """Return A1 p1 - A2 p2, or the measured force, as weights of the columns."""
    one, two = reading.rig["area_1"], reading.rig["area_2"]
    if reading.has("p1", "p2") and one and two:
        return reading.column("p1", 0, one) - reading.column("p2", 0, two)
    return reading.column("force") if reading.has("force") else None


def force_balance(reading: Reading) -> Iterator[Check]:
    """M x'' = A1 p1 - A2 p2 - B x' - F_c sgn x' - k x: the inertia, and what friction takes."""
    force = driving_force(reading) if reading.has("x") else None
    if force is None:
        return
    name = "pressure force" if reading.has("p1", "p2") else "force"
    x, v, a = (reading.column("x", order) for order in range(3))
    if inertia := ratio(reading, force, a, v, x, reading.column("x", DIRECTION)):
        mass = reading.rig["mass"]
        unit = "kg·m²" if reading.rotary else "kg"
        # Friction and oil that the motion does not explain draw a slope of their own: one that is
        # too large, and explains less than they leave, is no mass; nor is one that is hundreds of
        # times too large, and backwards, in a stroke that hardly accelerates.
        silent = inertia.slope < -NOTHING * mass
        theirs = (inertia.slope > mass and inertia.rho**2 < 0.5) or silent
        penalty = 0.0 if theirs else cost(inertia.slope / mass, inertia.rho, SPREAD["mass"])
        yield Check("inertia", penalty, Phrase(
            f"{name} over acceleration is a mass of {figure(inertia.slope)} {unit} where the "
            f"config says {figure(mass)}", f"{figure(inertia.slope)} {unit}"), Phrase(
            f"{name} and acceleration have correlation {inertia.rho:.2f}",
            f"{inertia.rho:+.2f}"), inertia.rho < 0, inertia.slope / mass, silent=silent)
    if friction := ratio(reading, force, v, a, x):
        nominal = reading.rig["viscous_damping"] or friction.slope
        guessed = "damping" if "viscous_damping" in reading.said else "guessed"
        penalty = cost(friction.slope / nominal if nominal else 1.0, friction.rho, SPREAD[guessed])
        yield Check("friction", penalty, Phrase(
            f"{name} over velocity is a damping of {figure(friction.slope)} where the config says "
            f"{figure(nominal)}", f"{figure(friction.slope)}"), Phrase(
            f"{name} and velocity have correlation {friction.rho:.2f}",
            f"{friction.rho:+.2f}"), friction.rho < 0)
    if explained := inertia or friction:
        yield Check("force", 0.0, Phrase(
            f"the motion explains {100 * explained.share:.0f} % of the {name}",
            f"{100 * explained.share:.0f} %"), fit=unexplained(explained.share))


def figure(value: float) -> str:
    """Return a number to three figures, without an exponent where it has few digits."""
    return f"{float(f'{value:.3g}'):g}" if 1e-4 <= abs(value) < 1e6 else f"{value:.3g}"


def times(value: float) -> str:
    """Return a ratio in words."""
    return f"{value:.2f} times" if 0.1 <= abs(value) < 100 else f"{figure(value)} times"


def slope_check(name: str, found: Ratio | None, what: str, of: str, spread: float | None = None
                ) -> Check | None:
    """Return the check of a slope that should be 1, e.g. ``what`` is 0.98 times ``of``; or None.

    Its logarithm scatters by ``spread``, without it by what ``SPREAD`` has for the name.
    """
    return found and Check(name, cost(found.slope, found.rho, spread or SPREAD[name]),
                 Phrase(f"{what} is {times(found.slope)} {of}", f"{times(found.slope)}"),
                 Phrase(f"{what} and {of} have correlation {found.rho:.2f}",
                        f"{found.rho:+.2f}"), found.rho < 0, found.slope,
                 unexplained(found.share))


def speed_of(reading: Reading) -> tuple[np.ndarray, str] | None:
    """Return the pump's speed, measured or as the drive wants it, and what to call it."""
    if reading.has("omega"):
        return reading.column("omega"), "the pump's flow"
    gain = reading.rig["position_gain"]
    if gain and reading.has("x", "x_d"):
        return (reading.column("x_d", 0, gain) - reading.column("x", 0, gain),
                "the flow that the drive demands")
    return None


def flow_balance(reading: Reading) -> Check | None:
    """D_p omega = A1 x' + what leaks and is compressed, which follows the force."""
    speed, area = speed_of(reading), reading.rig["area_1"]
    displacement = reading.rig["pump_displacement"]
    if speed is None or not area or not displacement or not reading.has("x"):
        return None
    found = ratio(reading, displacement * speed[0], reading.column("x", 1, area),
                  reading.column("x", 2))
    return slope_check("flow", found, speed[1], "the piston's flow A·v")


def drive(reading: Reading) -> Check | None:
    """Drive: omega = K_pos (x_d - x), behind a lag."""
    gain = reading.rig["position_gain"]
    if not gain or not reading.has("omega", "x", "x_d"):
        return None
    error = reading.column("x_d", 0, gain) - reading.column("x", 0, gain)
    speed, lag = reading.column("omega"), reading.column("omega", 1)
    found = ratio(reading, speed, error, lag)
    # Most controllers feed the demand's own rate forward, and the error is then a small rest.
    led = ratio(reading, speed, error, lag, reading.column("x_d", 1))
    if found and led and 1.0 - led.share < FORWARD * (1.0 - found.share):
        return slope_check("drive", led, "the pump's speed beside a feed-forward",
                           "K_pos (x_d - x)", SPREAD["fed"])
    return slope_check("drive", found, "the pump's speed", "K_pos (x_d - x)")


def tracking(reading: Reading) -> Iterator[Check]:
    """x_d = x + lag * v: the piston follows its command, later, at the same scale."""
    if not reading.has("x", "x_d"):
        return
    x, v, a = (reading.column("x", order) for order in range(3))
    demanded = reading.column("x_d")
    if follows := slope_check("tracking", ratio(reading, demanded, x, v, a), "x_d", "x"):
        yield follows
    behind = ratio(reading, demanded, v, x, a)
    if behind is not None and behind.share > 0.5:
        # A lag that is a small part of the motion may well be a feed-forward's.
        part = abs(behind.slope) * sqrt(v @ reading.moments.gram @ v) / max(
            sqrt(x @ reading.moments.gram @ x), 1e-300)
        penalty = backwards(behind.rho) * min(part / SLIGHT, 1.0)
        yield Check("lag", penalty, Phrase(
            f"x is ahead of x_d by {figure(-1e3 * behind.slope)} ms",
            f"{figure(1e3 * behind.slope)} ms behind"))


def stiffness(reading: Reading) -> Check | None:
    """F' = beta_e S2 (D_p omega/A1 - x') - leakage, S2 = A1²/V1 + A2²/V2: an oil's stiffness."""
    one, two, oil_1, oil_2, displacement = (reading.rig[key] for key in (
        "area_1", "area_2", "volume_1", "volume_2", "pump_displacement"))
    if not (one and two and oil_1 and oil_2 and displacement
            and reading.has("x", "omega", "p1", "p2")):
        return None
    stiff = one**2 / oil_1 + two**2 / oil_2
    given = stiff * (reading.column("omega", 0, displacement / one) - reading.column("x", 1))
    found = ratio(reading, given,
                  reading.column("p1", 1, one) - reading.column("p2", 1, two),
                  reading.column("p1", 0, one) - reading.column("p2", 0, two),
                  reading.column("x", 1))
    if found is None or found.slope <= 0:
        return None
    modulus = 1.0 / found.slope
    off = max(log(modulus / OIL[1]), log(OIL[0] / modulus), 0.0)
    return Check("stiffness", odd(off, SPREAD["stiffness"], found.rho), Phrase(
        f"the oil would have a bulk modulus of {figure(modulus / 1e6)} MPa",
        f"{figure(modulus / 1e6)} MPa"))


def stroke(reading: Reading) -> Check | None:
    """The oil that the piston sweeps is less than what both chambers hold."""
    one, two, oil_1, oil_2 = (reading.rig[key] for key in (
        "area_1", "area_2", "volume_1", "volume_2"))
    source = reading.roles.get("x")
    if source is None or source.channel not in reading.moments.levels or None in (
            one, two, oil_1, oil_2):
        return None
    swept = 0.5 * (one + two) * abs(source.factor) * reading.moments.levels[source.channel].span
    share = swept / (oil_1 + oil_2)
    penalty = odd(log(share), SPREAD["stroke"]) if share > 1 else 0.0
    return Check("stroke", penalty, Phrase(f"the piston sweeps {times(share)} the oil that "
                                           "both chambers hold", f"{times(share)}"))


def charge(reading: Reading) -> Check | None:
    """The emptier chamber comes down to the pressure of what feeds it, more or less."""
    if "charge_pressure" not in reading.said or not reading.has("p1", "p2"):
        return None
    sources = [reading.roles[role] for role in ("p1", "p2")]
    lowest = min(one.factor * reading.moments.levels[one.channel].low + one.offset
                 for one in sources)
    fed = reading.rig["charge_pressure"]
    if not fed or lowest <= 0.0:  # read above the ambient pressure
        return None
    return Check("charge", odd(log(lowest / fed), SPREAD["charge"]), Phrase(
        f"the lower pressure comes down to {figure(1e-6 * lowest)} MPa where the config has a "
        f"charge pressure of {figure(1e-6 * fed)} MPa", f"{figure(1e-6 * lowest)} MPa"))


def measured_speed(reading: Reading) -> Check | None:
    """The velocity channel is the position's derivative."""
    if not reading.has("x", "v"):
        return None
    return slope_check("speed", ratio(reading, reading.column("v"), reading.column("x", 1)), "v",
                       "the position's derivative")


def both_forces(reading: Reading) -> Check | None:
    """A measured force is the pressure force less friction."""
    one, two = reading.rig["area_1"], reading.rig["area_2"]
    if not (one and two and reading.has("force", "p1", "p2")):
        return None
    found = ratio(reading, reading.column("p1", 0, one) - reading.column("p2", 0, two),
                  reading.column("force"))
    return slope_check("both_forces", found, "the pressure force", "the measured one")


def sizes(reading: Reading) -> Iterator[Check]:
    """Ranges in which the signals of a moving rig lie."""
    for role, source in reading.roles.items():
        span = (TURNED if reading.rotary else {}).get(role, SIZES.get(role))
        if span is None or not reading.has(role):
            continue
        level = reading.moments.levels[source.channel]
        size = abs(source.factor) * (level.span if role in ("x", "x_d") else
                                     max(abs(level.high), abs(level.low)))
        off = log(span[0] / size) if size < span[0] else log(size / span[1])
        if size > 0 and off > 0:
            kind = "moves over" if role in ("x", "x_d") else "reaches"
            unit = CHANNEL_UNITS[role]
            shown = f"{figure(size)} {ROTARY.get(unit, unit) if reading.rotary else unit}"
            only = " only" if size < span[0] else ""
            yield Check(f"size of {role}", odd(off, SPREAD["size"]),
                        Phrase(f"{role} {kind} {shown}{only}", shown))


def clock(reading: Reading) -> Check | None:
    """The stamps are as far apart as the config says."""
    step, said = reading.moments.sample_time * reading.clock, reading.rig["sample_time"]
    tens = log10(step / said)
    if "sample_time" not in reading.said or abs(tens) < 0.5 or abs(tens - round(tens)) > 0.02:
        return None
    return Check("clock", OTHER_CLOCK, Phrase(
        f"the samples are {figure(1e3 * step)} ms apart where the config says "
        f"{figure(1e3 * said)} ms", f"{figure(1e3 * step)} ms"))


RELATIONS: tuple[Callable[[Reading], Check | Iterator[Check] | None], ...] = (
    force_balance, flow_balance, drive, tracking, stiffness, stroke, charge, measured_speed,
    both_forces, sizes, clock)
