"""What indicators are computed from: the numbers of an estimate, or of a diagnosis."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.estimation.results import Estimate
from eha_monitor.indicators.laws import LEAKS
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

MOMENTS = 400  # of the pressures: their distribution is wanted, not their course
NO_JOINT = ("the leakage is not estimated: it needs x, p1, p2 and omega, and a config without "
            "effects")
RIG = ("leakage", "pump_displacement")
UNSEEN = "the diagnosis does not identify the leakage beyond the configured value: {}"


@dataclass(frozen=True)
class Evidence:
    """What an estimate or a diagnosis found, as plain numbers.

    Attributes
    ----------
    values : ``B``, ``beta_e``, ``leakage`` (C_T), ``pump_displacement``, and
        ``<effect>.<parameter>`` of each named effect; SI.
    covariance : (k, k) in their order.
    assumed : effects that the config has and that were therefore not measured.
    why : name of a value -> why it is not there; ``doubts``: why it is there and in doubt.
    channels : that were recorded.
    pressures : (m,) absolute pressures of both chambers at times spread over the recording, Pa;
        empty where they were not measured.
    temperature : of the oil, °C, or None; ``measured`` says whether a channel gave it.
    diagnosed : whether effects were looked for; ``settled``: and what was found explains it.
    """

    values: Mapping[str, float]
    covariance: np.ndarray
    assumed: tuple[str, ...] = ()
    why: Mapping[str, str] = field(default_factory=dict)
    doubts: Mapping[str, str] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    pressures: np.ndarray = field(default_factory=lambda: np.empty(0))
    temperature: float | None = None
    measured: bool = False
    diagnosed: bool = False
    settled: bool = True

    def part(self, *names: str) -> tuple[dict[str, float], np.ndarray]:
        """Return those of the values that are there, and their covariance."""
        order = list(self.values)
        kept = [name for name in order if name in names]
        places = [order.index(name) for name in kept]
        return ({name: self.values[name] for name in kept},
                np.asarray(self.covariance, dtype=float)[np.ix_(places, places)])

    def named(self, *effects: str) -> list[str]:
        """Return which of the effects were named."""
        there = {name.partition(".")[0] for name in self.values if "." in name}
        return [effect for effect in effects if effect in there]


def evidence_of_estimate(found: Estimate) -> Evidence:
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


def evidence_of_diagnosis(found: Diagnosis, recordings: list[Recording], settings: Settings) -> Evidence:
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
    return values | fixed, wider(covariance, [0.0] * len(fixed))


def with_configured(values: dict[str, float], covariance: np.ndarray, settings: Settings
                    ) -> tuple[dict[str, float], np.ndarray]:
    """Return values with the config's leakage, as uncertain as its tolerance says."""
    leakage = settings.rig.leakage
    spread = leakage * settings.rig.tolerance.log_spread("leakage")
    return values | {"leakage": leakage}, wider(covariance, [spread])


def wider(covariance: np.ndarray, spread: list[float]) -> np.ndarray:
    """Return a covariance with further numbers, independent of all others."""
    size, whole = len(covariance), np.pad(covariance, (0, len(spread)))
    whole[size:, size:] = np.diag(np.square(spread))
    return whole
