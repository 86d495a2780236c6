"""A diagnosis in words: names, places and sizes as a person says them."""

import math
import re

from eha_monitor.mismatch.diagnosis import (
    Change,
    Diagnosis,
    NamedEffect,
    RigFinding,
    SignalFit,
    Value,
)
from eha_monitor.mismatch.policy import POLICY
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.plausibility.sheet import cylinder_against, load_against, sizes_against
from eha_monitor.quantity import (
    COMPARED,
    DIAGNOSED,
    SYMBOLS,
    Scale,
    number,
    quantity,
    readable,
    share,
    side_by_side,
    with_uncertainty,
)
from eha_monitor.settings.channels import CHANNELS
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own
from eha_monitor.settings.rig import TOLERATED, Rig, Tolerance
from eha_monitor.units import LARGEST
from eha_monitor.words import PARAMETER_WORDS, effect_words, listed, probability

# Verdict -> (colour, first words).
VERDICTS = {
    "consistent": ("ok", "Model and recording agree"),
    "mismatch": ("warn", "Mismatch identified"),
    "unexplained": ("error", "Unexplained mismatch"),
    "insufficient_data": ("unknown", "Insufficient data")}
# Verdict against healthy recordings -> the same.
AGAINST_HEALTHY = {
    "consistent": ("ok", "No change from the healthy recordings"),
    "mismatch": ("warn", "Change identified"),
    "unexplained": ("error", "Changed, unexplained")}
REGIMES = {
    "velocity_reversal": "where the motion reverses", "high_speed": "at high speed",
    "high_pressure": "at a high pressure difference", "near_limit": "near a limit",
    "always": "all the time"}
BALANCES = {"force": "force balance", "flow": "flow balance", "drive": "drive",
            "sensor": "sensors"}
DATA = {"held_out": "a held-out part of the recording",
        "held_out_bag": "another recording, not used in the fit"}
_MOST_INTERVALS = 6
_WHOLE = 0.9  # of a recording: intervals that cover it say nothing
_STATISTICS = "variance inflation"  # of every sentence on how well parameters are separated


def head_of(found: Diagnosis) -> tuple[str, str]:
    """Return the colour and the first words of a verdict: of the first case that it is."""
    verdict, names = found.verdict, (*found.rig_data, *found.effects)
    healthy, agrees, mismatch = found.references, verdict == "consistent", verdict == "mismatch"
    cases = (
        (healthy and agrees and found.change_points, "warn", "Changed while it was recorded"),
        (healthy and agrees and found.blind, "unknown", "No change in what can be compared"),
        (healthy and found.learned and verdict == "unexplained", "warn",
         "Changed, and learned from the recording"),
        (healthy and verdict in AGAINST_HEALTHY, *AGAINST_HEALTHY.get(verdict, ("", ""))),
        (found.pieces or (found.change_points and agrees), "warn",
         "A parameter changed; no other mismatch"),
        (found.events and agrees, "warn",
         "Disturbed for a while; in the rest model and recording agree"),
        (found.learned, "warn", "Effect not in the catalogue, learned from the recording"),
        (mismatch and names and all(one.probability < POLICY.likely for one in names), "warn",
         "Mismatch; none of the names for it is more likely than not"),
        (mismatch and found.rig_data and not found.effects, "warn",
         "Wrong rig data explain the mismatch; no effect is missing"),
        (True, *VERDICTS.get(verdict, ("unknown", verdict))))
    return next((colour, words) for holds, colour, words in cases if holds)


def compared(found: Diagnosis) -> bool:
    """Whether there is a model after the one of the config."""
    return bool(found.effects or found.rig_data or found.rig_within or found.pieces
                or found.learned or found.references)


def model_names(found: Diagnosis) -> tuple[str, str]:
    """Return what the two models are called."""
    return ("healthy", "now") if found.references else ("before", "after")


def nameless(found: Diagnosis) -> bool:
    """Whether something is missing, and nothing of it was named or learned."""
    return found.verdict == "unexplained" and not (found.effects or found.learned)


def advice_in_parts(found: Diagnosis) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the advice for whoever stands at the rig, and that on correlations.

    How well parameters are separated is no advice where the model lacks what nobody knows.
    """
    vain = nameless(found) and not found.references  # what the references are stands all the same
    statistics = tuple(text for text in found.advice if vain or _STATISTICS in text)
    return tuple(text for text in found.advice if text not in statistics), statistics


def own_config(rig: Rig) -> str:
    """Return the option that a command needs; none for the rig that is taken without one."""
    return "" if rig == Rig() else " --config CONFIG"


def next_steps(found: Diagnosis, bags: str) -> tuple[str, ...]:
    """Return what to do, the most important first; commands stand between backticks.

    ``bags`` are the recordings as a command takes them.
    """
    steps = [f"correct {finding.key} in the config, or find out why it is "
             f"{value_words(finding.found)}" for finding in found.rig_data]
    if found.verdict == "insufficient_data":
        steps.append("record strokes both ways at two speeds at least, each steady for a second "
                     "or so; a drive that hunts needs a lower position gain first")
    if found.change_points:
        steps.append("find out what happened to the machine then, and record it again: "
                     f"`eha-monitor diagnose {bags}` judges what came after by itself")
    if found.events:
        when = interval_words(tuple((one.start_s, one.stop_s) for one in found.events))
        steps.append(f"find out what happened at {when}: it was left out")
    if found.blind:
        steps.append("diagnose the healthy recordings together, `eha-monitor diagnose A B C`: "
                     f"what their {listed(found.blind)} balance holds hides changes of it")
    steps += [effect.rig_check for effect in found.effects if effect.rig_check][:1]
    if found.references and found.changes:
        steps += [step for change in found.changes if (step := _look_for(change))]
        steps.append("find out why it has changed; after a repair `eha-monitor diagnose "
                     f"{bags} --reference ...` says whether it is as before")
    for term in found.learned if found.references else ():
        where = " at that place of the stroke" if term.of[0] == "x" else ""
        steps.append(f"look at {LOOK_AT[term.balance]}{where}")
    completed = found.verdict == "mismatch" or found.learned
    if completed and not found.references:  # what has changed is the machine's, not the config's
        known = [SYMBOLS.get(name, name) for name, value in found.after.items()
                 if math.isfinite(value.value)]
        steps.append(f"use {listed(known) or 'the numbers'} of the completed config: "
                     f"`eha-monitor diagnose {bags} --write-config FILE`")
    elif found.verdict == "unexplained" and not completed:
        # The force and the flow are measured beside the drive, whatever moves it.
        alone = found.references and found.location.balance.get("drive", 0.0) == 1.0
        steps.append("B and βe stand: only the drive is another" if alone else
                     "do not act on B and βe: what is missing is in them")
    if nameless(found):
        steps += _look_yourself(found, bags)
    steps += advice_in_parts(found)[0]
    return tuple(map(sentence, dict.fromkeys(steps))) or ("Nothing.",)


# Balance -> what to look at where no effect of the catalogue explains what is missing.
LOOK_AT = {
    "force": "the load, the stops, the guides and seals, and the pressure and position sensors",
    "flow": "the pump, hoses, valves and oil, and the pressure, speed and position sensors",
    "drive": "the motor, its limits and its speed command, and the position sensor",
    "sensor": "the sensors, their cables and amplifiers"}


def _look_yourself(found: Diagnosis, bags: str) -> list[str]:
    """Return what to do where no effect of the catalogue explains what is missing."""
    balance = _worst_balance(found)
    steps = [f"look at {LOOK_AT[balance]}; the report's curve shows when or where it is off"
             ] if balance in LOOK_AT else []
    if not found.references:
        steps.append(f"compare with recordings of the healthy machine: `eha-monitor diagnose "
                     f"{bags} --reference HEALTHY ...` says whether it has always been so")
    else:
        steps.append(f"`eha-monitor diagnose {bags}` without `--reference` fits laws that the "
                     "healthy machine has not had, such as a limit of the drive")
    steps.append("test a law that you suspect: `--hypothesis FILE` (docs/effects.md)")
    return steps


def _worst_balance(found: Diagnosis) -> str:
    return max(found.location.balance, key=found.location.balance.get, default="")


def off_words(found: Diagnosis) -> tuple[str, ...]:
    """Return by how much the balance is off that nothing was named in; nothing if it was."""
    balance = _worst_balance(found)
    fit = found.signals.get(balance)
    if not nameless(found) or fit is None or not math.isfinite(fit.before_rms):
        return ()
    return (f"the {balance} is off by {error_words(fit.before_rms, fit)} on unseen data (root "
            f"mean square), where the sensors' noise makes {error_words(fit.noise_rms, fit)}",)


# Parameter, and whether it is too high or has grown -> what to look for at the machine.
LOOK_FOR = {
    ("B", True): "look for what brakes the piston (worn or swollen seals, a side load, cold oil)",
    ("B", False): "check the oil's temperature and grade, and the areas in the config",
    ("beta_e", True): "check the volumes in the config",
    ("beta_e", False): "look for air in the oil: bleed the circuit, check the suction side and "
                       "the charge pressure",
    ("pump_displacement", True): "check the position sensor and the speed sensor: a pump does not "
                                 "grow by wear",
    ("pump_displacement", False): "check the pump for wear, its coupling and the speed sensor",
    ("charge_pressure", True): "check the charge pump's relief valve, and a return line or filter "
                               "that is blocked",
    ("charge_pressure", False): "check the charge pump, the gas pressure of the accumulator and "
                                "the oil level",
    ("makeup_valve", True): "check that chamber's make-up valve: one that stays open lets the "
                            "source's pressure in",
    ("makeup_valve", False): "check that chamber's make-up valve and its line: blocked, or closed "
                             "by dirt"}


def _look_for(change: Change) -> str:
    """Return what to look for where a number has changed, or nothing where nobody knows."""
    if change.what in CATALOGUE:
        return CATALOGUE[change.what].rig_check
    return LOOK_FOR.get((change.what, change.now.value > change.reference.value), "")


def not_in_config(found: Diagnosis) -> dict[str, str]:
    """Return the effects that the config of a diagnosis does not contain, each with the reason."""
    def why(effect: NamedEffect) -> str:
        if found.references:
            return "what has changed is the machine's, not the config's"
        return ("a config contains only permanent effects"
                if effect.intervals_s or effect.name in CATALOGUE else
                "the model that runs has no such term, only the balances have")

    written = {name for name, values in found.config_effects.items()
               if name in CATALOGUE or is_own(values)}
    return {effect.name: why(effect) for effect in found.effects if effect.name not in written}


def parameter_name(name: str) -> str:
    """Return a parameter in words and as a symbol: ``viscous damping B``."""
    return f"{PARAMETER_WORDS.get(name, name)} {SYMBOLS.get(name, name)}"


def rivals(names: tuple[str, ...]) -> str:
    """Return what something is indistinguishable from; empty without any."""
    return listed([effect_words(name) for name in names], "or")


def change_rows(found: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Return what has changed: name, healthy, now, and what it is indistinguishable from."""
    return [(f"{effect_words(one.what)} {one.symbol}" if one.symbol else
             f"{PARAMETER_WORDS.get(one.what, effect_words(one.what))} {SYMBOLS.get(one.what, '')}"
             .strip(), *pair_words(one.reference, one.now),
             rivals(one.indistinguishable_from) or "–") for one in found.changes]


def parameter_words(found: Diagnosis, name: str) -> tuple[str, str]:
    """Return a parameter before (of healthy recordings) and after (now).

    What has changed has the numbers of its own sentence.
    """
    for change in found.changes:
        if change.what == name and not change.symbol:
            return pair_words(change.reference, change.now)
    if nameless(found) and not found.references and name in found.before:
        return f"({value_words(found.before[name])}), in doubt", "—"
    return pair_words(found.before.get(name), found.after.get(name))


def channels_in_parts(found: Diagnosis) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what stands against the channels, and what is merely known: a hold, or a zero."""
    held = [finding for finding in found.channels if finding.kind == "zero" or (
        finding.kind == "hold" and finding.correction)]
    return (tuple(one.finding for one in found.channels if one not in held),
            tuple(one.finding for one in held))


def recordings_words(found: Diagnosis) -> str:
    """Return what was looked at, as a sentence begins."""
    return "In these recordings" if len(found.bags) > 1 else "In this recording"


def windows_words(found: Diagnosis) -> str:
    """Return on which parts of a long recording the effects were named; empty if on all of it."""
    if not found.named_on:
        return ""
    length = sum(one.stop_s - one.start_s for one in found.named_on)
    several = len({one.bag for one in found.named_on}) > 1
    where = listed([f"{number(one.start_s)} to {number(one.stop_s)} s"
                    + (f" of {one.bag}" if several else "") for one in found.named_on])
    over = (f"the {number(found.looked_s)} most informative s" if found.looked_s
            else "the whole recording")
    return (f"Effects were identified on the most informative {number(length)} s ({where}); "
            f"the models were then run over {over}.")


def verdict_probability(found: Diagnosis) -> float:
    """Return the probability of the verdict, NaN where none was computed."""
    clean, nameless = (found.probability.get(key, math.nan)
                       for key in ("consistent", "unexplained"))
    return {"consistent": clean, "unexplained": nameless,
            "mismatch": 1.0 - clean - nameless}.get(found.verdict, math.nan)


def head_words(found: Diagnosis) -> str:
    """Return the first words of a verdict with its probability: ``Insufficient data (80 %)``."""
    return head_of(found)[1] + in_brackets(verdict_probability(found))


def in_brackets(share_of_one: float) -> str:
    """Return `` (97 %)``, or nothing where the probability is not known."""
    return f" ({probability(share_of_one)})" if math.isfinite(share_of_one) else ""


def message_words(found: Diagnosis, probable: bool = False) -> str:
    """Return the message as a sentence, without the numbers of the rig, which stand before it.

    ``probable`` puts its probability behind each effect.
    """
    before = {finding.statement for finding in found.rig_data}
    text = "; ".join(part for part in found.message.split("; ") if part not in before)
    for effect in found.effects if probable else ():
        text = text.replace(effect.statement, effect.statement + in_brackets(effect.probability))
    return sentence(text)


def rig_words(finding: RigFinding) -> str:
    """Return what is wrong about a number of the rig, with its probability.

    No sentence: it begins with the key as the config spells it.
    """
    return finding.statement.rstrip(". ") + in_brackets(finding.probability)


def tolerance_words(tolerance: Tolerance, key: str) -> str:
    """Return how well a number is known by the config: ``± 20 %``, ``a factor of 3``."""
    if key not in TOLERATED:
        return "—"
    value = getattr(tolerance, key)
    return f"a factor of {number(value, 3)}" if value > 1.0 else f"± {share(value)}"


def beyond_words(tolerance: Tolerance, finding: RigFinding) -> str:
    """Return by how many of its tolerances a number is off, or a dash where that is not known."""
    ratio = finding.found.value / finding.configured if finding.configured else math.nan
    if finding.key not in TOLERATED or not (math.isfinite(ratio) and ratio > 0):
        return "—"
    return f"{number(abs(math.log(ratio)) / tolerance.log_spread(finding.key), 2)} tolerances"


def rig_values(finding: RigFinding) -> tuple[str, str]:
    """Return a number of the rig as configured and as found, in one unit."""
    found = finding.found
    return side_by_side(finding.configured, found.value, found.stddev, found.unit)


def sentence(text: str) -> str:
    """Return a text with a capital at its start and a full stop at its end.

    A symbol (βe), a channel (p1) or the name of a recording (healthy_3) keeps its own letters.
    """
    if not (text := text.strip()):
        return ""
    word = re.split(r"[\s:,]", text, maxsplit=1)[0]
    name = not text[0].isascii() or word in CHANNELS or re.search(r"[\d_/]|\.\w", word)
    first = text[0] if name else text[0].upper()
    return first + text[1:] + ("" if text[-1] in ".!?" else ".")


def worst_words(found: Diagnosis) -> str:
    """Return the times where the disagreement is worst; empty where they are the whole of it."""
    intervals = found.location.intervals_s
    if sum(stop - start for start, stop in intervals) > _WHOLE * found.duration_s > 0:
        return ""
    return interval_words(intervals)


def regime_words(found: Diagnosis) -> str:
    """Return in which motion the disagreement is; empty where that is not known."""
    return REGIMES.get(found.location.regime, found.location.regime.replace("_", " "))


def place_words(found: Diagnosis) -> str:
    """Return where the disagreement lies, as one phrase; empty where there is none."""
    shares = sorted(((share, name) for name, share in found.location.balance.items()
                     if math.isfinite(share) and share >= 0.005), reverse=True)
    if not shares:
        return ""
    text = ", ".join(f"{BALANCES.get(name, name)} {percent(share)}" for share, name in shares)
    regime = regime_words(found)
    return f"{text}; {regime}" if regime else text


def interval_words(intervals_s: tuple[tuple[float, float], ...]) -> str:
    """Return intervals in seconds, at most a few of them, or nothing."""
    known = [(start, stop) for start, stop in intervals_s
             if abs(start) < LARGEST and abs(stop) < LARGEST]
    few = known[:_MOST_INTERVALS]
    digits = 1 if all(stop - start > 0.09 for start, stop in few) else 3
    shown = ", ".join(f"{start:.{digits}f}–{stop:.{digits}f}" for start, stop in few)
    more = len(known) - len(few)
    return f"{shown} s{f' and {more} more' if more else ''}" if shown else ""


def percent(share: float) -> str:
    """Return a share of one in percent, with tenths only near 0 and 1."""
    if not math.isfinite(share):
        return "—"
    value = 100 * share
    if 99 < value < 100 or 0 < value < 1:
        return f"{min(value, 99.9) if value > 99 else max(value, 0.1):.1f} %"
    return f"{value:.0f} %"


def log_units(value: float) -> str:
    """Return evidence in log units, thousands apart."""
    if not math.isfinite(value):
        return "—"
    digits = 1 if abs(value) < 10 else 0
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def value_words(value: Value | None) -> str:
    """Return ``value ± stddev unit``, or a dash where there is none."""
    if value is None or not math.isfinite(value.value):
        return "—"
    if value.stddev == 0:  # it was given, or read off the data
        return quantity(value.value, value.unit)
    return with_uncertainty(value.value, value.stddev, value.unit)


def pair_words(one: Value | None, other: Value | None) -> tuple[str, str]:
    """Return two values of one quantity in one unit, so that they can be compared."""
    known = [value for value in (one, other) if value is not None
             and math.isfinite(value.value) and math.isfinite(value.stddev) and value.stddev > 0]
    if len(known) < 2 or known[0].unit != known[1].unit:
        return value_words(one), value_words(other)
    scale = readable(max(max(abs(value.value), value.stddev) for value in known), known[0].unit)
    return tuple(with_uncertainty(value.value, value.stddev, value.unit, scale) for value in known)


def error_scale(fit: SignalFit) -> Scale:
    """Return one scale for all errors of a signal, so that they can be compared.

    It is that of the smallest one in which the largest has four digits before the point at most.
    """
    known = sorted(value for value in (fit.before_rms, fit.after_rms, fit.noise_rms)
                   if math.isfinite(value) and value > 0)
    scales = [readable(value, fit.unit) for value in known] or [readable(0.0, fit.unit)]
    return next((scale for scale in scales if known and known[-1] * scale.factor < 1e4),
                scales[-1])


def error_words(value: float, fit: SignalFit) -> str:
    """Return an error of a signal, in the common unit of the signal."""
    if not math.isfinite(value):
        return "—"
    scale = error_scale(fit)
    return f"{number(value * scale.factor, 3)} {scale.unit}".rstrip()


def fit_rows(found: Diagnosis) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the errors on unseen data: heads, and a row for each signal."""
    both, rows = compared(found), []
    for name, fit in found.signals.items():
        before, after, noise = (error_words(value, fit) for value in (
            fit.before_rms, fit.after_rms, fit.noise_rms))
        rows.append((name.replace("_", " "), before, *(
            (after, noise, removed_words(fit)) if both else (noise,))))
    return ("error on unseen data", *((*model_names(found), "noise", "removed") if both else
                                      ("model", "noise"))), rows


def removed_words(fit: SignalFit) -> str:
    """Return the share of the error that was removed; what is worse than before is no share."""
    share = removed(fit)
    if not math.isfinite(share):
        return "—"
    return percent(max(share, 0.0)) if share > -0.02 else "grew"


def removed(fit: SignalFit) -> float:
    """Return the share of the error beyond the noise that the named physics removes."""
    noise = fit.noise_rms if math.isfinite(fit.noise_rms) else 0.0
    beyond = fit.before_rms - noise
    if not beyond > 0.02 * max(noise, 0.0) or not math.isfinite(fit.after_rms):
        return math.nan
    return min((fit.before_rms - fit.after_rms) / beyond, 1.0)


def footnote(found: Diagnosis) -> str:
    """Return what ± is in an answer: a comparison has no tolerances in it."""
    return COMPARED if found.references else DIAGNOSED


def certainty(found: Diagnosis) -> str:
    """Return what speaks for the other verdicts, and where a probability is from, as sentences."""
    rest = [f"{words}: {probability(found.probability[key])}" for key, words in
            (("consistent", "that the config's own model lacks nothing"),
             ("unexplained", "that something is missing and was not identified"))
            if math.isfinite(found.probability.get(key, math.nan))]
    if not rest:
        return ""
    return (f"Probability {'; '.join(rest)}. All probabilities in this report are computed from "
            "the evidence of every compared set of effects, wrong rig data and smooth unknown "
            "terms. An alternative that reaches 5 % is listed as indistinguishable from the "
            "answer.")


LOADLIKE = {"constant_load", "pressure_offset"}  # what reads as a constant force
SIZES = {"added_mass", "mass", "pump_displacement", "pump_flow_gain", "area_1", "area_2"}


def against_config(found: Diagnosis, settings: Settings) -> list[str]:
    """Return what least squares say against the config's load, mass and pump.

    Of a load that is named, or makes half of what the config leaves, what it may be; of mass and
    pump where the answer says nothing of either.
    """
    named = {effect.name for effect in found.effects} | {one.key for one in found.rig_data}
    loads, force, lines = LOADLIKE & named, found.signals.get("force"), []
    if len(found.baselines) == 1 and not found.references:
        first = found.baselines[0]
        lines += cylinder_against(first, settings) + (
            [] if SIZES & named else sizes_against(first, settings))
    if loads or (force is not None and not found.references):
        lines += load_against(found.baselines, settings, None if loads else force.before_rms)
    return lines
