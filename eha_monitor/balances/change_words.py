"""How the numbers of a machine that have changed are said: records, sentences, what to do next."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from eha_monitor.balances.advice import least_change
from eha_monitor.balances.candidates import Candidate
from eha_monitor.balances.course import Course
from eha_monitor.balances.judged import Judged, JudgedBalance, Moved
from eha_monitor.balances.machine import Machine
from eha_monitor.balances.oil import Stiffness
from eha_monitor.balances.policy import POLICY
from eha_monitor.mismatch.diagnosis import Change, Value
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import number, share, with_uncertainty
from eha_monitor.settings.monitor import Settings
from eha_monitor.words import effect_words, listed

SHARED = 0.9  # of the deviations of both: the difference is known better, so it is told too
FASTER = 1.2  # times the references' speed: beyond it nothing is known of the machine
WHAT = {"B": "B", "C_h": "beta_e", "D_p": "pump_displacement"}
EFFECTS = {"viscous_damping": "B", "compliance": "beta_e"}
WORDS = {"B": "viscous damping B", "C_h": "the effective bulk modulus",
         "D_p": "the pump's displacement", "L": "leakage across the piston"}


def change_of(moved: Moved, machine: Machine, settings: Settings, stiffness: Stiffness) -> Change:
    """Return the record of a number that has changed."""
    c = moved.candidate
    # What moves a number in both alike, all else held, says nothing of how large it is.
    own = next((p.stddev for one in machine.balances for p in one.parameters
                if p.name == c.name and abs(p.value - moved.machine) < moved.spread), 0.0)
    healthy, now, unit = _in_words(replace(
        moved, spread=max(moved.spread, own), stddev=max(moved.stddev, own)), settings, (
            machine.stiffness, stiffness))
    what, name = WHAT.get(c.name, c.effect), effect_words(c.effect)
    words = WORDS.get(c.name) or (name if c.words in name else f"{name} ({c.words})")
    if c.name == "C_h" and unit == c.unit:  # of nothing no modulus can be said
        what, words = c.effect, "the compliance of a chamber"
    symbol = "" if c.name in WHAT else c.symbol or c.name
    runs, more = machine.runs, moved.here - moved.machine
    by = "" if unit != c.unit or not moved.apart < SHARED * np.hypot(
            now.stddev, healthy.stddev) else (
        f", {with_uncertainty(abs(more), moved.apart, unit)} {'more' if more > 0.0 else 'less'}")
    return Change(what, symbol, c.balance, healthy, now, unit, (
        f"{words} is {with_uncertainty(now.value, now.stddev, unit)}, where {runs} have "
        f"{with_uncertainty(healthy.value, healthy.stddev, unit)}{moved.given}{by}"),
        tuple(EFFECTS.get(one, one) for one in moved.rivals))


def beyond_config(c: Candidate) -> float:
    """Return what the config has of a mass or a gain, which are told as what is beyond it."""
    return c.configured if c.name in ("dM", "k_d") else 0.0


def _in_words(moved: Moved, settings: Settings, oils: tuple[Stiffness, Stiffness]
              ) -> tuple[Value, Value, str]:
    """Return the machine's value, that of the recording, and the unit: beta_e of a compliance.

    What the config holds of the effect is in both.

    Parameters
    ----------
    oils : what the oil of the machine and of the recordings is by itself.
    """
    rig, c = settings.rig, moved.candidate
    held = c.configured - beyond_config(c)
    pair = (moved.machine + held, moved.spread), (moved.here + held, moved.stddev)
    if c.sign > 0:  # what cannot be negative and is so by chance is nil
        pair = tuple((max(value, 0.0) if POLICY.varied * stddev > -value else value, stddev)
                     for value, stddev in pair)
    known = [one.modulus for one in oils]
    if c.name == "C_h" and all(POLICY.sure(*one) for one in known):
        return Value(*known[0], "Pa"), Value(*known[1], "Pa"), "Pa"
    if c.name == "C_h" and rig.volume_1 and POLICY.sure(*known[0]):
        # The machine's compliance is in several terms; what has changed stands beside all of it.
        softer = oils[0].value + (moved.here - moved.machine) / rig.volume_1
        if softer > 0.0:
            return (Value(*known[0], "Pa"),
                    Value(1.0 / softer, moved.stddev / rig.volume_1 / softer**2, "Pa"), "Pa")
    if c.name == "C_h" and rig.volume_1 and min(moved.machine, moved.here) > 0.0 and all(
            POLICY.sure(*one) for one in pair):
        pair = tuple((rig.volume_1 / value, rig.volume_1 / value**2 * stddev)
                     for value, stddev in pair)
        return Value(*pair[0], "Pa"), Value(*pair[1], "Pa"), "Pa"
    return Value(*pair[0], c.unit), Value(*pair[1], c.unit), c.unit


def in_share(moved: Moved, change: Change) -> str:
    """Return the statement of a number that differs a little: by which share of the healthy one.

    And what else explains it as well.
    """
    healthy, by = change.reference, ""
    whole = healthy.value + beyond_config(moved.candidate)
    if change.unit == moved.candidate.unit and POLICY.sure(whole, healthy.stddev):
        more = (change.now.value - healthy.value) / abs(whole)
        doubt = np.hypot(moved.apart, more * healthy.stddev) / abs(whole)
        if abs(more) < 1.0:  # of a correction that is nearly nil, 320 % say nothing
            by = (f", {'+' if more > 0.0 else ''}"
                  f"{with_uncertainty(100.0 * more, 100.0 * doubt, '%')}")
    elif change.unit == "Pa" and POLICY.sure(healthy.value, healthy.stddev):
        ratio = change.now.value / healthy.value
        by = f", {'+' if ratio > 1.0 else ''}" + with_uncertainty(
            100.0 * (ratio - 1.0), 100.0 * ratio * np.hypot(
                change.now.stddev / change.now.value, healthy.stddev / healthy.value), "%")
    rivals = [effect_words(name) for name in change.indistinguishable_from]
    return change.statement + by + (
        f" ({listed(rivals, 'or')} would explain it as well)" if rivals else "")


def message_of(verdict: str, changes: Sequence[Change], judged: Judged, runs: str,
             small: Sequence[str], nearest: Sequence[str]) -> str:
    """Return the answer in a sentence: what changed, what did too little to matter, or nothing.

    Parameters
    ----------
    small : statements of what surely differs but is too small to matter; beside a change nobody
        needs them.
    nearest : those of what fits best and explains nothing.
    """
    if changes:
        said = "; ".join(one.statement + _or_a_sensor(one) for one in changes)
        return "; ".join([said, *(
            f"what has come as well is {one.curve.term.sentence}" if one.curve is not None else
            f"{_left(one)}: something else has changed as well" for one in judged.balances
            if one.curve is not None or one.foreign or not one.settled)])
    if verdict == "consistent" and small:
        return f"what differs is too small to be called a change: {'; '.join(small)}"
    if verdict == "consistent":
        largest = max((one.largest for one in judged.balances if one.largest is not None),
                      key=lambda one: abs(one.deviations) / one.limit, default=None)
        most = "" if largest is None else (
            f": the largest difference is {effect_words(largest.candidate.effect)}, by "
            f"{number(abs(largest.deviations), 2)} of their standard deviations; the limit is "
            f"{number(largest.limit, 2)}" + (
                f", but it explains too little of the {largest.candidate.balance} to be called a "
                "change" if abs(largest.deviations) > largest.limit else ""))
        return f"nothing has changed from {runs}{most}"
    said = [_left(one) for one in judged.loud if one.curve is None]
    said += [f"what has come is {one.curve.term.sentence}"
             for one in judged.balances if one.curve is not None]
    said += [f"the nearest, which does not explain it, is that {one}" for one in nearest]
    same = [one.balance for one in judged.balances if one not in judged.loud
            and one.complete and not one.changed]
    stands = (f"the {listed(same)} {'is' if len(same) == 1 else 'are'} as in {runs}; "
              if judged.loud and same else "")
    return f"{stands}what has changed is not one of the numbers that the machine has" + (
        f"; {'; '.join(said)}" if said else "")


def _left(one: JudgedBalance) -> str:
    """Return how much is left of a balance that no numbers of the machine's terms describe."""
    if not one.foreign:
        return (f"{one.balance}: {share(one.error, 2)} of it unexplained, at most "
                f"{share(one.usual, 2)} in the healthy recordings")
    return (f"{one.balance}: the machine's terms fitted anew leave {number(one.alone, 2)} times "
            "what they leave of any healthy recording")


def _or_a_sensor(change: Change) -> str:
    """Return which sensor's error would read like a change: a pump does not grow by wear."""
    sensors = [effect_words(name) for name in change.indistinguishable_from
               if name in CATALOGUE and CATALOGUE[name].balance == "sensor"]
    if change.balance == "sensor" or not sensors or any(
            name in change.statement for name in sensors):
        return ""
    return f" ({listed(sensors, 'or')}, a sensor's error, would read the same)"


def advice_beside(machine: Machine, courses: Sequence[Course], references: tuple[str, ...],
            verdict: str, outside: float) -> tuple[str, ...]:
    """Return what to know of the references, and what to do next.

    Parameters
    ----------
    outside : share of the motion beyond the references' stroke.
    """
    found = []
    if machine.pieces:
        few = "one reference recording is" if len(references) == 1 else (
            f"{len(references)} reference recordings are")
        found.append(f"{few} too few to estimate how recordings differ; parts of them were "
                     "compared instead, so a normal difference between recordings may be reported "
                     "as a change")
    found += [f"{one.source} differs from the other references more than a healthy recording "
              f"should ({one.why}): check whether it belongs to them"
              for one in machine.odd if not machine.pieces]
    if outside > machine.policy.worse:
        found.append(f"{share(outside, 2)} of its motion is where no reference has been, and not "
                     "compared")
    known = machine.scale.fastest or machine.scale.speed
    if max(course.speed for course in courses) > FASTER * known:
        found.append("it moves faster than the references; above their speed nothing can be "
                     "compared")
    if verdict == "consistent" and (shows := least_change(machine)):
        found.append(shows)
    return tuple(found)
