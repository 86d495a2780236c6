"""The effects of a draft: its load, its valves, friction and drive, volumes that change with x."""

from math import sin

from eha_monitor.draft.answers import Answers, flow_at
from eha_monitor.draft.rig import Entry, Seen, number, value_of, zero_of
from eha_monitor.errors import InputError
from eha_monitor.quantity import quantity
from eha_monitor.settings.rig import Rig

GRAVITY = 9.81  # m/s²


def effects_of(answers: Answers, entries: list[Entry], seen: Seen) -> list[Entry]:
    """Return the lines of ``effects``: load, valves, friction, drive, volumes that change with x.

    F = A1 p1 - A2 p2 is of absolute pressures, so what the open air does to the rod's own end,
    p_a (A1 - A2) against growing x, is a load, whatever zero the sensors have.

    Raises
    ------
    InputError
        If the load is one that a rotary actuator has not, or valves or volumes contradict
        themselves.
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
    weight = (of["mass"] * GRAVITY * sin(slope)
              if load == "gravity" and slope is not None and "mass" in answers.rig else 0.0)
    air = 0.0 if turns else _open_air(answers, of["area_1"], of["area_2"])
    if weight or air:
        words = [f"weight of the mass at {answers.rig['inclination']}"] if weight else []
        words += [f"what the open air does to the rod's end, p_a (A1 - A2) = {air:.4g} N"
                  ] if air else []
        found.append(Entry("constant_load", f"{{F_0: {number(weight + air)}}}",
                           f"answered: {' and '.join(words)}, N against growing x"))
    if load == "spring" and spring:
        rest = (answers.number("spring_rest") or 0.0) - (
            (answers.middle() or 0.0) if "spring_rest" in answers.rig else 0.0)
        found.append(Entry("spring_load", f"{{k: {number(spring)}, x_0: {number(rest)}}}",
                           f"answered: {answers.rig['spring']}, relaxed at "
                           f"{answers.rig.get('spring_rest', 'x = 0')}"))
    charge = next(entry for entry in entries if entry.key == "charge_pressure")
    found += _parts(answers, None if charge.ask else value_of(charge, answers))
    zero, who = zero_of(answers, seen)
    shrinking = of["volume_1" if zero == "extended" else "volume_2"]
    if zero != "middle" and shrinking and of["area_1"] and not answers.lacks("volume_1"):
        reach = max(map(abs, seen.span)) if seen.span else answers.number("stroke") or 1.0
        ratio = (of["area_2"] or of["area_1"]) / of["area_1"]
        shrinks = 1.0 if zero == "extended" else ratio  # of A_v, how fast that chamber does
        taken, key = of["area_1"] * shrinks * reach, "volume_1" if zero == "extended" else (
            "volume_2")
        if seen.span and key in answers.rig and shrinking < taken:
            raise InputError(
                f"--set {key}={answers.rig[key]}: expected more than the "
                f"{quantity(taken, 'm³', 3)} that the piston takes of it up to x = "
                f"{quantity(reach, 'm', 3)}; volumes are those at x = 0: are volume_1 and "
                "volume_2 exchanged, or does x = 0 lie elsewhere?")
        slope = min(of["area_1"], 0.98 * shrinking / (reach * shrinks))  # some oil is left
        own = "" if ratio == 1.0 else f", r: {number(ratio)}"
        found.append(Entry("position_dependent_volume", f"{{A_v: {number(slope)}{own}}}",
                           f"{who}: x = 0 is at an end; the volumes above hold there and change "
                           "with x"))
    return found


def _open_air(answers: Answers, area_1: float | None, area_2: float | None) -> float:
    """Return p_a (A1 - A2), N; nothing where an area is not known."""
    if not area_1 or not area_2:
        return 0.0
    ambient = answers.number("ambient_pressure")
    return (Rig.model_fields["ambient_pressure"].default if ambient is None else ambient) * (
        area_1 - area_2)


def _parts(answers: Answers, charge: float | None) -> list[Entry]:
    """Return the valves, dry friction and lag of the drive that a data sheet has.

    ``charge`` : pressure of the make-up source, Pa; None where nobody knows it.
    """
    found = []

    def told(key: str) -> bool:
        return key in answers.rig and not answers.none(key)

    if told("check_valve") and charge is not None:
        opens = answers.number("check_valve_opens") or 0.0
        flow, drop = flow_at("check_valve", answers.rig["check_valve"])
        if not drop > opens:
            raise InputError(f"--set check_valve={answers.rig['check_valve']}: expected more than "
                             "the pressure at which it opens, check_valve_opens="
                             f"'{answers.rig['check_valve_opens']}'")
        k, low = number(flow / (drop - opens)), number(charge - opens)
        found.append(Entry("anti_cavitation", f"{{k: {k}, p_min: {low}}}",
                           f"answered: check valves, {answers.rig['check_valve']}, open "
                           f"{answers.rig.get('check_valve_opens', '0 bar')} below the charge "
                           "pressure"))
    if told("relief_valve") and told("relief_pressure"):
        found.append(Entry("relief_valve", f"{{k: {number(answers.number('relief_valve'))}, p_c: "
                           f"{number(answers.number('relief_pressure'))}}}",
                           f"answered: {answers.rig['relief_valve']} beyond "
                           f"{answers.rig['relief_pressure']} between the chambers"))
    if told("friction"):
        found.append(Entry("coulomb_friction", f"{{F_c: {number(answers.number('friction'))}}}",
                           f"answered: {answers.rig['friction']}"))
    if told("drive_lag"):
        found.append(Entry("drive_lag", f"{{tau: {number(answers.number('drive_lag'))}}}",
                           f"answered: {answers.rig['drive_lag']}"))
    return found
