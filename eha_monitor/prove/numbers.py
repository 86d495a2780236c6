"""The rig's numbers in a trial: which the config has wrong, and what the answer says of them.

A pair such as ``area_1``, ``area_2`` is one number here (``area``): the plant is symmetric.
"""

from collections.abc import Sequence

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
    """Return what an answer says of rig numbers, one entry a number, the surest of a pair."""
    found: dict[str, dict] = {}
    for one in answer.get("rig_data", ()):
        name = number_of(one["key"])
        if name not in found or sureness(one) > sureness(found[name]):
            found[name] = {**one, "number": name}
    return list(found.values())


def sureness(finding: dict) -> float:
    """Return the probability of a finding, 0 where it states none."""
    return finding.get("probability") or 0.0


def rivals_of(finding: dict, own: str) -> tuple[str, ...]:
    """Return the rivals that a finding declares, numbers and effects, each once."""
    names = map(number_of, finding.get("indistinguishable_from", ()))
    return tuple(name for name in dict.fromkeys(names) if name != own)


def false_names(named: Sequence[str], paired: Sequence[str], errors: dict[str, float]
                ) -> list[str]:
    """Return the numbers that are named although they are within their tolerance.

    One that stands for something that is there, by its declared class, is not false.
    """
    return [name for name in named if name not in paired and errors.get(name, 0.0) < NEAR]
