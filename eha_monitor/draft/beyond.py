"""What a draft has beyond the rig's numbers: effects, tolerances, choices still to be made."""

from math import sin

from eha_monitor.draft.answers import Answers
from eha_monitor.draft.rig import Entry, Seen, no_such_zero, number, value_of, zero_of
from eha_monitor.errors import InputError

GRAVITY = 9.81  # m/s²
# Key -> tolerance where it was answered, where it follows from other numbers or the recording,
# where nobody knows it and the paper's stands in its place.
_TOLERANCES = {"area_1": (0.005, 0.01, 0.0), "area_2": (0.005, 0.01, 0.0),
               "volume_1": (0.05, 0.1, 0.3), "volume_2": (0.05, 0.1, 0.3),
               "mass": (0.05, 0.1, 0.5), "pump_displacement": (0.03, 0.03, 0.0),
               "position_gain": (0.03, 0.01, 0.0), "charge_pressure": (0.2, 0.1, 0.5),
               "leakage": (3.0, 3.0, 10.0), "makeup_conductance": (3.0, 3.0, 10.0)}
_FACTORS = ("leakage", "makeup_conductance")
QUESTIONS = {
    "machine": "machine: double_rod (pump-controlled), two_pumps or accumulator (single rod), "
               "valve (cylinder behind a valve), force (axis with a measured force or torque)",
    "load": "load on the rod beside mass and friction: none, gravity, spring, or unknown (a "
            "linkage, a process)",
    "inclination": "inclination of the axis, such as 20 deg, positive if growing x lifts the load",
    "spring": "stiffness of the spring, such as 8000 N/m",
    "spring_rest": "position at which the spring is relaxed, such as 0 mm",
    "zero": "x = 0 of the position lies at the middle of the stroke, or at the end with the rod "
            "retracted or extended; or what x reads in the middle, such as 137 mm",
    "pressures": "pressures are absolute or gauge (0 bar in the open air); absolute until told",
}


def effects_of(answers: Answers, entries: list[Entry], seen: Seen) -> list[Entry]:
    """Return the lines of ``effects``: the load that was answered, volumes that change with x.

    Raises
    ------
    InputError
        If the load is one that a rotary actuator has not.
    """
    turns = any(entry.key == "motion" and entry.value == "rotary" for entry in entries)
    if turns and answers.rig.get("load") == "gravity":
        raise InputError("--set load=gravity: expected none, spring or unknown of a rotary "
                         "actuator, since the torque of a weight changes with the angle; unknown "
                         "lets diagnose identify it")
    found, of = [], {entry.key: value_of(entry, answers) for entry in entries
                     if entry.key in ("area_1", "area_2", "volume_1", "volume_2", "mass")}
    load, slope, spring = (answers.rig.get("load"), answers.number("inclination"),
                           answers.number("spring"))
    if load == "gravity" and slope is not None:
        weight = of["mass"] * GRAVITY * sin(slope)
        found.append(Entry("constant_load", f"{{F_0: {number(weight)}}}", "answered: weight of "
                           f"the mass at {answers.rig['inclination']}, N against growing x"))
    if load == "spring" and spring:
        rest = answers.number("spring_rest") or 0.0
        found.append(Entry("spring_load", f"{{k: {number(spring)}, x_0: {number(rest)}}}",
                           f"answered: {answers.rig['spring']}, relaxed at "
                           f"{answers.rig.get('spring_rest', 'x = 0')}"))
    zero, who = zero_of(answers, seen)
    shrinking = of["volume_1" if zero == "extended" else "volume_2"]
    if zero != "middle" and shrinking and of["area_1"] and not answers.lacks("volume_1"):
        # One area for both chambers; of a single rod the mean, as long as oil is left at the end.
        reach = max(map(abs, seen.span)) if seen.span else answers.number("stroke") or 1.0
        slope = min(0.5 * (of["area_1"] + of["area_2"]), 0.8 * shrinking / reach)
        found.append(Entry("position_dependent_volume", f"{{A_v: {number(slope)}}}", f"{who}: x = "
                           "0 is at an end; the volumes above hold there and change with x"))
    return found


def tolerances(entries: list[Entry]) -> list[Entry]:
    """Return the lines of ``rig.tolerance``: how far off each may be, by its source."""
    found = []
    for entry in entries:
        if entry.key not in _TOLERANCES or entry.value == "null" or "not used" in entry.why:
            continue
        of = (2 if entry.ask else 0 if entry.why == "answered" else 1)
        words = ("data sheet", "computed or seen", "nobody has told it")[of]
        unit = "a factor" if entry.key in _FACTORS else "relative"
        found.append(Entry(entry.key, number(_TOLERANCES[entry.key][of]), f"{unit}; {words}"))
    return found


def open_choices(answers: Answers, entries: list[Entry], seen: Seen, gauge_known: bool
                 ) -> list[tuple[str, str]]:
    """Return key and question of each choice that neither a person nor the recording has made."""
    told = answers.rig
    asked = [key for key in ("machine", "load") if key not in told]
    asked += [key for load, key in (("gravity", "inclination"), ("spring", "spring"))
              if told.get("load") == load and key not in told]
    if "stroke" in told and not ("volume_1" in told and "volume_2" in told) and (
            not zero_of(answers, seen)[1]):
        asked.append("zero")
    if "pressures" not in told and not gauge_known:
        asked.append("pressures")
    found = [(key, QUESTIONS[key]) for key in asked if not answers.lacks(key)]
    turns = any(entry.key == "motion" and entry.value == "rotary" for entry in entries)
    outside = "" if answers.lacks("zero") else no_such_zero(answers, seen, turns)
    return [*(one for one in found if one[0] != "zero"), ("zero", outside)] if outside else found
