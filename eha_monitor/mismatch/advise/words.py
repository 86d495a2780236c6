"""Advice in sentences, with the units that people write."""

import math

from eha_monitor.mismatch.advise.identifiability import (
    BASE,
    CONFUSED,
    HOPELESS,
    LEAST,
    Confusion,
    DetectionLimit,
    Known,
)
from eha_monitor.mismatch.advise.motions import Motion
from eha_monitor.mismatch.advise.separate import DECISIVE, Advice, Check, Doubt
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import SYMBOLS, number, quantity, share
from eha_monitor.settings.rig import Segment
from eha_monitor.words import effect_words, listed, odds

NOTABLE = 0.02  # of B or beta_e: a shift below is of no matter
HOPELESS_INFLATION = 1000.0
HARDLY = 100.0  # variance inflation: standard deviations are ten times as large
MOST = 4  # sentences of a kind


def sentences(advice: Advice) -> tuple[str, ...]:
    """Return the advice as sentences, the most important first."""
    # Of each parameter the named and the commonest ones.
    found = [confusion_words(c, advice) for parameter in BASE
             for c in [c for c in advice.confusions if c.parameter == parameter][:2]]
    found += [known_words(one) for one in advice.known
              if one.name in BASE and abs(one.correlation) > CONFUSED
              and not any(c.parameter == one.name and one.most_with.startswith(c.effect)
                          for c in advice.confusions)]
    found += group_words(advice.groups)
    found += blind_words(advice)
    found += advice.said
    if advice.doubts or not advice.said:
        found += motion_words(advice)
    found += [check_words(check, advice.damping_unit) for check in advice.checks]
    return tuple(found)


def amount(value: float, unit: str, digits: int = 3) -> str:
    """Return an SI value in a unit that people write: ``0.12 bar`` is kPa, ``1`` is %."""
    value = float(f"{value:.6g}")
    return share(value, digits) if unit == "1" else quantity(value, unit, digits)


def rounded(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most a value."""
    power = 10.0 ** math.floor(math.log10(abs(value)))
    step = next(step for step in (5.0, 2.0, 1.0) if step * power <= abs(value) * (1 + 1e-9))
    return float(f"{math.copysign(step * power, value):.6g}")


def unit_of(parameter: str, advice: Advice) -> str:
    """Return the unit of a health parameter."""
    return advice.damping_unit if parameter == "B" else "Pa"


def confusion_words(c: Confusion, advice: Advice) -> str:
    """Return a confusion as a sentence."""
    parameter, effect = SYMBOLS[c.parameter], effect_words(c.effect)
    unit = unit_of(c.parameter, advice)
    part = 1.0 if c.named else rounded(c.amount) / c.amount
    size = amount(part * c.amount, c.unit)
    if abs(c.plateau_correlation) > HOPELESS:
        nearly = "" if c.plateau_inflation > HOPELESS_INFLATION else "nearly "
        text = (f"{parameter} and {effect} are {nearly}indistinguishable at constant speed "
                f"({share(advice.plateaus)} of this recording): correlation "
                f"{abs(c.plateau_correlation):.3f}, variance inflation "
                f"{number(c.plateau_inflation, 2)}; {parameter} may be off by "
                f"{amount(part * abs(c.plateau_shift), unit)} for {size} of it")
        how = "between them" if c.named else "there"
        if abs(c.correlation) < HOPELESS:
            text += (f"; the changes of speed {how} distinguish them (correlation "
                     f"{abs(c.correlation):.3f}, inflation {number(c.inflation, 2)} over all), "
                     "if the model of friction at reversal is right")
        return text
    text = (f"{parameter} and {effect}: correlation {abs(c.correlation):.3f}, variance inflation "
            f"{number(c.inflation, 2)}")
    if c.inflation > HARDLY:
        text += ": nearly indistinguishable in this recording"
    shift = amount(part * abs(c.shift), unit)
    return (f"{text}; omitting the identified {size} would bias {parameter} by "
            f"{shift}" if c.named else
            f"{text}; omitting {size} of it would bias {parameter} by {shift}")


def known_words(one: Known) -> str:
    """Return with what a health parameter is confused inside the fit."""
    effect, dot, symbol = one.most_with.partition(".")
    other = f"{symbol} of {effect_words(effect)}" if dot else SYMBOLS.get(effect, effect)
    return (f"{SYMBOLS[one.name]} and {other} are estimated together: correlation "
            f"{abs(one.correlation):.3f}, variance inflation {number(one.inflation, 2)}")


def group_words(groups: tuple[tuple[str, ...], ...]) -> list[str]:
    """Return the effects that the recording shows, but does not tell apart."""
    if not groups:
        return []
    return ["visible in this recording, but indistinguishable from each other: " + "; ".join(
        listed([effect_words(name) for name in group]) for group in groups)]


def blind_words(advice: Advice) -> list[str]:
    """Return which effects the recording does not show at a size that matters."""
    unseen: dict[str, DetectionLimit] = {}
    for limit in advice.detection_limits:
        if limit.gain < LEAST:
            unseen.setdefault(limit.effect, limit)
    found = []
    for limit in list(unseen.values())[:MOST]:
        text = f"{effect_words(limit.effect)} would not show here"
        if math.isfinite(limit.visible) and limit.visible < 1e6 * limit.matters:
            text += f" below {amount(limit.visible, limit.unit, 2)}"
            moved = [f"{SYMBOLS[name]} by {share(abs(shift))}"
                     for name, shift in limit.shifts.items() if abs(shift) > NOTABLE]
            if moved:
                text += f", and would shift {listed(moved)}"
        found.append(text)
    if len(unseen) > MOST:
        rest = [effect_words(name) for name in list(unseen)[MOST:]]
        found.append(f"nor would {listed(rest, 'or')}, unless far above the usual size")
    return found


def doubt_words(doubt: Doubt) -> str:
    """Return what is to be separated from what."""
    effect = effect_words(doubt.effect)
    if doubt.rival:
        return f"{effect} from {effect_words(doubt.rival)}"
    return f"{amount(doubt.amount, doubt.unit, 2)} of {effect} from {SYMBOLS[doubt.parameter]}"


def segment_words(segment: Segment) -> str:
    """Return one stretch of a motion: shape, size, time."""
    size = f"amplitude {amount(segment.amplitude, 'm')}" if segment.kind != "rest" else ""
    about = f" about x = {amount(segment.offset, 'm')}" if abs(segment.offset) > 1e-9 else ""
    lasting = f"for {number(segment.duration, 3)} s"
    if segment.kind == "rest":
        return f"rest{about.replace('about', 'at')} {lasting}"
    if segment.kind == "triangle":
        speed = 4.0 * segment.amplitude * segment.frequency
        return (f"a triangle of {size} at {amount(speed, 'm/s')} "
                f"({number(segment.frequency, 3)} Hz){about} {lasting}")
    if segment.kind in ("multisine", "chirp"):
        return (f"a {segment.kind} of {size} from {number(segment.frequency)} to "
                f"{number(segment.frequency_end)} Hz{about} {lasting}")
    if segment.kind == "steps":
        return (f"random steps of {size}, {number(segment.frequency)} a second{about} "
                f"{lasting}")
    return f"a sine of {size} at {number(segment.frequency)} Hz{about} {lasting}"


def motion_sentence(motion: Motion) -> str:
    """Return a motion in full."""
    return ", then ".join(map(segment_words, motion.segments.values()))


def motion_words(advice: Advice) -> list[str]:
    """Return what to record next, and what no motion settles."""
    found = []
    if not advice.doubts:
        return ["no identified effect is in doubt: this recording distinguishes each from its "
                "alternatives"
                ] if not advice.groups and not advice.confusions else []
    failed = {(c.effect, c.rival) for c in advice.checks if c.found < DECISIVE}
    settled = [d for d in advice.doubts
               if d.then >= DECISIVE and (d.effect, d.rival) not in failed]
    if advice.motion is not None and settled:
        gains = listed([f"{doubt_words(d)} by {odds(d.then)} (this recording alone by "
                        f"{odds(max(d.now, 0.0))})" for d in settled])
        found.append(f"record also {motion_sentence(advice.motion)}: together with this "
                     f"recording it distinguishes {gains}")
    for doubt in advice.doubts:
        if doubt in settled:
            continue
        check = CATALOGUE[doubt.rival or doubt.effect].rig_check
        check = check[0].lower() + check[1:].rstrip(".")
        if not advice.plannable:
            found.append(f"this recording cannot distinguish {doubt_words(doubt)}, and the "
                         "config lacks the areas or the pump data to plan a motion; at the rig: "
                         f"{check}")
            continue
        if (doubt.effect, doubt.rival) in failed:
            found.append(f"no motion distinguishes {doubt_words(doubt)}: the one predicted to do "
                         f"so failed in simulation; at the rig: {check}")
            continue
        best = max((one.gains[advice.doubts.index(doubt)] for one in advice.tried), default=0.0)
        found.append("no motion within the travel and the speed of this recording distinguishes "
                     f"{doubt_words(doubt)} (at best {odds(max(best, 0.0))}); at the rig: {check}")
    return found


def check_words(check: Check, damping_unit: str) -> str:
    """Return what came of the proposed motion in simulation."""
    units = {"B": damping_unit, "beta_e": "Pa"}
    values = listed([f"{SYMBOLS[name]} = {amount(found, units[name], 4)} where "
                     f"{amount(true, units[name], 4)} is true"
                     for name, (found, _, true) in check.values.items()])
    other = f" against {effect_words(check.rival)}" if check.rival else ""
    failed = "" if check.found >= DECISIVE else ", so that motion is not decisive"
    return (f"checked in simulation with noise: {effect_words(check.effect)}{other} "
            f"is distinguished by {odds(max(check.found, 0.0))}, where "
            f"{odds(max(check.predicted, 0.0))} were predicted{failed}; {values}")
