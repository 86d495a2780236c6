"""From a mistake to the fragment of a config that mends it, and into the config."""

from typing import Any

from eha_monitor.plausibility.mistakes import Mistake
from eha_monitor.recordings.recording import ChannelFinding
from eha_monitor.settings.load import merge, settings_from_tree
from eha_monitor.settings.monitor import Settings

FIGURES = 12  # digits: a scale of 0.001 is written as that


def correction_of(mistake: Mistake, settings: Settings) -> dict[str, Any]:
    """Return the sections and keys that mend a mistake, with their new values.

    A channel is mended where the bag is read (``channels``), not where a table was imported
    (``table``): the bag at hand keeps its numbers.  The time is the exception, since a bag's
    stamps are its own; it is mended in ``table.time_scale`` and takes another import.
    """
    if mistake.swap is not None:
        one, other = mistake.swap
        if not {one, other} <= set(settings.channels):
            return {}
        return {"channels": {one: settings.channels[other].model_dump(),
                             other: settings.channels[one].model_dump()}}
    if mistake.clock != 1.0:
        return {"table": {"time_scale": rounded(settings.table.time_scale * mistake.clock)}} \
            if settings.table.columns else {}
    found: dict[str, Any] = {}
    for role, factor in mistake.factors.items():
        channel = settings.channels.get(role)
        if channel is not None:
            found.setdefault("channels", {})[role] = {
                **({"unit": ""} if channel.unit else {}),
                "scale": rounded(channel.gain * factor),
                "offset": rounded(channel.zero * factor)}
    for key, factor in mistake.numbers.items():
        found.setdefault("rig", {})[key] = rounded(getattr(settings.rig, key) * factor)
    return found


def rounded(value: float) -> float:
    """Return a number without the digits that a product of floats adds."""
    return float(f"{value:.{FIGURES}g}")


def corrected(settings: Settings, findings: tuple[ChannelFinding, ...]) -> Settings:
    """Return the settings with what the findings correct.

    Raises
    ------
    InputError
        If a corrected value is out of the range of its key.
    """
    tree = settings.model_dump()
    for finding in findings:
        merge(tree, finding.correction)
    return settings_from_tree(tree, "correction")
