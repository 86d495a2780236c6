"""The mistakes that people make in a channel map or a config, each as a change of the reading.

``PRIOR`` of each is how much rarer it is than no mistake at all, in log units.  A mistake that
changes one map line that everybody writes (a unit, a swap) is everyday; a number of the rig that
is off by a power of ten is rarer; one that only an odd rig would explain is rarest.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from math import log, log10, pi

from eha_monitor.plausibility.relations import Check, Reading, Source
from eha_monitor.recordings.recording import Kind

EVERYDAY, RARE, RAREST = -3.0, -4.5, -6.0
DECADE = -0.3  # log units for each power of ten that a number is off
OTHER_COLUMN = -7.0  # a channel that is none of the others either
TOLD = 3.0  # times: a number that is off by less is left to the estimators
INCH, PSI = 0.0254, 6894.757
RPM = 2.0 * pi / 60.0
# Unit that was taken for the SI unit -> SI units in it; the usual one first.
LENGTHS = {"millimetres": 1e-3, "centimetres": 1e-2, "micrometres": 1e-6, "inches": INCH}
ANGLES = {"degrees": pi / 180.0, "revolutions": 2.0 * pi, "milliradians": 1e-3}
PRESSURES = {"bar": 1e5, "kPa": 1e3, "MPa": 1e6, "psi": PSI, "hPa": 1e2}
SPEEDS = {"rpm": RPM, "revolutions a second": 2.0 * pi, "degrees a second": pi / 180.0,
          "1000 rpm": 1000.0 * RPM}
FORCES = {"kN": 1e3, "kgf": 9.80665, "daN": 10.0, "mN": 1e-3}
TORQUES = {"kN·m": 1e3, "mN·m": 1e-3, "N·cm": 1e-2}
VELOCITIES = {"mm/s": 1e-3, "cm/s": 1e-2, "m/min": 1.0 / 60.0}
TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6}
TENS = tuple(factor for ten in (10.0, 100.0, 1000.0, 1e4, 1e5, 1e6) for factor in (ten, 1.0 / ten))
# Numbers of the rig: keys that go together, name, and what people mix up besides powers of ten.
NUMBERS = (
    (("mass",), "mass", {}),
    (("area_1", "area_2"), "the areas", {"the diameter's square for the area": pi / 4.0}),
    (("area_1",), "area_1", {}), (("area_2",), "area_2", {}),
    (("pump_displacement",), "pump_displacement", {
        "m³ a revolution for m³/rad": 1.0 / (2.0 * pi), "m³/rad twice divided by 2π": 2.0 * pi}),
    (("volume_1", "volume_2"), "the volumes", {}),
    (("position_gain",), "position_gain", {"a gain in rpm": RPM}),
)
# Keys, name, the relation that shows them, and the power of its ratio that mends them.
FITTED = ((("mass",), "mass", "inertia", 1.0), (("area_1", "area_2"), "the areas", "flow", 1.0),
          (("pump_displacement",), "pump_displacement", "flow", -1.0),
          (("position_gain",), "position_gain", "drive", 1.0))


@dataclass(frozen=True)
class Mistake:
    """One mistake; applied to a reading it gives the reading that was meant."""

    kind: Kind  # of the finding
    names: tuple[str, ...]  # channels or keys of the rig
    claim: str  # what it looks like, the beginning of the finding's sentence
    prior: float  # log probability against none
    swap: tuple[str, str] | None = None  # two roles whose channels are exchanged
    # role, and key of the rig -> meant value over the value as given
    factors: dict[str, float] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    clock: float = 1.0  # true seconds for one recorded second
    without: str = ""  # role whose channel is something else

    def applied(self, reading: Reading) -> Reading:
        """Return the reading without this mistake."""
        roles = dict(reading.roles)
        if self.swap is not None:
            one, other = self.swap
            roles[one], roles[other] = roles[other], roles[one]
        for role, factor in self.factors.items():
            source = roles[role]
            roles[role] = Source(source.channel, source.factor * factor)
        roles.pop(self.without, None)
        rig = {key: value * self.numbers[key] if key in self.numbers and value else value
               for key, value in reading.rig.items()}
        return replace(reading, roles=roles, rig=rig, clock=reading.clock * self.clock)

    @property
    def touches(self) -> frozenset[str]:
        """What no second mistake of a set may touch."""
        return frozenset((*self.names, *(self.swap or ()), *(("time",) * (self.clock != 1.0))))


def unit_mistakes(roles: tuple[str, ...], units: dict[str, float], si: str,
                  written: float = 0.0) -> list[Mistake]:
    """Return what there is to mix up in the unit of channels that share one.

    Any unit may have been taken for any other, most often the first for the SI unit; a power of
    ten without a name is rarest.  ``written`` is the unit that the config gives, in SI: no other
    was taken for the right one.
    """
    names = " and ".join(roles)
    looks = "look" if len(roles) > 1 else "looks"
    found: dict[float, Mistake] = {}

    def add(factor: float, claim: str, prior: float) -> None:
        key = round(log(factor), 3)
        if key and key not in found:
            found[key] = Mistake("unit", roles, f"{names} {looks} {claim}", prior,
                                 factors=dict.fromkeys(roles, factor))

    said = [unit for unit, factor in units.items() if abs(log(written / factor)) < 1e-3
            ] if written > 0 else []
    for taken in said:
        for place, (unit, factor) in enumerate({si: 1.0, **units}.items()):
            add(factor / units[taken], f"like {unit}, not {taken}",
                RARE if place > 2 else EVERYDAY)
    free = {} if said else units
    for place, (unit, factor) in enumerate(free.items()):
        add(factor, f"like {unit}, not {si}", RARE if place else EVERYDAY)
    for unit, factor in free.items():
        add(1.0 / factor, f"like {si}, scaled as {unit}", RARE)
    for (unit, factor), (taken, other) in product(free.items(), repeat=2):
        add(factor / other, f"like {unit}, scaled as {taken}", RAREST)
    for factor in TENS:
        add(factor, f"{wrong_size(factor)} for {si}", RAREST + DECADE * abs(log10(factor)))
    return list(found.values())


def wrong_size(factor: float) -> str:
    """Return what a number is that times ``factor`` is the meant one."""
    return (f"{1 / factor:g} times too large" if factor < 1 else f"{factor:g} times too small")


def mistakes_for(reading: Reading, given: tuple[Check, ...]) -> list[Mistake]:
    """Return every mistake that the channels and numbers of a reading can have.

    ``given`` are the checks of the reading as it is: a number of the rig may be off by just what
    they show.
    """
    has = [role for role in ("x", "x_d", "omega", "v", "p1", "p2", "force") if role in
           reading.roles]
    found = []
    for pair in combinations([role for role in has if role != "v"], 2):
        usual = pair in (("p1", "p2"), ("x", "x_d"))
        found.append(Mistake("swapped", pair, f"{pair[0]} and {pair[1]} look swapped",
                             EVERYDAY if usual else RAREST, swap=pair))
    groups = [(role,) for role in has]
    groups += [pair for pair in (("x", "x_d"), ("p1", "p2"), ("x", "v")) if set(pair) <= set(has)]
    if {"x", "x_d", "v"} <= set(has):
        groups.append(("x", "x_d", "v"))
    for group in groups:
        if group[0][0] != "p":
            names, verb = " and ".join(group), "have" if len(group) > 1 else "has"
            found.append(Mistake("sign", group, f"{names} {verb} the wrong sign",
                                 EVERYDAY if len(group) == 1 else RARE,
                                 factors=dict.fromkeys(group, -1.0)))
        units, si = units_of(group[0], reading.rotary)
        if group == ("x", "v"):
            units = {}
        found += unit_mistakes(group, units, si, reading.units.get(group[0], 0.0))
    found += [Mistake("swapped", (role,), f"{role} does not match this motion; it may be the "
                                          "wrong column or topic", OTHER_COLUMN, without=role)
              for role in has]
    found += [*number_mistakes(reading), *fitted_numbers(reading, given)]
    found += [Mistake("unit", ("time",), f"the time looks like {unit}, not seconds", EVERYDAY,
                      clock=factor) for unit, factor in TIMES.items()]
    found += [Mistake("unit", ("time",), f"the time is {1 / factor:g} times too long"
                      if factor < 1 else f"the time is {factor:g} times too short", RARE,
                      clock=factor) for factor in (0.1, 10.0, 0.01, 100.0, 1000.0)]
    return found


def number_mistakes(reading: Reading) -> Iterator[Mistake]:
    """Yield what can be wrong by a power of ten, or in its unit, among the rig's numbers."""
    for keys, name, others in NUMBERS:
        if any(not reading.rig[key] for key in keys):
            continue
        looks = "look" if len(keys) > 1 else "looks"
        prior = RARE if len(keys) > 1 or f"{keys[0][:-1]}1" not in reading.rig else RAREST
        values = " and ".join(f"{reading.rig[key]:.3g}" for key in dict.fromkeys(keys))
        for factor, words in (*((factor, wrong_size(factor)) for factor in TENS),
                              *((factor, f"wrong: {words}") for words, factor in others.items())):
            yield Mistake("unit", keys, f"{name} ({values} in the config) {looks} {words}",
                          prior + DECADE * abs(log10(factor)), numbers=dict.fromkeys(keys, factor))


def fitted_numbers(reading: Reading, given: tuple[Check, ...]) -> Iterator[Mistake]:
    """Yield each number of the rig that is off by just what one relation shows."""
    ratios = {check.name: check.ratio for check in given if check.ratio is not None}
    for keys, name, relation, power in FITTED:
        off = ratios.get(relation, 0.0)
        if off <= 0 or any(not reading.rig[key] for key in keys):
            continue
        factor = off**power
        if abs(log(factor)) < log(TOLD):
            continue
        values = " and ".join(f"{reading.rig[key]:.3g}" for key in keys)
        shown = " and ".join(f"{factor * reading.rig[key]:.3g}" for key in keys)
        verb = "do not" if len(keys) > 1 else "does not"
        yield Mistake("unit", keys, f"{name} ({values} in the config) {verb} fit, the recording "
                      f"shows about {shown}", RAREST, numbers=dict.fromkeys(keys, factor))


def units_of(role: str, rotary: bool) -> tuple[dict[str, float], str]:
    """Return the units that a channel may come in, and the SI unit that was expected."""
    if role in ("x", "x_d"):
        return (ANGLES, "radians") if rotary else (LENGTHS, "metres")
    if role in ("p1", "p2"):
        return PRESSURES, "Pa"
    if role == "omega":
        return SPEEDS, "rad/s"
    if role == "force":
        return (TORQUES, "N·m") if rotary else (FORCES, "N")
    return ({}, "rad/s") if rotary else (VELOCITIES, "m/s")
