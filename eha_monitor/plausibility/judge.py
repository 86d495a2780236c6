"""Which mistakes a recording and its config show: the smallest set that mends what is broken.

Every set is scored alike: what its reading costs (:mod:`relations`) less what it costs to believe
that somebody made these mistakes (:mod:`mistakes`).  No mistake at all is one of the sets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Any

from eha_monitor import ties
from eha_monitor.plausibility.held import held
from eha_monitor.plausibility.mistakes import EVERYDAY, Mistake, mistakes_for
from eha_monitor.plausibility.moments import Moments, moments_of
from eha_monitor.plausibility.relations import Check, Reading, Source, checks, unexplained
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.channels import ATMOSPHERE, CHANNEL_UNITS, unit_of
from eha_monitor.settings.load import merge, settings_from_tree
from eha_monitor.settings.monitor import Settings

ROLES = ("x", "v", "x_d", "omega", "p1", "p2", "force")
NUMBERS = ("area_1", "area_2", "volume_1", "volume_2", "mass", "viscous_damping",
           "pump_displacement", "position_gain", "charge_pressure", "sample_time")
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
    """What the channels say about the config."""

    findings: tuple[ChannelFinding, ...] = ()  # most important first
    blocking: bool = False  # no answer would be meaningful while they stand

    @property
    def message(self) -> str:
        """All findings in one line."""
        return "; ".join(finding.finding for finding in self.findings)


def plausibility_of(recording: Recording, settings: Settings) -> Plausibility:
    """Ask whether a recording, as the config's channel map reads it, and its rig are of one."""
    moments = moments_of(recording)
    if same := duplicates(moments):
        return Plausibility(same, True)
    reading = reading_of(moments, settings)
    best, rivals = explain(reading)
    found = tuple(finding_of(mistake, best, rivals, reading, settings)
                  for mistake in best.mistakes)
    if found:
        return Plausibility(found, any(set(one.channels) != {"v"} for one in found))
    return Plausibility((*gauge(moments, settings), *stuck(moments), *unsigned(moments),
                         *held(recording)), False)


def reading_of(moments: Moments, settings: Settings) -> Reading:
    """Return the recording and the rig as the config says they are."""
    rig = settings.rig
    return Reading(moments, {role: Source(role) for role in ROLES if role in moments.levels},
                   {key: getattr(rig, key) for key in NUMBERS}, frozenset(rig.model_fields_set),
                   rotary=rig.motion == "rotary", units=units_in(settings))


def units_in(settings: Settings) -> dict[str, float]:
    """Return role -> unit that the config gives a channel, SI.

    One with a scale is left out: what it was multiplied by may be of another unit.
    """
    sources = {**settings.table.columns, **{
        role: one for role, one in settings.channels.items() if one.unit}}
    return {role: unit_of(one.unit).factor for role, one in sources.items()
            if one.unit and one.scale == 1.0}


def explained(reading: Reading, mistakes: tuple[Mistake, ...],
              given: Sequence[Check] = ()) -> Explanation:
    """Return what a set of mistakes makes of a reading.

    ``given`` are the relations of the reading as it came: one that is lost, or says nothing any
    more, explains nothing.
    """
    for mistake in mistakes:
        reading = mistake.applied(reading)
    made = tuple(checks(reading))
    expected = {check.name for check in given if check.fit is not None}
    lost = len(expected - {check.name for check in made}) * unexplained(0.0)
    said = {check.name: check.penalty for check in given if not check.silent}
    made = tuple(replace(check, penalty=said[check.name])
                 if check.silent and check.name in said else check for check in made)
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
                        further[key] = explained(
                            reading, (*one.mistakes, mistake), given.checks)
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
        f"{one} and {other} hold the same numbers"
        f"{'' if CHANNEL_UNITS[one] == CHANNEL_UNITS[other] else ' in other units'}: one of them "
        "is read from the other's column or topic", "swapped", (one, other))
        for one, other in moments.same)


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
        if rig.tolerance.log_spread("charge_pressure") * rig.charge_pressure > ATMOSPHERE:
            why += ("; or they are absolute and so much lower is the charge pressure, within its "
                    "tolerance")
    if not why:
        return ()
    channels = {name: {"offset": settings.channels[name].offset
                       + ATMOSPHERE / unit_of(settings.channels[name].unit).factor}
                for name in ("p1", "p2") if name in settings.channels}
    return (ChannelFinding(
        f"p1 and p2 look like gauge pressures, not absolute ones: {why}", "offset", ("p1", "p2"),
        {"channels": channels}),)


def stuck(moments: Moments) -> tuple[ChannelFinding, ...]:
    """Return the pressures that never change, and a pump that stands, although the piston moves.

    A pump of constant speed is one behind a valve.
    """
    if ("x", 0) not in moments.place:
        return ()
    still = {name: level.middle for name, level in moments.levels.items() if not level.span}
    shown = {name: f"{still[name] / 1e5:.4g} bar" for name in ("p1", "p2") if name in still}
    if still.get("omega") == 0.0:
        shown["omega"] = "0 rad/s"
    return tuple(ChannelFinding(
        f"{name} is {value} in the whole recording although the piston moves: its sensor or its "
        "cable may be dead", "hold", (name,)) for name, value in shown.items())


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
        if channel := settings.channels.get(role):
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

    Raises InputError if a corrected value is out of the range of its key.
    """
    tree = settings.model_dump()
    for finding in findings:
        merge(tree, finding.correction)
    return settings_from_tree(tree, "correction")
