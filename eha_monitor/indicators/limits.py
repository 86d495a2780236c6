"""The limits of parameters and indicators, in the unit in which each is shown."""

from eha_monitor.indicators.indicator import AVAILABLE, UNITS, Indicator
from eha_monitor.settings.monitor import Settings

WORST = {"B": "viscous_damping", "beta_e": "bulk_modulus"}


def limits_of_indicator(name: str, settings: Settings) -> tuple[float | None, float | None]:
    """Return what an indicator or a parameter must stay above and below; None for no limit.

    Of B and beta_e these are the ERROR thresholds, or those of WARN where there is no other.

    Parameters
    ----------
    name : of an indicator, or ``B`` or ``beta_e``.
    """
    if name in WORST or name == "damping":
        limits = getattr(settings.thresholds, WORST.get(name, "viscous_damping"))
        low = limits.low_warn if limits.low_error is None else limits.low_error
        high = limits.high_warn if limits.high_error is None else limits.high_error
        return low, high
    key = "friction" if name == "friction_share" else name
    limit = getattr(settings.health, f"{key}_limit")
    if limit is None:
        return None, None
    if name == "friction":
        areas = settings.rig.area_1, settings.rig.area_2
        if settings.health.rated_pressure is None or None in areas:
            return None, None
        return None, limit * settings.health.rated_pressure * min(areas)
    shown = limit * UNITS[name][0]
    return (shown, None) if name == "pump_efficiency" else (None, shown)


def passed(one: Indicator, settings: Settings) -> bool:
    """Tell whether a value lies beyond its limit by ``thresholds.confidence`` of its stddev."""
    low, high = limits_of_indicator(one.name, settings)
    margin = settings.thresholds.confidence * one.stddev
    return one.status == AVAILABLE and (
        (low is not None and one.value < low - margin)
        or (high is not None and one.value > high + margin))
