"""What ``diagnose`` answers: the JSON of the contract, and the config with the named physics."""

import math
from pathlib import Path
from textwrap import wrap

from eha_monitor import __version__
from eha_monitor.mismatch.diagnosis import Change, Diagnosis, LearnedTerm, Value
from eha_monitor.output import finite
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.quantity import NOTE, with_uncertainty
from eha_monitor.reports import diagnosis_words as words
from eha_monitor.settings.load import annotated, settings_from_tree
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.own_terms import is_own
from eha_monitor.settings.rig import corrected, rounded
from eha_monitor.units import LARGEST

SCHEMA = "eha_monitor/diagnosis/1"
# Estimated parameter -> key of the rig that holds it.
RIG_KEYS = {"B": "viscous_damping", "beta_e": "bulk_modulus"}
# Keys of the answer that are fields of the record.
AS_THEY_ARE = ("rig_data", "rig_within", "location", "effects", "advice", "message", "bags",
               "health", "remarks", "agreement", "considered", "curves", "references",
               "config_effects", "gates", "change_points", "events", "blind", "policy", "named_on",
               "duration_s", "wall_s")
_WIDTH = 95  # of the head of a written config


def answer(found: Diagnosis) -> dict:
    """Return the JSON tree: the contract's keys, then what extends it.  NaN becomes null."""
    return finite({
        "schema": SCHEMA,
        "bag": ", ".join(found.bags),
        "verdict": found.verdict,
        "probability": {key: found.probability.get(key)
                        for key in ("consistent", "unexplained")},
        **{key: getattr(found, key) for key in AS_THEY_ARE},
        "parameters": {"before": found.before, "after": found.after},
        "fit": {"data": found.data, "signals": found.signals},
        "learned": [_learned(term) for term in found.learned],
        "changes": [_change(one) for one in found.changes],
        # Probabilities took their place; programs that read them find the keys.
        "threshold": {"log_units": None, "calibrated": False},
        "explained": None,
        "baseline": [one.to_dict() for one in found.baselines],
        "pieces": [{"bag": piece.bag, "start_s": piece.start_s, "stop_s": piece.stop_s,
                    "parameters": piece.values} for piece in found.pieces],
    } | ({"machine": found.machine.to_dict()} if found.machine is not None else {}))


def refusal(bags: tuple[Path, ...], message: str, channels: list[dict]) -> dict:
    """Return the JSON tree of recordings that contradict their config; nothing is diagnosed."""
    return {
        "schema": SCHEMA,
        "bag": ", ".join(map(str, bags)),
        "verdict": "insufficient_data",
        "probability": {"consistent": None, "unexplained": None},
        "rig_data": [],
        "location": {"balance": dict.fromkeys(("force", "flow", "drive", "sensor"), 0.0),
                     "regime": "", "intervals_s": []},
        "effects": [],
        "parameters": {"before": {}, "after": {}},
        "fit": {"data": "held_out", "signals": {}},
        "advice": [],
        "message": message,
        "channels": channels,
    }


def _change(change: Change) -> dict:
    def number(value: Value) -> dict:
        return {"value": value.value, "stddev": value.stddev}

    return {"what": change.what, "parameter": change.symbol, "balance": change.balance,
            "reference": number(change.reference), "now": number(change.now),
            "unit": change.unit, "statement": change.statement,
            "indistinguishable_from": change.indistinguishable_from}


def _learned(term: LearnedTerm) -> dict:
    """Return the contract's keys of a learned term, then what extends them."""
    arrays = ("x", "curve", "band", "at", "measured", "spread", "formula_curve")
    return {"balance": term.balance, "of": term.of, "formula": term.formula,
            "shape": term.shape,
            "alternatives": [shown for shown, _ in term.rivals],
            "held_out_error_removed": term.removed, "adds": term.adds,
            "statement": term.statement, "size": term.size, "unit": term.unit,
            "against_unit": term.against_unit, "log_evidence": term.gained,
            "alternatives_behind": [behind for _, behind in term.rivals],
            "covered": [float(term.x[0]), float(term.x[-1])], "entry": term.entry,
            **{name: getattr(term, name) for name in arrays}}


def completed(found: Diagnosis, settings: Settings) -> tuple[Settings, list[str], list[str]]:
    """Return the given config completed with what was found.

    ``effects`` is what the diagnosis says, and numbers of the rig that it contradicts, or knows
    better, become the found ones.  B and beta_e of the rig become the fitted ones: ``simulator``
    then makes what was recorded, and the filters start where the rig is.  Nothing else is
    changed, thresholds and priors included: whether the rig is healthy is not for a fit to say.
    Where neither names nor a learned term explain the mismatch, the config stays as it was.

    Returns
    -------
    settings : completed.
    changed : what is different, in words; ``missing`` what was found and cannot stand in it.
    """
    tree = settings.model_dump()
    changed, missing = [], []
    if found.command_hold != settings.command_hold:
        tree["command_hold"] = found.command_hold
        changed.append(f"command_hold: {found.command_hold}")
    if found.verdict == "mismatch" or found.learned:
        changed += _corrected_numbers(found, settings, tree["rig"], missing)
        changed += _named_physics(found, tree, missing)
        known = [*filter(None, settings.rig.identified.split(", ")),
                 *(finding.key for finding in found.rig_data),
                 *(one.name for one in found.effects if one.name in tree["effects"])]
        for name, key in RIG_KEYS.items():
            value = found.after.get(name)
            if value is not None and 0 < value.value < LARGEST:
                tree["rig"][key] = rounded(value.value)
                shown = with_uncertainty(value.value, value.stddev, value.unit)
                changed.append(f"rig.{key}: {shown}")
                known.append(key)
        tree["rig"]["identified"] = ", ".join(dict.fromkeys(known))
    return settings_from_tree(tree, "diagnosis"), changed, missing


def written_config(found: Diagnosis, settings: Settings, source: Path | None) -> str:
    """Return the config of :func:`completed` as an annotated file that says what was changed."""
    made, changed, missing = completed(found, settings)
    given = f"Completes {source.name}." if source else "Based on the paper's EHA."
    lines = [" ".join(line.split()) for line in (
        f"Written by eha_monitor {__version__}, diagnose of {', '.join(found.bags)}.", given)]
    lines += ["Changed keys:", *_indented(changed), *wrap(NOTE, _WIDTH)] if changed else [
        f"No key is changed: the verdict is {found.verdict}."]
    lines += ["Found, but not in this config:", *_indented(missing)] if missing else []
    return annotated(made, "\n".join(lines))


def _indented(points: list[str]) -> list[str]:
    """Return points of a list as lines of a file's head; names of bags may hold line breaks."""
    return [line for point in points for line in wrap(
        point, _WIDTH, initial_indent="  ", subsequent_indent="    ", break_long_words=False)]


def _corrected_numbers(found: Diagnosis, settings: Settings, rig: dict, missing: list[str]
                       ) -> list[str]:
    """Put the found numbers into the tree of the rig; return what was changed, in words."""
    findings = {finding.key: finding for finding in (*found.rig_data, *found.rig_within)}
    values, refused = corrected(settings.rig, {
        key: finding.found.value for key, finding in findings.items()})
    missing += [f"rig.{key}: {why}" for key, why in refused.items()]
    rig.update(values)
    lines = []
    for key, value in values.items():
        if key in findings and value == rounded(findings[key].found.value):
            before, now = words.rig_values(findings[key])
            lines.append(f"rig.{key}: {now}, was {before}"
                         f"{words.in_brackets(findings[key].probability)}")
        else:
            lines.append(f"rig.{key}: {value:g}, was {getattr(settings.rig, key):g}; "
                         "makeup_conductance is a part of leakage")
    return lines


def _named_physics(found: Diagnosis, tree: dict, missing: list[str]) -> list[str]:
    """Put the named effects into the tree; return what was changed, in words."""
    tree["effects"] = {name: values if is_own(values) else {
        key: rounded(value) for key, value in values.items() if math.isfinite(value)}
        for name, values in found.config_effects.items() if name in CATALOGUE or is_own(values)}
    reasons = words.not_in_config(found)
    for effect in found.effects:
        if effect.name in reasons:
            sizes = ", ".join(f"{name} = {words.value_words(value)}"
                              for name, value in effect.parameters.items())
            when = words.interval_words(effect.intervals_s)
            missing.append(f"{effect.name}: {sizes}{f' at {when}' if when else ''}; "
                           f"{reasons[effect.name]}")
    names = [effect.name for effect in found.effects if effect.name in tree["effects"]]
    lines = [f"effects: {', '.join(names)}"] if names else []
    return lines + [f"effects, learned: {term.statement}" for term in found.learned]
