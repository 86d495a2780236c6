"""The gates between a filter's answer and that of least squares on the balances.

Both answer for the same recordings; where they contradict each other, what each leaves of the
force on unseen data decides, and which needs fewer names.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from eha_monitor.balances.answer import Asked, first_answer
from eha_monitor.balances.candidates import Scale, candidates_of
from eha_monitor.balances.measured import courses_of
from eha_monitor.balances.named import DRY_SYMBOLS
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import pooled_table, tables_of
from eha_monitor.mismatch.diagnosis import Diagnosis, Gate, Value
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import effect_words, listed


class Filtered(NamedTuple):
    """What a filter answers, and how near it comes to the recordings.

    settings : config with what the recordings decide of the drive.
    follows : its innovations are those of its noise, with what it names.
    lacks : more than ``SearchPolicy.lacking`` of a log unit to a sample.
    """

    answer: Diagnosis
    settings: Settings
    follows: bool
    lacks: bool


def instead_of_filter(first: Diagnosis, filtered: Filtered, recordings: list[Recording],
                      settings: Settings, asked: Asked) -> Diagnosis | None:
    """Return what least squares answer where it stands, not what a filter does; None elsewhere."""
    found = filtered.answer
    if first.verdict == "insufficient_data":  # of motions too quick for its band it says nothing
        return None
    judges = recordings if asked.held_out is None else [asked.held_out]
    agrees = agrees_closely(first)
    beyond = far_from_config(first) or bool(first.learned) or drifts(first)
    # Where a filter leaves something, its names make up for laws that it does not have.
    if found.verdict == "mismatch" and not filtered.follows and (agrees or beyond):
        return first
    if beyond and explains_more(first, found, judges, filtered.settings):
        return first
    apart = contradicted(first, found, filtered.settings.rig)
    # What least squares have no law for (a sensor's curve) may be hardly any of the force, and yet
    # move its numbers: less than ``open`` of what they leave is enough.
    if apart and not (explains_more(found, first, judges, filtered.settings, POLICY.open)
                      or needs_fewer(found, first, recordings, settings, asked)):
        return replace(first, gates=(*first.gates, *apart))
    if found.verdict != "unexplained" or found.learned:
        return None
    # Innovations of another form than the config's laws are no mismatch of this machine, and no
    # balance is theirs.
    open_ = first.verdict != "mismatch" and not force_is_closed(first)
    return first if agrees or beyond or (open_ and filtered.lacks) else None


def far_from_config(found: Diagnosis | None) -> bool:
    """Tell whether a filter built on the config's laws may be unable to judge what is named.

    A filter weighs each sample's innovation: where the config leaves ``near`` of a balance open,
    or friction is dry, whose law nobody knows, it answers for the form of its laws and not for the
    machine.  The balances have then named what halves the error on unseen parts, or friction.
    """
    if found is None or found.verdict != "mismatch":
        return False
    return any(DRY_SYMBOLS & effect.parameters.keys() for effect in found.effects) or any(
        fit.before_rms / fit.signal_rms > POLICY.near
        and fit.after_rms / fit.signal_rms < POLICY.open * (fit.before_rms / fit.signal_rms)
        for fit in found.signals.values())


def drifts(found: Diagnosis) -> bool:
    """Tell whether damping changes while a recording runs, as no law of a filter does."""
    return found.drift is not None and "B" in found.after and (
        abs(found.drift.value) > POLICY.between * found.after["B"].value)


def differ_in_damping(found: Diagnosis | None) -> bool:
    """Tell whether B is surely another in some of several recordings, as in no model of a filter.

    By ``varied`` deviations and ``worse`` of it: the oil was warmer, and one filter of all would
    look for minutes for what explains that.
    """
    each = [] if found is None else [
        one.force["B"] for one in found.baselines if one.force is not None]
    known = [one for one in each if one.determined]
    return any(abs(one.value - other.value) > max(
        POLICY.varied * float(np.hypot(one.stddev, other.stddev)),
        POLICY.worse * max(abs(one.value), abs(other.value)))
        for one, other in combinations(known, 2))


def force_is_closed(found: Diagnosis) -> bool:
    """Tell whether what is named leaves no more of the force than the sensors make.

    Friction, whose law nobody knows, is then none, or as it is written: a filter can judge what
    is smaller, and its search is made to the end.
    """
    force = found.signals.get("force")
    return force is not None and force.after_rms <= POLICY.clean * force.noise_rms


def agrees_closely(found: Diagnosis) -> bool:
    """Tell whether the config's own model leaves no more of any balance than anybody repairs.

    A law of a real machine is never the config's, and a filter that weighs each sample sees that
    long before it is a share ``worse`` of a force or a flow.
    """
    return found.verdict == "consistent" and bool(found.signals) and all(
        one.after_rms <= POLICY.worse * one.signal_rms for one in found.signals.values())


def left_of_force(answer: Diagnosis, recordings: Sequence[Recording], settings: Settings) -> float:
    """Return the rms of the force that an answer's laws and numbers leave on unseen parts, N.

    B and the constant load are fitted there.

    Raises
    ------
    InputError
        If a recording has no force balance.
    """
    numbers = {one.key: one.found.value for one in (*answer.rig_within, *answer.rig_data)}
    effects = {name: dict(values) for name, values in answer.config_effects.items()}
    for name, value in zip(answer.fitted.names, answer.fitted.values, strict=True) if (
            answer.fitted) else ():
        effect, _, symbol = name.partition(".")
        if effect in effects:  # one of the config's may have moved within its tolerance
            effects[effect][symbol] = float(value)
    settings = settings.model_copy(update={
        "effects": effects, "rig": settings.rig.model_copy(update=numbers)})
    rig, courses = settings.rig, courses_of(recordings, settings)[1]
    base = tuple(one for one in candidates_of("force", Scale.of(courses), rig) if one.always)
    whole = pooled_table(tables_of(courses, rig, "force", base, POLICY))
    return whole.rms(whole.crosswise([*whole.places])) * whole.size


def explains_more(first: Diagnosis, found: Diagnosis, recordings: list[Recording],
                  settings: Settings, share: float = 0.0) -> bool:
    """Tell whether the first answer leaves less of the force on unseen data than the other.

    By more than ``worse`` of it, both as laws of the config and as a balance in its band, or less
    than a ``share`` of what the other leaves: the gate between a filter and least squares.
    """
    force = first.signals.get("force")
    if force is None:
        return False
    mine, theirs = (left_of_force(one, recordings, settings) for one in (first, found))
    return theirs - mine > POLICY.worse * force.signal_rms or mine < share * theirs


def needs_fewer(found: Diagnosis, first: Diagnosis, recordings: list[Recording],
                settings: Settings, asked: Asked) -> bool:
    """Tell whether the recordings need fewer names with the sensors as a filter says they err.

    Least squares read the sensors as they are: a position that is 3 % too large is a spring that
    is 3 % too soft, and a drive that lags.  Corrected, the balances have to leave no more of any
    signal, with fewer names in all; a scale in the place of a load saves none.
    """
    sensors = {one.name: found.config_effects[one.name] for one in found.effects
               if one.balance == "sensor" and one.name in found.config_effects}
    if not sensors:
        return False
    again = first_answer(recordings, settings.model_copy(update={
        "effects": {**settings.effects, **sensors}}), asked)

    def names(answer: Diagnosis) -> int:
        return len(answer.effects) + len(answer.rig_data)

    return again is not None and names(again) + len(sensors) < names(first) and all(
        name in again.signals and again.signals[name].after_rms <= (
            one.after_rms + POLICY.worse * one.signal_rms)
        for name, one in first.signals.items())


def contradicted(first: Diagnosis, found: Diagnosis, rig: Rig) -> tuple[Gate, ...]:
    """Return the gate of a filter's answer in which a number of the force is not least squares'.

    Only where these name an effect of the force: they have what the filter's laws may lack (a law
    of another form, an unknown force of each moment), and need no start.  A filter that is sure of
    another B has found a family of numbers that make up for one another, such as scales of sensors
    in the place of a load.
    """
    if first.verdict != "mismatch" or found.verdict != "mismatch":
        return ()
    mine, theirs = _of_the_force(first), {"dM": _added_mass(found, rig)} | _of_the_force(found)
    # A filter names what is there beside the config's own effects, least squares the whole.
    for name in found.config_effects.keys() - {one.name for one in found.effects}:
        if name in CATALOGUE and CATALOGUE[name].balance == "force":
            for symbol, value in found.config_effects[name].items():
                if symbol in theirs:
                    theirs[symbol] = replace(theirs[symbol], value=theirs[symbol].value + value)
    if not mine.keys() - {"B"}:  # what goes with speed may be damping of another form
        return ()
    gates = []
    for symbol in sorted(mine.keys() & theirs.keys()):
        a, b = theirs[symbol], mine[symbol]
        if abs(a.value - b.value) > POLICY.varied * np.hypot(a.stddev, b.stddev):
            gates.append(Gate("least_squares", symbol, (
                f"with {listed([effect_words(one.name) for one in found.effects])} the filter's "
                f"{symbol} is {with_uncertainty(a.value, a.stddev, a.unit)}, that of "
                "least squares on the force balance "
                f"{with_uncertainty(b.value, b.stddev, b.unit)}, and its laws leave no less of "
                "the force on unseen data")))
    return tuple(gates)


def _added_mass(answer: Diagnosis, rig: Rig) -> Value:
    """Return by how much the mass that an answer states is beyond the config's, kg."""
    for one in (*answer.rig_data, *answer.rig_within):
        if one.key == "mass":
            return replace(one.found, value=one.found.value - one.configured)
    return Value(0.0, rig.tolerance.mass * rig.mass, "kg")


def _of_the_force(answer: Diagnosis) -> dict[str, Value]:
    """Return the numbers of the force balance that an answer states: B, and sizes of effects."""
    found = {"B": answer.after["B"]} if "B" in answer.after else {}
    for effect in answer.effects:
        if effect.balance == "force" and effect.name in CATALOGUE:
            found |= {one.name: effect.parameters[one.name] for one in CATALOGUE[effect.name].sizes
                      if one.name in effect.parameters and np.isfinite(one.neutral)}
    return found
