"""An experiment in words, and as the plain data of JSON."""

import math

from eha_monitor.identify.bounds import NEEDED
from eha_monitor.identify.experiment import ABORTED, DECIDED, INSEPARABLE, TIME, Round
from eha_monitor.identify.plan import Planned
from eha_monitor.mismatch.advise.motions import excitation_tree
from eha_monitor.mismatch.advise.words import motion_sentence
from eha_monitor.mismatch.name.naming import Names
from eha_monitor.quantity import number
from eha_monitor.settings.experiment import Experiment as Bounds
from eha_monitor.words import effect_words, listed

SCHEMA = "eha_monitor/identify/1"


def set_words(names: Names) -> str:
    """Return a set of effects and numbers of the rig: ``Coulomb friction and another mass``."""
    return listed([f"another {effect_words(name.removeprefix('rig.'))}"
                   if name.startswith("rig.") else effect_words(name)
                   for name in sorted(names)]) or "nothing beyond the config"


def percent(probability: float) -> str:
    """Return a probability in per cent, never quite 0 or 100."""
    if not math.isfinite(probability):
        return "—"
    return f"{min(max(100.0 * probability, 0.1), 99.9):.1f} %"


def plan_words(planned: Planned, dt: float) -> str:
    """Return what is to be moved, and why."""
    text = (f"{motion_sentence(planned.motion)} ({number(len(planned.x_d) * dt, 3)} s with the "
            "way to it)")
    if planned.pair is not None:
        one, other = map(set_words, planned.pair)
        text += f", to distinguish {one} from {other} ({number(planned.log_units, 2)} log units)"
    return (f"{text}; the right set is expected to have {percent(planned.expected)} after it, "
            f"now {percent(planned.now)}")


def round_words(one: Round, count: int, dt: float) -> str:
    """Return what stands after a motion, with which probability, and what is next and why."""
    what = one.planned.motion.words.replace("the speed of this recording", "full speed")
    head = f"motion {count}, {what}, {number(one.seconds, 3)} s so far: "
    if one.end == ABORTED:
        return f"{head}aborted: {one.ran.aborted}; the position demanded last is held"
    if one.diagnosis is not None and one.diagnosis.verdict == "unexplained":
        head += "something that is not in the catalogue"
    else:
        head += f"{set_words(one.names)}, {percent(one.probability)}"
    if one.rivals:
        head += "; else " + ", ".join(f"{set_words(names)} {percent(value)}"
                                      for names, value in list(one.rivals.items())[:3])
    if one.end == DECIDED:
        return f"{head}. Decided"
    if one.end == TIME:
        return f"{head}. The time is up: no motion fits into what is left of it"
    if one.end == INSEPARABLE:
        more = f"; what would: {'; '.join(one.would)}" if one.would else ""
        return f"{head}. No motion within the limits distinguishes what is left{more}"
    return f"{head}. Next: {plan_words(one.following, dt)}"


def planned_tree(planned: Planned, dt: float) -> dict:
    """Return a planned motion as plain data."""
    return {"name": planned.motion.name, "words": motion_sentence(planned.motion),
            "duration_s": len(planned.x_d) * dt, "excitation": excitation_tree(planned.motion),
            "expected_probability": planned.expected, "probability_now": planned.now,
            "between": None if planned.pair is None else [sorted(one) for one in planned.pair],
            "log_units": planned.log_units,
            "predicted": {key: -value if key == "lower" else value
                          for key, value in planned.peaks.items()}}


def tree(rounds: list[Round], bags: list[str], bounds: Bounds, wanted: float, dt: float
         ) -> dict:
    """Return an experiment as plain data, without its diagnosis."""
    last = rounds[-1]
    return {
        "schema": SCHEMA, "end": last.end, "aborted": last.ran.aborted, "bags": bags,
        "names": sorted(last.names), "probability": last.probability, "wanted": wanted,
        "motion_s": last.seconds, "would": last.would,
        "limits": {key: getattr(bounds, key) for key in (*NEEDED, "motion_time", "total_time")},
        "rounds": [{"motion": planned_tree(one.planned, dt), "seconds": one.seconds,
                    "aborted": one.ran.aborted,
                    "verdict": one.diagnosis and one.diagnosis.verdict,
                    "names": sorted(one.names), "probability": one.probability,
                    "rivals": [{"names": sorted(names), "probability": value}
                               for names, value in one.rivals.items()]} for one in rounds]}
