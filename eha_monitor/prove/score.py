"""Marks of a trial: what was concealed against what was said.  docs/proof.md defines each mark.

Of the rig's numbers a pair such as ``area_1``, ``area_2`` is one here (``area``): the plant is
symmetric.  Calibration: what was stated with 90 % has to be so in 90 %.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from statistics import median

import numpy as np

OFF = 2.99  # tolerances from which a number has to be named: 3, less the rounding of the config
NEAR = 2.0  # tolerances below which it must not be named; between the two it may be
# Where a wrong number shows first.
BALANCES = {
    "mass": {"force"}, "area": {"force", "flow"}, "volume": {"flow"}, "leakage": {"flow"},
    "makeup_conductance": {"flow"}, "charge_pressure": {"flow"}, "pump_displacement": {"flow"},
    "position_gain": {"drive"},
}


def number_of(key: str) -> str:
    """Return the number that a key of the config states: ``area`` for ``area_1``."""
    return key.removesuffix("_1").removesuffix("_2")


def errors_of(truth: dict) -> dict[str, float]:
    """Return number -> tolerances by which the config is off, without sign."""
    found: dict[str, float] = {}
    for one in truth.get("rig_off", ()):
        name = number_of(one["key"])
        found[name] = max(found.get(name, 0.0), abs(one["tolerances"]))
    return found


def kind_of(errors: dict[str, float]) -> str:
    """Return ``exact``, ``within`` or ``beyond``: what the config says of the rig."""
    if not errors:
        return "exact"
    return "beyond" if max(errors.values()) >= OFF else "within"


def keys_off(truth: dict) -> list[str]:
    """Return the config's keys that have to be named."""
    return [one["key"] for one in truth.get("rig_off", ()) if abs(one["tolerances"]) >= OFF]


def findings_of(answer: dict) -> list[dict]:
    """Return what an answer says of rig numbers, one entry a number, the surest of a pair.

    ``rivals`` : numbers and effects that it declares, each once.
    """
    found: dict[str, dict] = {}
    for one in answer.get("rig_data", ()):
        name = number_of(one["key"])
        sure = one.get("probability") or 0.0
        if name not in found or sure > found[name]["sure"]:
            rivals = dict.fromkeys(map(number_of, one.get("indistinguishable_from", ())))
            found[name] = {**one, "number": name, "sure": sure,
                           "rivals": tuple(other for other in rivals if other != name)}
    return list(found.values())


BINS = 10  # of stated probabilities, of equal width, from 0 to 1


def wilson(share: np.ndarray | float, n: np.ndarray | int) -> tuple:
    """Return the ends of Wilson's 68 % interval of shares of n cases, the share inside."""
    middle = (share + 0.5 / n) / (1.0 + 1.0 / n)
    half = np.sqrt(share * (1.0 - share) / n + 0.25 / n**2) / (1.0 + 1.0 / n)
    return np.minimum(middle - half, share), np.maximum(middle + half, share)


def statements_of(answer: dict, findings: Iterable[dict], paired: Collection[str],
                  consistent: bool | None, unexplained: bool | None) -> list[dict]:
    """Return all statements of an answer with a probability of which somebody knows the truth.

    Each is ``of`` an effect, a number of the rig, ``consistent`` or ``unexplained``.

    ``findings`` : what it says of rig numbers;  ``paired`` : names that stand for something that
    is there;  ``consistent``, ``unexplained`` : whether these are so, None where nobody knows.
    """
    stated = answer.get("probability") or {}
    names = [(one["name"], one) for one in answer["effects"]] + [
        (one["number"], one) for one in findings]
    every = [("consistent", stated.get("consistent"), consistent),
             ("unexplained", stated.get("unexplained"), unexplained),
             *((name, one.get("probability"), name in paired) for name, one in names)]
    return [{"of": of, "said": float(said), "right": bool(right)} for of, said, right in every
            if right is not None and isinstance(said, int | float) and 0.0 <= said <= 1.0]


def reliability_of(statements: Sequence[dict]) -> list[dict]:
    """Return the bins that hold statements: their edges, ``n``, mean said and share right."""
    bins: dict[int, list[dict]] = {}
    for one in statements:
        bins.setdefault(min(int(one["said"] * BINS), BINS - 1), []).append(one)
    return [{"low": place / BINS, "high": (place + 1) / BINS, "n": len(mine),
             "said": math.fsum(one["said"] for one in mine) / len(mine),
             "right": sum(one["right"] for one in mine) / len(mine)}
            for place, mine in sorted(bins.items())]


def calibration_error(bins: Sequence[dict]) -> float | None:
    """Return the expected calibration error: |said - right|, each bin by its statements."""
    count = sum(one["n"] for one in bins)
    if not count:
        return None
    return math.fsum(one["n"] * abs(one["said"] - one["right"]) for one in bins) / count


LARGEST_CLASS = 3  # members of a declared class: the name and at most two rivals
DETECTABLE = 20.0  # log units that an oracle gains within the tolerances: less need not be found
CLOSE, BASE_CLOSE, SIGMAS = 0.05, 0.02, 2.0
NOTABLE = 0.05  # of the error before: an oracle that takes away less says nothing of a removal
STRENGTHS = {"1": 0.55, "0.3": 0.12, "0.05": 0.0}  # name -> least strength of its bin
TIMING = ("drive_lag", "command_delay", "feedback_delay")
PLANT = ("force", "flow")
# One thing where the mean pressure stays; these effects move it.
SAME = ({"coulomb_friction", "pressure_friction"},)
MEAN_PRESSURE = {"external_leakage", "anti_cavitation", "entrained_air",
                 "position_dependent_volume", "sticking_check_valve"}
CONTAINED = {"stribeck_friction": ("coulomb_friction",),
             "asymmetric_friction": ("coulomb_friction",),
             "presliding_friction": ("coulomb_friction",)}
LEARNED_NEAR = 0.03  # of B and beta_e, beside a learned term
INSIDE = 0.9  # share of the places at which the true curve is in the band
# What was concealed -> signals that it is a function of, its true curve (None where the key does
# not hold all its numbers), names of its shape.
LAWS: dict[str, tuple[tuple[str, ...], Callable[[float, dict], float] | None, tuple[str, ...]]] = {
    "position_friction_hump": (("x", "v"), lambda x, p: p["F"] * math.exp(
        -(((x - p["x"]) / p["width"]) ** 2)), ("a bump", "a bump on a constant")),
    "position_dependent_leak": (("x", "dp"), lambda x, p: -p["L"] * math.exp(
        -(((x - p["x"]) / p["width"]) ** 2)), ("a bump", "a bump on a constant")),
    "lever_load": (("x",), lambda x, p: p["F"] * math.sin(2.0 * math.pi * x / p["length"]),
                   ("a sine",)),
    "end_cushion": (("x", "v"), lambda x, p: p["d"] * max(abs(x) - p["x"], 0.0),
                    ("a rise beyond",)),
    "pump_ripple": (("angle", "omega"), None, ("a ripple", "a ripple with its second harmonic")),
    "widening_gap": (("dp",), lambda dp, p: -p["L_3"] * dp**3, ("a cube",)),
}
# Mark -> words, aim as text, aim as a number, whether more is better.
MARKS = {
    "exact": ("named exactly, with nothing added", "", None, True),
    "within_class": ("named exactly or by a declared class of at most three", "", None, True),
    "detectable_within_class": ("the same, where an oracle gains 20 log units on every effect",
                                "at least 95 %", 0.95, True),
    "located": ("right balance", "at least 98 %", 0.98, True),
    "null_false_alarm": ("false alarm on clean recordings", "at most 0.5 %", 0.005, False),
    "sensor_blamed_on_physics": ("sensor or timing blamed on the plant", "never", 0.0, False),
    "outside_unexplained": ("outside the catalogue: unexplained, in the right place",
                            "at least 90 %", 0.9, True),
    "outside_confident_wrong": ("outside the catalogue: a wrong name", "at most 2 %", 0.02, False),
    "held_out_error_removed": ("removable error on unseen data removed", "at least 90 %", 0.9,
                               True),
    "rig_found": ("rig numbers off by three tolerances, named", "at least 95 %", 0.95, True),
    "rig_false_name": ("rig number named within its tolerance", "at most 1 %", 0.01, False),
    "calibration_error": ("calibration error of the probabilities", "at most 5 %", 0.05, False),
    "named_parameters_within_5_percent": ("parameters of named effects within 5 %, where the "
                                          "config's numbers are right", "", None, True),
    "told_parameters_within_5_percent": ("of these, where two standard deviations are 5 % or less",
                                         "at least 95 %", 0.95, True),
    "base_parameters_within_2_percent": ("B and the bulk modulus within 2 %, where the config's "
                                         "numbers are right", "", None, True),
    "parameters_inside_2_sigma": ("parameters inside their ± two standard deviations",
                                  "at least 90 %", 0.9, True),
    "learned_told": ("outside: a term learned of it", "", None, True),
    "learned_removed": ("outside: error on unseen data removed by it, median", "at least 80 %",
                        0.8, True),
    "learned_worse": ("outside: worse on unseen data than the model before", "never", 0.0, False),
    "learned_B": ("outside: B within 3 % beside a learned term", "", None, True),
    "learned_beta_e": ("outside: bulk modulus within 3 % beside a learned term", "", None, True),
    "learned_inside": ("outside: true curve in the band at 90 % of the places, where the term is "
                       "of the right signals", "", None, True),
    "learned_shape": ("outside: signals and shape of the formula right", "at least 50 %", 0.5,
                      True),
}
NONE, UNEXPLAINED, FAILED = "none", "unexplained", "failed"


def row_of(truth: dict, answer: dict | None, oracle: dict | None = None,
           run: dict | None = None) -> dict:
    """Return the marks of one case.

    Parameters
    ----------
    truth : its entry in the key; ``beside`` holds what is true as well and need not be found.
    answer : JSON of ``diagnose``; None where it failed.
    oracle : what a fit reached that knows the effects, and of the rig what the config says.
    run : how the diagnosis ran: ``seconds``, ``error``.
    """
    answer = answer or {"verdict": FAILED, "effects": [], "location": {"balance": {}},
                        "fit": {"signals": {}}, "parameters": {"after": {}},
                        "message": (run or {}).get("error") or "no answer"}
    names, beside = [one["name"] for one in truth["effects"]], truth.get("beside", ())
    evidence = (oracle or {}).get("log_evidence", {})
    catalogued = [one["name"] for one in truth["effects"] if one["in_catalogue"]]
    outside = len(catalogued) < len(names)
    shown = outside and any(shows(truth.get("channels"), one["balance"])
                            for one in truth["effects"] if not one["in_catalogue"])
    known = [name for name in catalogued if not oracle or (evidence.get(name) or 0) >= DETECTABLE]
    errors_off, findings = errors_of(truth), findings_of(answer)
    off = [name for name, error in errors_off.items() if error >= OFF]
    loose = [name for name, error in errors_off.items() if NEAR <= error < OFF]
    rig_evidence = (oracle or {}).get("rig_evidence", {})
    rig_known = [name for name in off if not oracle or (rig_evidence.get(name) or 0) >= DETECTABLE]
    classes = {one["name"]: tuple(map(number_of, one["indistinguishable_from"]))
               for one in answer["effects"]}
    said = {**classes, **{one["number"]: one["rivals"] for one in findings}}
    accepted = {**{one["name"]: accepted_for(one, names, oracle)
                   for one in [*truth["effects"], *beside] if one["in_catalogue"]},
                **{name: {name} for name in (*off, *loose)}}
    pairs = matched(accepted, said)
    share = {name: value or 0.0 for name, value in answer["location"]["balance"].items()}
    located = max(share, key=share.get) if any(share.values()) else ""
    balances = {one["balance"] for one in truth["effects"]}.union(
        *(BALANCES[name] for name in off))
    verdict, null = answer["verdict"], not names and not off
    place_right, wanted = located in balances, {*names, *off}
    all_paired = verdict == "mismatch" and set(said) == set(pairs.values())
    if null:
        exact = within = (all_paired if said else verdict == "consistent")
    elif outside:
        right = verdict == UNEXPLAINED and place_right if shown else not said
        exact, within = right and not set(said) - wanted - set(loose), right
    else:
        exact = verdict == "mismatch" and wanted <= set(said) <= wanted | set(loose) | {
            one["name"] for one in beside}
        nothing = not known and not rig_known and not said
        within = nothing or (all_paired and {*known, *rig_known} <= set(pairs))
    # Without an oracle nobody knows whether this recording shows a wrong number of the rig; and
    # where something is there that cannot be detected, nobody knows what "consistent" is worth.
    detectable = bool(shown or known or (oracle and rig_known))
    consistent = False if detectable else True if null and not loose else None
    lost = [one for one in truth["effects"] if one["name"] not in pairs
            and (one["balance"] == "sensor" or one["name"] in TIMING)]
    blaming = [one["name"] for one in answer["effects"]
               if one["balance"] in PLANT and one["name"] not in pairs.values()]
    before, after = errors(answer["fit"]["signals"])
    _, reached = errors(oracle["signals"]) if oracle and (catalogued or off) else (None, None)
    return {
        "case": truth["case"], "truth": names, "named": list(classes), "located": located,
        "before_rms": before, "after_rms": after, "oracle_rms": reached,
        "kind": "outside" if outside else "rig" if off and not names else (
            "null", "single", "pair", "triple")[min(len(names), 3)],
        "verdict": verdict, "message": answer.get("message", ""),
        "classes": {name: list(rivals) for name, rivals in classes.items()},
        "pairs": pairs, "strength": {one["name"]: one["strength"] for one in truth["effects"]},
        "log_evidence": evidence, "expected": known,
        "detectable": shown if outside else None if off and not oracle else not null and (
            len(known) == len(catalogued) and len(rig_known) == len(off)),
        "exact": exact, "within_class": within, "located_right": place_right,
        "sensor_or_timing": any(one["balance"] == "sensor" or one["name"] in TIMING
                                for one in truth["effects"]),
        "sensor_blamed": bool(lost and blaming), "confident_wrong":
            verdict == "mismatch" and bool(set(said) - set(pairs.values())),
        "removed": removed(before, after, reached),
        "parameters": parameter_errors(truth, answer, pairs) if exact and not null else [],
        "rig": kind_of(errors_off), "rig_truth": keys_off(truth),
        "rig_named": [one["key"] for one in answer.get("rig_data", ())],
        "learned": learned_row(truth, answer),
        "rig_off": off, "rig_expected": rig_known, "rig_evidence": rig_evidence,
        "rig_classes": {one["number"]: list(said[one["number"]]) for one in findings},
        # Within its tolerance, and not in the declared class of something that is there.
        "rig_false": [one["number"] for one in findings if one["number"] not in pairs.values()
                      and errors_off.get(one["number"], 0.0) < NEAR],
        "rig_errors": truth.get("rig_off", []),
        "probabilities": statements_of(answer, findings, pairs.values(), consistent, shown),
        "motion": truth.get("motion"), "noise": truth.get("noise"),
        "channels": truth.get("channels"),
        "wall_s": answer.get("wall_s"), "seconds": (run or {}).get("seconds"),
    }


def shows(channels: Sequence[str] | None, balance: str) -> bool:
    """Tell whether a balance can show in these channels: what moves the pump, or the force only.

    Position and pressures alone leave the force balance: what flows is measured at both ends.
    """
    return channels is None or bool({"x_d", "omega"} & set(channels)) or balance == "force"


def accepted_for(one: dict, names: Sequence[str], oracle: dict | None) -> set[str]:
    """Return the names that are right for a concealed effect, an entry of the key."""
    right, name = {one["name"], *one.get("class", ())}, one["name"]
    if not MEAN_PRESSURE & set(names):
        for group in SAME:
            right |= group if name in group else set()
    over = ((oracle or {}).get("over_simpler") or {}).get(name)
    if over is not None and over < DETECTABLE:  # the simpler one says as much
        right |= set(CONTAINED.get(name, ()))
    return right


def matched(accepted: dict[str, set[str]], classes: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """Return concealed effect -> named effect, each used once, as many as there can be.

    A name stands for a concealed effect if it is right for it, or if its declared class of at
    most three has a right one.
    """
    def stands(name: str, right: set[str]) -> bool:
        members = {name, *classes[name]}
        return name in right or (len(members) <= LARGEST_CLASS and bool(members & right))

    def best(todo: list[str], free: list[str]) -> dict[str, str]:
        if not todo:
            return {}
        first, rest = todo[0], todo[1:]
        found = [{first: name, **best(rest, [other for other in free if other != name])}
                 for name in sorted(free, key=lambda n: n != first)
                 if stands(name, accepted[first])]
        return max([*found, best(rest, free)], key=len)

    return best(list(accepted), list(classes))


def errors(signals: dict) -> tuple[float | None, float | None]:
    """Return the free-run errors before and after, in units of the sensors' noise.

    Root of the mean over the signals of (rms / noise) squared.
    """
    found = []
    for moment in ("before_rms", "after_rms"):
        squares = [(one[moment] / one["noise_rms"]) ** 2 for one in signals.values()
                   if one.get(moment) is not None and one.get("noise_rms")]
        found.append(math.sqrt(sum(squares) / len(squares)) if squares else None)
    return found[0], found[1]


def removed(before: float | None, after: float | None, reached: float | None) -> float | None:
    """Return the share of the removable held-out error that was removed, 0 to 1.

    Removable is what the oracle removes; without an oracle, all above the noise.
    """
    if before is None or after is None or not math.isfinite(before):
        return None
    floor = 1.0 if reached is None else reached
    if before - floor < NOTABLE * before:
        return None
    return min(max((before - after) / (before - floor), 0.0), 1.0)


def parameter_errors(truth: dict, answer: dict, pairs: dict[str, str]) -> list[dict]:
    """Return for each parameter of key and answer its error: relative, and in its own sigmas."""
    found = [compared(f"rig.{one['key']}", one["true"], said["found"], abs(one["true"]))
             for one in truth.get("rig_off", ()) for said in answer.get("rig_data", ())
             if said["key"] == one["key"] and said["found"]["value"] is not None]
    said = {one["name"]: one for one in answer["effects"]}
    for one in truth["effects"]:
        name = one["name"]
        if pairs.get(name) != name or name not in said:
            continue
        true = {symbol: value for symbol, value in one["parameters"].items()
                if isinstance(value, int | float)}
        for symbol, value in said[name]["parameters"].items():
            if symbol not in true or value["value"] is None:
                continue
            stem = symbol.split("_")[0]  # b_1, b_2: a sound sensor is judged by the other's error
            scale = max(abs(number) for other, number in true.items()
                        if other.split("_")[0] == stem)
            found.append(compared(f"{name}.{symbol}", true[symbol], value, scale))
    for name in ("B", "beta_e"):
        value = answer["parameters"]["after"].get(name)
        if value and value.get("value") is not None:
            found.append(compared(name, truth[name], value, abs(truth[name])))
    return found


def compared(name: str, true: float, said: dict, scale: float) -> dict:
    """Return one parameter's truth, answer and errors."""
    error, sigma = said["value"] - true, said.get("stddev") or 0.0
    return {"name": name, "true": true, "said": said["value"], "stddev": sigma,
            "relative": abs(error) / scale if scale else None,
            "sigmas": abs(error) / sigma if sigma > 0 else None}


def share(flags: Iterable[bool]) -> float | None:
    """Return the share of true ones, None of nothing."""
    flags = list(flags)
    return sum(map(bool, flags)) / len(flags) if flags else None


def score_of(rows: Sequence[dict]) -> dict:
    """Return the marks of all cases together; None where no case applies."""
    hidden = [row for row in rows if row["kind"] != "null"]
    locatable = [row for row in hidden if row["expected"] or row["rig_expected"] or (
        row["kind"] == "outside" and row["detectable"])]
    able = [row for row in hidden if row["detectable"] and row["kind"] != "outside"]
    outside = [row for row in rows if row["kind"] == "outside"]
    gone = [row["removed"] for row in hidden
            if row["kind"] != "outside" and row["removed"] is not None]
    return {
        "exact": share(row["exact"] for row in rows),
        "within_class": share(row["within_class"] for row in rows),
        "located": share(row["located_right"] for row in locatable),
        "null_false_alarm": share(not row["exact"] for row in rows if row["kind"] == "null"),
        "sensor_blamed_on_physics": share(row["sensor_blamed"] for row in rows
                                          if row["sensor_or_timing"]),
        "held_out_error_removed": sum(gone) / len(gone) if gone else None,
        "detectable_exact": share(row["exact"] for row in able),
        "detectable_within_class": share(row["within_class"] for row in able),
        "outside_unexplained": share(row["within_class"] for row in outside if row["detectable"]),
        "outside_confident_wrong": share(row["confident_wrong"] for row in outside),
        "rig_found": share(name in row["pairs"] for row in rows for name in row["rig_expected"]),
        "rig_false_name": share(bool(row["rig_false"]) for row in rows),
        "calibration_error": calibration_error(reliability(rows)),
        **parameter_score(rows),
        **learned_score(rows),
    }


def reliability(rows: Sequence[dict]) -> list[dict]:
    """Return the bins of the reliability diagram, over all statements of all answers."""
    return reliability_of([one for row in rows for one in row["probabilities"]])


def parameter_score(rows: Sequence[dict]) -> dict:
    """Return how many parameters of exactly named cases are close, and inside their 2 sigma.

    Close can only be required where the config's numbers are right: a volume that is 10 % off
    is 10 % of the bulk modulus.  Its standard deviation has to say so, so that is required of all.
    """
    every = [one for row in rows for one in row["parameters"]]
    known = [one for row in rows if row["rig"] == "exact" for one in row["parameters"]]
    base = [one for one in known if one["name"] in ("B", "beta_e")]
    own = [one for one in known if one["name"] not in ("B", "beta_e")]
    return {
        "named_parameters_within_5_percent": share(
            one["relative"] <= CLOSE for one in own if one["relative"] is not None),
        "told_parameters_within_5_percent": share(
            one["relative"] <= CLOSE for one in own if one["relative"] is not None
            and SIGMAS * one["stddev"] <= CLOSE * abs(one["said"])),
        "base_parameters_within_2_percent": share(
            one["relative"] <= BASE_CLOSE for one in base if one["relative"] is not None),
        "parameters_inside_2_sigma": share(
            one["sigmas"] <= SIGMAS for one in every if one["sigmas"] is not None),
    }


def bin_of(strength: float) -> str:
    """Return the strength's bin: 1, 0.3 or 0.05."""
    return next(name for name, least in STRENGTHS.items() if abs(strength) >= least)


def by_effect(rows: Sequence[dict]) -> dict[str, dict]:
    """Return for each concealed effect how often it was named, in sets as well as alone.

    ``exact`` counts its own name, ``within_class`` also its declared class; ``detectable`` those
    instances for which an oracle has enough evidence, ``found`` the share of them in the class.
    """
    found = {}
    for name in sorted({name for row in rows for name in row["truth"]}):
        mine = [row for row in rows if name in row["truth"]]
        able = [row for row in mine if name in row["expected"]]
        outside = not any(name in row["pairs"] or name in row["log_evidence"]
                          or name in row["expected"] for row in mine)
        found[name] = {
            "n": len(mine),
            "exact": share(row["exact"] if row["kind"] == "outside" else name in row["named"]
                           for row in mine),
            "within_class": share(row["within_class"] if row["kind"] == "outside"
                                  else name in row["pairs"] for row in mine),
            "detectable": len(able),
            "found": share(name in row["pairs"] for row in able),
            "outside": outside and all(row["kind"] == "outside" for row in mine),
        }
    return found


def by_group(rows: Sequence[dict], group) -> dict[str, dict]:
    """Return the main marks of the rows by what ``group(row)`` says."""
    names = dict.fromkeys(str(group(row)) for row in rows)
    found = {}
    for name in names:
        mine = [row for row in rows if str(group(row)) == name]
        able = [row for row in mine if row["detectable"]]
        found[name] = {"n": len(mine), "exact": share(row["exact"] for row in mine),
                       "within_class": share(row["within_class"] for row in mine),
                       "detectable": len(able),
                       "detectable_within_class": share(row["within_class"] for row in able)}
    return found


def confusion(rows: Sequence[dict]) -> dict[str, dict[str, int]]:
    """Return concealed effect -> what was said instead of it -> how often.

    A found effect counts under its own name, or under the name whose class has it.  One that was
    not found counts under each name that stands for nothing, else under ``unexplained`` or
    ``none``.  The row ``none`` holds what was named on clean recordings and beside complete sets.
    A rig number that is off is one of the concealed.
    """
    table: dict[str, Counter] = {}
    for row in rows:
        spare = [name for name in (*row["named"], *row["rig_classes"])
                 if name not in row["pairs"].values()]
        hidden = [*row["truth"], *row["rig_off"]]
        empty = {FAILED: FAILED, UNEXPLAINED: UNEXPLAINED}.get(row["verdict"], NONE)
        lost = [name for name in hidden if name not in row["pairs"]]
        for name in hidden:
            said = [row["pairs"][name]] if name in row["pairs"] else spare or [empty]
            table.setdefault(name, Counter()).update(said)
        if not lost:
            said = spare or ([empty] if not hidden else [])
            if said:
                table.setdefault(NONE, Counter()).update(said)
    return {name: dict(counts.most_common()) for name, counts in sorted(table.items())}


def learned_row(truth: dict, answer: dict) -> dict | None:
    """Return how a learned term compares with what was concealed; None where that has a name.

    ``told``, ``removed`` of the error on unseen data (0 without a term), ``errors`` relative of B
    and beta_e, ``inside`` the share of the places at which the true curve is in the band,
    ``shape`` whether the formula's is right; None where it does not apply.
    """
    outside = [one for one in truth["effects"] if not one["in_catalogue"]]
    if not outside:
        return None
    terms = answer.get("learned") or []
    if not terms:
        return {"told": False, "removed": 0.0, "errors": {}, "inside": None, "shape": False}
    term, after = terms[0], answer["parameters"]["after"]
    errors = {name: abs(after[name]["value"] / truth[name] - 1.0)
              for name in ("B", "beta_e") if name in after}
    of, law, shapes = LAWS.get(outside[0]["name"], ((), None, ()))
    inside = None
    found = tuple(term["of"]) == of and term["balance"] == outside[0]["balance"]
    if law is not None and found:
        parameters = outside[0]["parameters"]
        near = [abs(y - law(x, parameters)) <= SIGMAS * band
                for x, y, band in zip(term["x"], term["curve"], term["band"], strict=True)]
        inside = sum(near) / len(near)
    return {"told": True, "removed": term["held_out_error_removed"], "errors": errors,
            "inside": inside, "shape": found and term["shape"] in shapes}


def learned_score(rows: Sequence[dict]) -> dict[str, float | None]:
    """Return the marks of all cases with something outside the catalogue that shows."""
    mine = [row for row in rows if row.get("learned") and row["detectable"]]
    learned = [row["learned"] for row in mine if row["learned"]["told"]]
    return {
        "learned_told": share(row["learned"]["told"] for row in mine),
        "learned_removed": median(row["learned"]["removed"] for row in mine) if mine else None,
        "learned_worse": share(row["after_rms"] > 1.01 * row["before_rms"] for row in mine
                               if row["before_rms"] and row["after_rms"]),
        **{f"learned_{name}": share(one["errors"][name] <= LEARNED_NEAR for one in learned
                                    if name in one["errors"]) for name in ("B", "beta_e")},
        "learned_inside": share(one["inside"] >= INSIDE for one in learned
                                if one["inside"] is not None),
        "learned_shape": share(row["learned"]["shape"] for row in mine),
    }
