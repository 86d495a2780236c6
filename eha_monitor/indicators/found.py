"""What an estimate or a recording gives to the indicators."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from eha_monitor.estimation.results import Estimate
from eha_monitor.indicators.indicator import Evidence
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

MOMENTS = 400  # of the pressures: their distribution is wanted, not their course
NO_JOINT = ("the leakage is not estimated: it needs x, p1, p2 and omega, and a config without "
            "effects")


def of_estimate(found: Estimate) -> Evidence:
    """Return the evidence of an estimate: what converged, after the last change of a stage."""
    values, variances, why = {}, [], {}
    parameters, doubts = dict(found.parameters), found.model.tainted
    if found.joint is not None:
        parameters["leakage"] = found.joint.parameters["L"]
        # Stage two takes the config's leakage for true: where another one leads it astray, the
        # joint estimator, which has the leakage among its unknowns, knows beta_e.
        stiffness = found.joint.parameters["beta_e"]
        if (("beta_e" in doubts or parameters["beta_e"].status != "converged")
                and found.joint.fits and stiffness.status == "converged"):
            parameters["beta_e"] = stiffness
            doubts = {name: taint for name, taint in doubts.items() if name != "beta_e"}
    else:
        why["leakage"] = NO_JOINT
    for name, one in parameters.items():
        if one.status == "converged":
            values[name] = one.value
            variances.append(one.stddev**2)
        else:
            why[name] = one.message or one.status.replace("_", " ")
    changes = found.stage_two.changes
    since = int(changes[-1][0]) if len(changes) else 0
    made = evidence([found.recording], found.settings, values, np.diag(variances), why,
                    since=since)
    return replace(made, doubts={name: taint.reason
                                 for name, taint in doubts.items()})


def evidence(recordings: list[Recording], settings: Settings, values: Mapping[str, float],
             covariance: np.ndarray, why: Mapping[str, str], diagnosed: bool = False,
             settled: bool = True, since: int = 0) -> Evidence:
    """Return evidence with the pressures and the temperature that recordings show.

    Parameters
    ----------
    since : sample from which the (first) recording shows what the values hold for.
    """
    pressures = [moments(one, name, since) for one in recordings for name in ("p1", "p2")
                 if one.has("p1", "p2")]
    temperature = next((float(shown[-1]) for one in reversed(recordings)
                        if len(shown := moments(one, "temperature", 0))), None)
    measured = temperature is not None
    if not measured:
        temperature = settings.health.oil_temperature
    channels = tuple(name for name in recordings[0].channels
                     if all(one.has(name) for one in recordings)) if recordings else ()
    return Evidence(values, covariance, tuple(settings.effects), why, channels=channels,
                    pressures=np.concatenate(pressures) if pressures else np.empty(0),
                    temperature=temperature, measured=measured, diagnosed=diagnosed,
                    settled=settled)


def moments(recording: Recording, name: str, since: int) -> np.ndarray:
    """Return finite values of a channel at moments spread evenly over a recording."""
    if name not in recording.channels:
        return np.empty(0)
    rows = recording.channels[name]
    start = since if since < len(rows) else 0
    chosen = np.asarray(rows[start::max((len(rows) - start) // MOMENTS, 1)], dtype=float)
    if not np.isfinite(chosen).any():
        chosen = np.asarray(rows[:], dtype=float)
    return chosen[np.isfinite(chosen)]
