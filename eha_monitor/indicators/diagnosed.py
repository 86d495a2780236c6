"""What a diagnosis gives to the indicators: named effects with their joint covariance."""

import numpy as np

from eha_monitor.indicators.found import evidence
from eha_monitor.indicators.indicator import Evidence
from eha_monitor.indicators.laws import LEAKS
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

RIG = ("leakage", "pump_displacement")
UNSEEN = "the diagnosis does not identify the leakage beyond the configured value: {}"


def of_diagnosis(found: Diagnosis, recordings: list[Recording], settings: Settings) -> Evidence:
    """Return the evidence of a diagnosis.

    Parameters
    ----------
    found : in SI of a linear rig, as :func:`mismatch.diagnose.diagnose` returns it.
    recordings : that it explains.
    """
    values, covariance = fitted_values(found)
    why = {}
    if "leakage" not in values:
        if any(name.partition(".")[0] in LEAKS for name in values):
            values, covariance = with_configured(values, covariance, settings)
        else:
            why["leakage"] = UNSEEN.format(
                "it compares healthy recordings" if found.references else
                "the recording needs pressures and the flow of the pump")
    for name in ("B", "beta_e"):
        if name not in values:
            why[name] = f"the verdict is {found.verdict.replace('_', ' ')}"
    return evidence(recordings, settings, values, covariance, why, diagnosed=not found.references,
                    settled=found.verdict in ("consistent", "mismatch"))


def fitted_values(found: Diagnosis) -> tuple[dict[str, float], np.ndarray]:
    """Return B, beta_e, leakage, displacement and the named effects' parameters, (k, k) too.

    Effects that the answer does not name stay out.  A standard deviation that the answer states
    larger than the fit's own (delays, B and beta_e of a model that lacks something) is taken.
    """
    named = {effect.name: effect for effect in found.effects}
    stated = {name: value.stddev for name, value in found.after.items()} | {
        f"{effect.name}.{symbol}": value.stddev for effect in found.effects
        for symbol, value in effect.parameters.items()}
    if found.fitted is None:
        names = list(found.after)
        return ({name: found.after[name].value for name in names},
                np.diag([found.after[name].stddev ** 2 for name in names]))
    wanted = [(name.removeprefix("rig."), place) for place, name in enumerate(found.fitted.names)
              if name in ("B", "beta_e", *(f"rig.{key}" for key in RIG))
              or name.partition(".")[0] in named]
    places = [place for _, place in wanted]
    values = {name: float(found.fitted.values[place]) for name, place in wanted}
    covariance = np.array(found.fitted.covariance[np.ix_(places, places)], dtype=float)
    for i, name in enumerate(values):
        more = stated.get(name, 0.0) ** 2 - covariance[i, i]
        covariance[i, i] += max(more, 0.0) if np.isfinite(more) else 0.0
    fixed = {f"{effect.name}.{symbol}": value.value for effect in found.effects
             for symbol, value in effect.parameters.items()
             if f"{effect.name}.{symbol}" not in values}
    size, more = len(values), len(fixed)
    whole = np.zeros((size + more, size + more))
    whole[:size, :size] = covariance
    return values | fixed, whole


def with_configured(values: dict[str, float], covariance: np.ndarray, settings: Settings
                    ) -> tuple[dict[str, float], np.ndarray]:
    """Return values with the config's leakage, as uncertain as its tolerance says."""
    leakage = settings.rig.leakage
    size = len(values)
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size] = covariance
    whole[size, size] = (leakage * settings.rig.tolerance.log_spread("leakage")) ** 2
    return values | {"leakage": leakage}, whole
