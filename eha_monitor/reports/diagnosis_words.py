"""A diagnosis in words: names, places and sizes as a person says them."""

import math

from eha_monitor.mismatch.diagnosis import Diagnosis, SignalFit, Value
from eha_monitor.quantity import Scale, number, quantity, readable, with_uncertainty

# Verdict -> (colour, first words).
VERDICTS = {
    "consistent": ("ok", "Model and recording agree"),
    "mismatch": ("warn", "Mismatch, and what it is"),
    "unexplained": ("error", "Mismatch without a name"),
    "insufficient_data": ("unknown", "Too little to tell"),
}
CHANGED = ("warn", "A parameter changed, and nothing else is missing")
REGIMES = {
    "velocity_reversal": "where the motion turns round", "high_speed": "at high speed",
    "high_pressure": "at a high pressure difference", "near_limit": "near a limit",
    "always": "all the time",
}
BALANCES = {"force": "force balance", "flow": "flow balance", "drive": "drive",
            "sensor": "sensors"}
DATA = {"held_out": "a part of the recording that the fit has not seen",
        "held_out_bag": "another recording, which the fit has not seen"}
_MOST_INTERVALS = 6


def head_of(found: Diagnosis) -> tuple[str, str]:
    """Return the colour and the first words of a verdict."""
    return CHANGED if found.pieces else VERDICTS.get(found.verdict, ("unknown", found.verdict))


def effect_words(name: str) -> str:
    """Return the name of an effect as people say it: ``Coulomb friction``."""
    words = name.replace("_", " ")
    for person in ("coulomb", "stribeck"):
        words = words.replace(person, person.capitalize())
    return words


def listed(words: list[str] | tuple[str, ...], last: str = "and") -> str:
    """Return ``a, b and c``."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def sentence(text: str) -> str:
    """Return a text with a capital at its start and a full stop at its end."""
    text = text.strip()
    if not text:
        return ""
    first = text[0].upper() if text[0].isascii() else text[0]  # βe is a symbol, no word
    return first + text[1:] + ("" if text[-1] in ".!?" else ".")


def place_words(found: Diagnosis) -> str:
    """Return where the disagreement lies, as one phrase; empty where there is none."""
    shares = sorted(((share, name) for name, share in found.location.balance.items()
                     if math.isfinite(share) and share >= 0.005), reverse=True)
    if not shares:
        return ""
    text = ", ".join(f"{BALANCES.get(name, name)} {percent(share)}" for share, name in shares)
    regime = REGIMES.get(found.location.regime, found.location.regime.replace("_", " "))
    return f"{text}; {regime}" if regime else text


def interval_words(found: Diagnosis) -> str:
    """Return the intervals in seconds, at most a few of them, or nothing."""
    few = found.location.intervals_s[:_MOST_INTERVALS]
    digits = 1 if all(stop - start > 0.09 for start, stop in few) else 3
    shown = [f"{start:.{digits}f}–{stop:.{digits}f}" for start, stop in few]
    more = len(found.location.intervals_s) - len(shown)
    if not shown:
        return ""
    return f"{', '.join(shown)} s" + (f" and {more} more" if more > 0 else "")



def percent(share: float) -> str:
    """Return a share of one in percent, with tenths only near 0 and 1."""
    if not math.isfinite(share):
        return "—"
    value = 100 * share
    if 99 < value < 100 or 0 < value < 1:
        return f"{min(value, 99.9) if value > 99 else max(value, 0.1):.1f} %"
    return f"{value:.0f} %"


def log_units(value: float) -> str:
    """Return evidence in log units, thousands apart."""
    if not math.isfinite(value):
        return "—"
    digits = 1 if abs(value) < 10 else 0
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def value_words(value: Value | None) -> str:
    """Return ``value ± stddev unit``, or a dash where there is none."""
    if value is None or not math.isfinite(value.value):
        return "—"
    if value.stddev == 0:  # it was given, or read off the data
        return quantity(value.value, value.unit)
    return with_uncertainty(value.value, value.stddev, value.unit)


def error_scale(fit: SignalFit) -> Scale:
    """Return one scale for all errors of a signal, so that they can be compared."""
    known = [value for value in (fit.before_rms, fit.after_rms) if math.isfinite(value)]
    largest = max(known, default=0.0)
    return readable(largest, fit.unit)


def error_words(value: float, fit: SignalFit) -> str:
    """Return an error of a signal, in the common unit unless it is far too small for that."""
    if not math.isfinite(value):
        return "—"
    scale = error_scale(fit)
    if 0 < abs(value * scale.factor) < 0.01:
        return quantity(value, fit.unit, 3)
    return f"{number(value * scale.factor, 3)} {scale.unit}".rstrip()


def removed(fit: SignalFit) -> float:
    """Return the share of the error beyond the noise that the named physics removes."""
    noise = fit.noise_rms if math.isfinite(fit.noise_rms) else 0.0
    beyond = fit.before_rms - noise
    if not beyond > 0.02 * max(noise, 0.0) or not math.isfinite(fit.after_rms):
        return math.nan
    return min((fit.before_rms - fit.after_rms) / beyond, 1.0)


def certainty(found: Diagnosis) -> str:
    """Return the threshold of evidence and where it comes from, as sentences."""
    if not math.isfinite(found.threshold):
        return "No threshold of evidence was needed."
    text = (f"An effect had to gain {log_units(found.threshold)} log units over the model "
            "without it to be named, and to be of a size that matters. ")
    if found.calibrated:
        from eha_monitor.mismatch.calibrate import FALSE_ALARM

        return text + ("That threshold comes from simulated clean recordings of this rig, with "
                       "this motion, this sample time and this noise; about one such recording "
                       f"in {1 / FALSE_ALARM:.0f} would reach it.")
    return text + ("That is the usual threshold; it was not calibrated on simulated clean "
                   "recordings of this rig and motion.")
