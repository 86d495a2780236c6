"""Which mistakes a recording and its config show: the smallest set that mends what is broken.

Mistakes are those that people make in a channel map or a config, each as a change of the reading.
Every set is scored alike: what its reading costs (:mod:`relations`) less what it costs to believe
that somebody made these mistakes.  No mistake at all is one of the sets.

``PRIOR`` of each is how much rarer it is than no mistake at all, in log units.  A mistake that
changes one map line that everybody writes (a unit, a swap) is everyday; a number of the rig that
is off by a power of ten is rarer; one that only an odd rig would explain is rarest.
"""

from dataclasses import dataclass, field, replace
from itertools import combinations
from math import log, log10, pi
from typing import Any

from eha_monitor import ties
from eha_monitor.plausibility.moments import Moments, moments_of
from eha_monitor.plausibility.relations import Check, Reading, Source, checks, unexplained
from eha_monitor.recordings.recording import ChannelFinding, Kind, Recording
from eha_monitor.settings.channels import ATMOSPHERE, unit_of
from eha_monitor.settings.load import merge, settings_from_tree
from eha_monitor.settings.monitor import Settings

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
TENS = (10.0, 100.0, 1000.0, 1e4, 1e5, 1e6)
# Numbers of the rig: keys that go together, name, and what people mix up besides powers of ten.
MISTAKEN = (
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
    """One mistake; applied to a reading it gives the reading that was meant.

    Attributes
    ----------
    kind : of the finding.
    names : channels or keys of the rig.
    claim : what it looks like, the beginning of the finding's sentence.
    prior : log probability against none.
    swap : two roles whose channels are exchanged.
    factors : role -> meant value over the value as given.
    numbers : key of the rig -> meant value over the value as given.
    clock : true seconds for one recorded second.
    without : role whose channel is something else.
    """

    kind: Kind
    names: tuple[str, ...]
    claim: str
    prior: float
    swap: tuple[str, str] | None = None
    factors: dict[str, float] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    clock: float = 1.0
    without: str = ""

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


def unit_mistakes(roles: tuple[str, ...], units: dict[str, float], si: str) -> list[Mistake]:
    """Return what there is to mix up in the unit of channels that share one.

    Any unit may have been taken for any other, most often the first for the SI unit; a power of
    ten without a name is rarest.
    """
    names = " and ".join(roles)
    looks = "look" if len(roles) > 1 else "looks"
    found: dict[float, Mistake] = {}

    def add(factor: float, claim: str, prior: float) -> None:
        key = round(log(factor), 3)
        if key and key not in found:
            found[key] = Mistake("unit", roles, f"{names} {looks} {claim}", prior,
                                 factors=dict.fromkeys(roles, factor))

    for place, (unit, factor) in enumerate(units.items()):
        add(factor, f"like {unit}, not {si}", RARE if place else EVERYDAY)
    for unit, factor in units.items():
        add(1.0 / factor, f"like {si}, scaled as {unit}", RARE)
    for unit, factor in units.items():
        for taken, other in units.items():
            add(factor / other, f"like {unit}, scaled as {taken}", RAREST)
    for ten in TENS:
        for factor in (ten, 1.0 / ten):
            size = f"{1 / factor:g} times too large" if factor < 1 else (
                f"{factor:g} times too small")
            add(factor, f"{size} for {si}", RAREST + DECADE * log10(ten))
    return list(found.values())


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
    groups += [pair for pair in (("x", "x_d"), ("p1", "p2"), ("x", "v"))
               if set(pair) <= set(has)]
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
        found += unit_mistakes(group, units, si)
    found += [Mistake("swapped", (role,), f"{role} does not match this motion; it may be the "
                                          "wrong column or topic", OTHER_COLUMN, without=role)
              for role in has]
    found += number_mistakes(reading) + fitted_numbers(reading, given)
    found += [Mistake("unit", ("time",), f"the time looks like {unit}, not seconds", EVERYDAY,
                      clock=factor) for unit, factor in TIMES.items()]
    found += [Mistake("unit", ("time",), f"the time is {1 / factor:g} times too long"
                      if factor < 1 else f"the time is {factor:g} times too short", RARE,
                      clock=factor) for factor in (0.1, 10.0, 0.01, 100.0, 1000.0)]
    return found


def number_mistakes(reading: Reading) -> list[Mistake]:
    """Return what can be wrong by a power of ten, or in its unit, among the rig's numbers."""
    found = []
    for keys, name, others in MISTAKEN:
        if any(not reading.rig[key] for key in keys):
            continue
        looks = "look" if len(keys) > 1 else "looks"
        prior = RARE if len(keys) > 1 or f"{keys[0][:-1]}1" not in reading.rig else RAREST
        values = " and ".join(f"{reading.rig[key]:.3g}" for key in dict.fromkeys(keys))
        for factor in (one for ten in TENS for one in (ten, 1.0 / ten)):
            size = f"{factor:g} times too small" if factor > 1 else (
                f"{1 / factor:g} times too large")
            found.append(Mistake("unit", keys, f"{name} ({values} in the config) {looks} {size}",
                                 prior + DECADE * abs(log10(factor)),
                                 numbers=dict.fromkeys(keys, factor)))
        for words, factor in others.items():
            found.append(Mistake("unit", keys, f"{name} ({values} in the config) {looks} wrong: "
                                 f"{words}", prior + DECADE * abs(log10(factor)),
                                 numbers=dict.fromkeys(keys, factor)))
    return found


def fitted_numbers(reading: Reading, given: tuple[Check, ...]) -> list[Mistake]:
    """Return each number of the rig that is off by just what one relation shows."""
    ratios = {check.name: check.ratio for check in given if check.ratio is not None}
    found = []
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
        found.append(Mistake("unit", keys, f"{name} ({values} in the config) {verb} fit, the "
                             f"recording shows about {shown}", RAREST,
                             numbers=dict.fromkeys(keys, factor)))
    return found


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


ROLES = ("x", "v", "x_d", "omega", "p1", "p2", "force")
NUMBERS = ("area_1", "area_2", "volume_1", "volume_2", "mass", "viscous_damping",
           "pump_displacement", "position_gain", "sample_time")
DECIDES = 3.0  # log units by which mistakes must be better than none
RIVAL = 2.0  # log units within which another explanation is reported as well
BROKEN = 4.0  # log units of wrong signs and sizes from which on a reading is worth explaining
LOOSE = 6.0  # log units of unexplained signals from which on
MOST = 3  # mistakes at once
AGAIN = 0.5  # share of an everyday unit's cost that a further one saves
ALIKE = 0.25  # difference of logarithms within which two factors are reported as one
MENDS = 0.5  # log units that a mistake must mend
KEPT = 16  # sets that are carried on
BELOW_VACUUM = 0.5 * ATMOSPHERE  # below zero: nearer to a gauge's lowest than to an absolute one's
AS_GAUGE = 0.05  # of an atmosphere: so near must the charge pressure be to being one off


@dataclass(frozen=True)
class Explanation:
    """A set of mistakes: its score (log units, larger is better) and the checks of its reading."""

    mistakes: tuple[Mistake, ...]
    score: float
    checks: tuple[Check, ...]

    @property
    def broken(self) -> float:
        """Log units of signs and sizes that are wrong."""
        return sum(check.penalty for check in self.checks)

    @property
    def loose(self) -> float:
        """Log units of what the relations leave unexplained."""
        return sum(check.fit or 0.0 for check in self.checks)


@dataclass(frozen=True)
class Plausibility:
    """What the channels say about the config.

    Attributes
    ----------
    findings : most important first.
    blocking : no answer would be meaningful while they stand.
    """

    findings: tuple[ChannelFinding, ...] = ()
    blocking: bool = False

    @property
    def message(self) -> str:
        """All findings in one line."""
        return "; ".join(finding.finding for finding in self.findings)


def plausibility_of(recording: Recording, settings: Settings) -> Plausibility:
    """Ask whether a recording and its config can be of one rig.

    Parameters
    ----------
    recording : aligned channels as the config's channel map reads them.
    settings : rig and channel map.
    """
    moments = moments_of(recording)
    same = duplicates(moments)
    if same:
        return Plausibility(same, True)
    reading = reading_of(moments, settings)
    best, rivals = explain(reading)
    found = tuple(finding_of(mistake, best, rivals, reading, settings)
                  for mistake in best.mistakes)
    if found:
        return Plausibility(found, any(set(one.channels) != {"v"} for one in found))
    return Plausibility((*gauge(moments, settings), *stuck(moments), *unsigned(moments)), False)


def reading_of(moments: Moments, settings: Settings) -> Reading:
    """Return the recording and the rig as the config says they are."""
    rig = settings.rig
    return Reading(moments, {role: Source(role) for role in ROLES if role in moments.levels},
                   {key: getattr(rig, key) for key in NUMBERS}, frozenset(rig.model_fields_set),
                   rotary=rig.motion == "rotary")


def explained(reading: Reading, mistakes: tuple[Mistake, ...],
              expected: tuple[str, ...] = ()) -> Explanation:
    """Return what a set of mistakes makes of a reading.

    ``expected`` are relations that the reading as given has: one that is lost explains nothing.
    """
    for mistake in mistakes:
        reading = mistake.applied(reading)
    made = tuple(checks(reading))
    lost = len(set(expected) - {check.name for check in made}) * unexplained(0.0)
    return Explanation(mistakes, prior_of(mistakes) - lost - sum(
        check.penalty + (check.fit or 0.0) for check in made), made)


def prior_of(mistakes: tuple[Mistake, ...]) -> float:
    """Return the log probability of a set: who forgot one unit forgot others more easily."""
    costs = sorted(mistake.prior for mistake in mistakes)
    usual = sum(mistake.kind == "unit" and mistake.prior == EVERYDAY for mistake in mistakes)
    return sum(costs) - AGAIN * EVERYDAY * max(usual - 1, 0)


def explain(reading: Reading) -> tuple[Explanation, list[Explanation]]:
    """Return the best set of mistakes, and those that come close to it."""
    given = explained(reading, ())
    if given.broken < BROKEN and given.loose < LOOSE:
        return given, []
    expected = tuple(check.name for check in given.checks if check.fit is not None)
    catalogue = mistakes_for(reading, given.checks)
    scored = front = [given]
    for number in range(MOST):
        # A further mistake is looked for where one more sign or size is wrong.
        front = [one for one in front if not number or one.broken > BROKEN]
        further = {}
        for one in front:
            taken = frozenset().union(*(mistake.touches for mistake in one.mistakes))
            for mistake in catalogue:
                if not taken & mistake.touches:
                    key = frozenset(map(id, (*one.mistakes, mistake)))
                    if key not in further:
                        further[key] = explained(reading, (*one.mistakes, mistake), expected)
        if not further:
            break
        if not number:  # what mends nothing alone mends nothing beside another
            catalogue = [one.mistakes[0] for one in further.values()
                         if one.score - one.mistakes[0].prior > given.score + MENDS]
        front = ties.ordered(further.values(), lambda one: one.score, within=ties.GUESS)[:KEPT]
        scored = [*scored, *front]
    best = ties.best(scored, lambda one: one.score, lambda one: len(one.mistakes), ties.GUESS)
    if best.score < given.score + DECIDES:
        return given, []
    rivals = [one for one in ties.ordered(scored, lambda one: one.score, within=ties.GUESS)
              if one is not best and one is not given and one.score > best.score - RIVAL]
    return best, rivals


def finding_of(mistake: Mistake, best: Explanation, rivals: list[Explanation], reading: Reading,
               settings: Settings) -> ChannelFinding:
    """Return a mistake with the relation that shows it best, before and after it is mended."""
    others = tuple(one for one in best.mistakes if one is not mistake)
    without = {check.name: check for check in explained(reading, others).checks}
    mended = {check.name: check for check in best.checks}
    # Whole log units: of two that show it alike the first of the list is the plainer one.
    def gain(name: str) -> int:
        after = mended.get(name)
        return round(without[name].penalty + (without[name].fit or 0.0) - (
            after.penalty + (after.fit or 0.0) if after else 0.0))

    name = max(without, key=gain)
    before = without[name]
    by_sign = before.reversed
    how = "swapped" if mistake.kind == "swapped" else "corrected"
    after = f"; {how}, {mended[name].phrase(by_sign).short}" if name in mended else ""
    return ChannelFinding(
        f"{mistake.claim}: {before.phrase(by_sign).text}{after}{others_of(best, rivals)}",
        mistake.kind, mistake.names, correction_of(mistake, settings))


def others_of(best: Explanation, rivals: list[Explanation]) -> str:
    """Return the explanations that are nearly as good, as the end of a sentence."""
    claims = []
    for one in rivals:
        further = all(any(mine is mistake for mine in one.mistakes) for mistake in best.mistakes)
        vague = any(mistake.without for mistake in one.mistakes)
        if not (further or vague or mends_alike(one.mistakes, best.mistakes)):
            claims.append(" and ".join(mistake.claim for mistake in one.mistakes))
    return f" (or {', or '.join(claims[:2])})" if claims else ""


def mends_alike(ones: tuple[Mistake, ...], others: tuple[Mistake, ...]) -> bool:
    """Tell whether two sets change the same things by about the same factors."""
    def changes(mistakes: tuple[Mistake, ...]) -> dict[str, float]:
        found: dict[str, float] = {}
        for mistake in mistakes:
            for key, factor in (*mistake.factors.items(), *mistake.numbers.items(),
                                ("time", mistake.clock)):
                found[key] = found.get(key, 1.0) * factor
        return found

    one, other = changes(ones), changes(others)
    swaps = [{mistake.swap for mistake in mistakes} for mistakes in (ones, others)]
    return swaps[0] == swaps[1] and one.keys() == other.keys() and all(
        one[key] / other[key] > 0 and abs(log(one[key] / other[key])) < ALIKE for key in one)


def duplicates(moments: Moments) -> tuple[ChannelFinding, ...]:
    """Return the channels that hold the same numbers as another."""
    return tuple(ChannelFinding(
        f"{one} and {other} hold the same numbers: one of them is read from the other's column "
        "or topic", "swapped", (one, other)) for one, other in moments.same)


def gauge(moments: Moments, settings: Settings) -> tuple[ChannelFinding, ...]:
    """Return whether the pressures look like gauge pressures where absolute ones are expected."""
    levels = [moments.levels[name] for name in ("p1", "p2") if name in moments.levels]
    rig = settings.rig
    if len(levels) < 2 or not any(level.largest for level in levels) or any(
            unit_of(of[name].unit).zero for of in (settings.channels, settings.table.columns)
            for name in ("p1", "p2") if name in of):
        return ()
    lowest = min(level.low for level in levels)
    middle = 0.5 * (levels[0].middle + levels[1].middle)
    off = (rig.charge_pressure - middle) / ATMOSPHERE
    why = ""
    if lowest < -BELOW_VACUUM:
        why = f"the lowest is {lowest / 1e5:.2f} bar"
    elif rig.area_1 == rig.area_2 and abs(off - 1.0) < AS_GAUGE:
        why = (f"their mean is {middle / 1e5:.2f} bar, {off * ATMOSPHERE / 1e5:.2f} bar below "
               f"the charge pressure of {rig.charge_pressure / 1e5:.2f} bar")
    if not why:
        return ()
    channels = {name: {"offset": settings.channels[name].offset
                       + ATMOSPHERE / unit_of(settings.channels[name].unit).factor}
                for name in ("p1", "p2") if name in settings.channels}
    return (ChannelFinding(
        f"p1 and p2 look like gauge pressures, not absolute ones: {why}", "offset", ("p1", "p2"),
        {"channels": channels}),)


def stuck(moments: Moments) -> tuple[ChannelFinding, ...]:
    """Return the pressures that never change although the piston moves."""
    if ("x", 0) not in moments.place:
        return ()
    return tuple(ChannelFinding(
        f"{name} is {moments.levels[name].middle / 1e5:.4g} bar in the whole recording although "
        "the piston moves: its sensor or its cable may be dead", "hold", (name,))
        for name in ("p1", "p2") if name in moments.levels and not moments.levels[name].span)


FOLLOWS = 0.5  # correlation of pump speed and motion above which the speed has its sign


def unsigned(moments: Moments) -> tuple[ChannelFinding, ...]:
    """Return whether the pump's speed is told without its sign, as many drives do."""
    level, place = moments.levels.get("omega"), moments.place
    if level is None or ("omega", 0) not in place or ("x", 1) not in place or level.low < 0:
        return ()
    if abs(moments.gram[place["omega", 0], place["x", 1]]) > FOLLOWS:
        return ()
    return (ChannelFinding(
        "omega is never negative and does not follow the motion: its sign may be missing (a drive "
        "that records the size of its speed), or a valve turns the flow round", "sign",
        ("omega",)),)


# ---- what mends a mistake -----------------------------------------------------------------------

FIGURES = 12  # digits: a scale of 0.001 is written as that


def correction_of(mistake: Mistake, settings: Settings) -> dict[str, Any]:
    """Return the sections and keys that mend a mistake, with their new values.

    A channel is mended where the bag is read (``channels``), not where a table was imported
    (``table``): the bag at hand keeps its numbers.  The time is the exception, since a bag's
    stamps are its own; it is mended in ``table.time_scale`` and takes another import.
    """
    if mistake.swap is not None:
        one, other = mistake.swap
        if not {one, other} <= set(settings.channels):
            return {}
        return {"channels": {one: settings.channels[other].model_dump(),
                             other: settings.channels[one].model_dump()}}
    if mistake.clock != 1.0:
        return {"table": {"time_scale": rounded(settings.table.time_scale * mistake.clock)}} \
            if settings.table.columns else {}
    found: dict[str, Any] = {}
    for role, factor in mistake.factors.items():
        channel = settings.channels.get(role)
        if channel is not None:
            found.setdefault("channels", {})[role] = {
                **({"unit": ""} if channel.unit else {}),
                "scale": rounded(channel.gain * factor),
                "offset": rounded(channel.zero * factor)}
    for key, factor in mistake.numbers.items():
        found.setdefault("rig", {})[key] = rounded(getattr(settings.rig, key) * factor)
    return found


def rounded(value: float) -> float:
    """Return a number without the digits that a product of floats adds."""
    return float(f"{value:.{FIGURES}g}")


def corrected(settings: Settings, findings: tuple[ChannelFinding, ...]) -> Settings:
    """Return the settings with what the findings correct.

    Raises
    ------
    InputError
        If a corrected value is out of the range of its key.
    """
    tree = settings.model_dump()
    for finding in findings:
        merge(tree, finding.correction)
    return settings_from_tree(tree, "correction")
