"""Numbers of the rig put right: each within its bounds, all of them consistent."""

import operator

from eha_monitor.settings.rig import Rig
from eha_monitor.units import LARGEST

FIGURES = 6  # digits of a number in a config: more than any of them is known to
_BOUNDS = (("gt", operator.gt, "more than"), ("ge", operator.ge, "at least"),
           ("lt", operator.lt, "less than"), ("le", operator.le, "at most"))


def rounded(value: float) -> float:
    """Return a number with as many digits as a written config has."""
    return float(f"{value:.{FIGURES}g}")


def corrected(rig: Rig, found: dict[str, float]) -> tuple[dict[str, float], dict[str, str]]:
    """Return what a rig must be changed in to have the found numbers.

    Parameters
    ----------
    found : key of the rig -> number that a recording says, SI.

    Returns
    -------
    changed : key -> value, SI; also of a key that has to follow another one.
    refused : key -> why its number cannot stand in a config.
    """
    changed, refused = {}, {}
    for key, value in found.items():
        why = _refusal(key, value)
        if why:
            refused[key] = why
        else:
            changed[key] = rounded(value)
    leakage = changed.get("leakage", rig.leakage)
    makeup = changed.get("makeup_conductance", rig.makeup_conductance)
    if makeup > leakage:  # the make-up path is a part of the leakage
        follows = "makeup_conductance" if "leakage" in changed else "leakage"
        changed[follows] = makeup if follows == "leakage" else leakage
    return changed, refused


def _refusal(key: str, value: float) -> str:
    """Return why a key cannot hold a value, or nothing."""
    field = Rig.model_fields.get(key)
    if field is None or not isinstance(field.json_schema_extra, dict):
        return "is no number of the config's rig"
    unit = field.json_schema_extra["unit"]
    if not abs(value) <= LARGEST:
        return f"the recording gives no plausible value, in {unit}"
    for name, holds, words in _BOUNDS:
        for rule in field.metadata:
            bound = getattr(rule, name, None)
            if bound is not None and not holds(value, bound):
                return f"expected {words} {bound:g} {unit}, the recording says {value:g}"
    return ""
