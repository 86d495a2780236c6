"""What ``diagnose`` answers: the JSON of the contract, and the config with the named physics."""

import math
from dataclasses import asdict
from pathlib import Path
from textwrap import wrap

from eha_monitor import __version__
from eha_monitor.commands.answer import finite
from eha_monitor.mismatch.diagnosis import Diagnosis, NamedEffect, Value
from eha_monitor.quantity import NOTE, with_uncertainty
from eha_monitor.settings.document import annotated
from eha_monitor.settings.load import settings_from_tree
from eha_monitor.settings.monitor import Settings
from eha_monitor.units import LARGEST

SCHEMA = "eha_monitor/diagnosis/1"
# Estimated parameter -> key of the rig that holds it.
RIG_KEYS = {"B": "viscous_damping", "beta_e": "bulk_modulus"}
_FIGURES = 6  # digits of a number in a config: more than any of them is known to


def mismatched(found: Diagnosis) -> bool:
    """Tell whether the nominal model does not explain the recording."""
    return found.verdict in ("mismatch", "unexplained")


def answer(found: Diagnosis) -> dict:
    """Return the JSON tree: the contract's keys, then what extends it.  NaN becomes null."""
    return finite({
        "schema": SCHEMA,
        "bag": ", ".join(found.bags),
        "verdict": found.verdict,
        "location": {"balance": found.location.balance, "regime": found.location.regime,
                     "intervals_s": found.location.intervals_s},
        "effects": [_effect(effect) for effect in found.effects],
        "parameters": {"before": _values(found.before), "after": _values(found.after)},
        "fit": {"data": found.data,
                "signals": {name: asdict(fit) for name, fit in found.signals.items()}},
        "advice": found.advice,
        "message": found.message,
        "bags": found.bags,
        "health": found.health,
        "agreement": [{"part": one.part, "before": _values(one.before),
                       "after": _values(one.after)} for one in found.agreement],
        "considered": [asdict(one) for one in found.considered],
        "curves": [{**asdict(curve), **{name: getattr(curve, name).tolist() for name in
                                        ("x", "measured", "spread", "modelled")}}
                   for curve in found.curves],
        "config_effects": found.config_effects,
        "threshold": {"log_units": found.threshold, "calibrated": found.calibrated},
        "explained": found.explained,
        "pieces": [{"bag": piece.bag, "start_s": piece.start_s, "stop_s": piece.stop_s,
                    "parameters": _values(piece.values)} for piece in found.pieces],
        "duration_s": found.duration_s,
        "wall_s": found.wall_s,
    })


def refusal(bags: tuple[Path, ...], message: str, channels: list[dict]) -> dict:
    """Return the JSON tree of recordings that contradict their config; nothing is diagnosed."""
    return {
        "schema": SCHEMA,
        "bag": ", ".join(map(str, bags)),
        "verdict": "insufficient_data",
        "location": {"balance": dict.fromkeys(("force", "flow", "drive", "sensor"), 0.0),
                     "regime": "", "intervals_s": []},
        "effects": [],
        "parameters": {"before": {}, "after": {}},
        "fit": {"data": "held_out", "signals": {}},
        "advice": [],
        "message": message,
        "channels": channels,
    }


def _effect(effect: NamedEffect) -> dict:
    return {"name": effect.name, "balance": effect.balance, "statement": effect.statement,
            "parameters": _values(effect.parameters), "log_evidence": effect.log_evidence,
            "indistinguishable_from": effect.indistinguishable_from, "size": effect.size,
            "equation": effect.equation, "rig_check": effect.rig_check}


def _values(values: dict[str, Value]) -> dict:
    return {name: asdict(value) for name, value in values.items()}


def written_config(found: Diagnosis, settings: Settings, source: Path | None) -> str:
    """Return the given config completed with the named physics, as an annotated file.

    ``effects`` is what the diagnosis says.  B and beta_e of the rig become the fitted ones:
    ``simulator`` then makes what was recorded, and the filters start where the rig is.  Nothing
    else is changed, thresholds and priors included: whether the rig is healthy is not for a fit
    to say.  Where the names do not explain the mismatch, the config stays as it was.
    """
    tree = settings.model_dump()
    changed = []
    if found.command_hold != settings.command_hold:
        tree["command_hold"] = found.command_hold
        changed.append(f"command_hold: {found.command_hold}")
    if found.verdict == "mismatch":
        tree["effects"] = {name: {key: _rounded(value) for key, value in values.items()
                                  if math.isfinite(value)}
                           for name, values in found.config_effects.items()}
        changed.append(f"effects: {', '.join(effect.name for effect in found.effects)}")
        for name, key in RIG_KEYS.items():
            value = found.after.get(name)
            if value is not None and 0 < value.value < LARGEST:
                tree["rig"][key] = _rounded(value.value)
                shown = with_uncertainty(value.value, value.stddev, value.unit)
                changed.append(f"rig.{key}: {shown}")
    given = f"Completes {source.name}." if source else "Completes the paper's EHA."
    lines = [f"Written by eha_monitor {__version__}, diagnose of {', '.join(found.bags)}.", given]
    lines += ["Set by it:", *(f"  {line}" for line in changed), *wrap(NOTE, 95)] \
        if changed else [f"Nothing is changed in it: the verdict is {found.verdict}."]
    title = "\n".join(" ".join(line.split()) if not line.startswith(" ") else line
                      for line in lines)
    return annotated(settings_from_tree(tree, "diagnosis"), title)


def _rounded(value: float) -> float:
    return float(f"{value:.{_FIGURES}g}")
