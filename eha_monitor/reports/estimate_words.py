"""An estimate in words: the verdict in one plain sentence, and what to do."""

import math
import shlex
from dataclasses import dataclass

from eha_monitor.estimation.results import Estimate, ParameterEstimate
from eha_monitor.health.alarms import WATCHED, Alarm
from eha_monitor.quantity import SYMBOLS, number, quantity
from eha_monitor.reports.diagnosis_words import sentence
from eha_monitor.reports.estimate_figures import NAMES
from eha_monitor.words import listed

STATUS_WORDS = {"converged": "converged", "not_excited": "not excited by this motion",
                "diverged": "diverged", "no_data": "no data"}
_SECTIONS = {watched.symbol: watched.section for watched in WATCHED}
# Alarm -> what is wrong, and where to look first.
_ALARMS = {
    "viscous_damping_high": ("the viscous damping B is too high",
                             "look for what brakes the piston (worn or swollen seals, a side "
                             "load, cold oil)"),
    "viscous_damping_low": ("the viscous damping B is too low",
                            "check the oil's temperature and grade, and the areas in the config"),
    "bulk_modulus_high": ("the effective bulk modulus βe is too high",
                          "check the volumes in the config"),
    "bulk_modulus_low": ("the effective bulk modulus βe is too low",
                         "look for air in the oil: bleed the circuit, check the suction side and "
                         "the charge pressure")}
_STEPS = {"not_excited": "record a motion that excites {name} {symbol}: `eha-monitor advise "
                         "{bag}` proposes one",
          "diverged": "check the channels and the rig data in the config: the estimate of {name} "
                      "{symbol} diverged",
          "no_data": "record what {name} {symbol} needs: {message}"}


@dataclass(frozen=True)
class Verdict:
    """``kind`` is ``ok``, ``warn``, ``error`` or ``unknown`` and sets the colour."""

    kind: str
    headline: str
    text: str

    @property
    def sentence(self) -> str:
        """Headline and text."""
        return f"{self.headline}: {self.text}"


def verdict(estimate: Estimate, alarms: tuple[Alarm, ...]) -> Verdict:
    """Return what the recording says about the actuator, and what it does not say."""
    raised = _raised(alarms)
    known = [p for p in estimate.parameters.values() if p.status == "converged"]
    unknown = [p for p in estimate.parameters.values() if p.status != "converged"]
    mismatch = estimate.model.status == "mismatch"
    parts = []
    if raised:
        parts.append(" and ".join(
            f"{_ALARMS[a.name][0] if a.name in _ALARMS else a.name.replace('_', ' ')} ({a.level})"
            for a in raised))
    if mismatch:
        parts.append("the model does not fit this recording" + (
            ", so the values are biased by the model error" if known else ""))
    if known and not raised:
        parts.append(_values(known, alarms))
    if unknown:
        parts.append("no estimate of " + " and ".join(
            f"{NAMES[p.name]} {SYMBOLS[p.name]} ({STATUS_WORDS.get(p.status, p.status)})"
            for p in unknown))
    if estimate.model.status == "consistent":
        parts.append("the model fits the recording")
    elif known and not mismatch:
        parts.append("the recording does not show whether the model fits")
    held = any(a.not_judged for a in alarms)
    kind, headline = _head(raised, estimate.model.status, bool(known), bool(unknown) or held)
    if held and kind == "ok":
        kind = "unknown"
    return Verdict(kind, headline, f"{'; '.join(parts)}.")


def _raised(alarms: tuple[Alarm, ...]) -> list[Alarm]:
    """Return the raised alarms, errors first."""
    return [a for word in ("ERROR", "WARN") for a in alarms if a.word == word]


def _head(raised: list[Alarm], model: str, known: bool, open_questions: bool) -> tuple[str, str]:
    """Return colour and first words: the gravest thing leads."""
    if raised:
        grave = raised[0].word == "ERROR"
        words = "Alarm" if grave else "Warning"
        found = ("error" if grave else "warn",
                 words + (" and mismatch" if model == "mismatch" else ""))
    elif model == "mismatch":
        found = "warn", "Mismatch"
    elif not known:
        found = "unknown", "No answer"
    elif open_questions or model != "consistent":
        found = ("ok" if model == "consistent" else "unknown",
                 "No fault found in what could be judged")
    else:
        found = "ok", "Healthy"
    return found


def _values(known: list[ParameterEstimate], alarms: tuple[Alarm, ...]) -> str:
    """Return the values that no alarm complains about, and whether one could have."""
    def of(parameter: ParameterEstimate) -> list[Alarm]:
        return [a for a in alarms if a.name.startswith(_SECTIONS[parameter.name])]

    def shown(some: list[ParameterEstimate]) -> str:
        return " and ".join(f"{SYMBOLS[p.name]} = {p.shown}" for p in some)

    doubtful = [p for p in known if any(a.not_judged for a in of(p))]
    sure = [p for p in known if p not in doubtful]
    parts = []
    if sure:
        parts.append(shown(sure) + (f" {'is' if len(sure) == 1 else 'are'} within the limits"
                                    if all(map(of, sure)) else ", without configured limits"))
    if doubtful:
        parts.append(f"{shown(doubtful)} {'is' if len(doubtful) == 1 else 'are'} not judged")
    return "; ".join(parts)


def effect_of_mismatch(estimate: Estimate) -> tuple[str, ...]:
    """Return what a model that does not fit does to B and beta_e, a sentence each."""
    found = []
    for name, taint in estimate.model.tainted.items():
        parameter, symbol = estimate.parameters[name], SYMBOLS[name]
        if not math.isfinite(taint.reach):
            found.append(f"{symbol} cannot be used: how far the model error moves it is not known")
        elif name == "B":
            found.append(f"{symbol} may be off by {quantity(taint.reach, parameter.unit, 2)} "
                         "because of the model error")
        else:
            found.append(f"{symbol} may be off by a factor of {number(math.exp(taint.reach), 2)} "
                         "because of the model error")
    return tuple(map(sentence, found))


def next_steps(estimate: Estimate, alarms: tuple[Alarm, ...]) -> tuple[str, ...]:
    """Return what to do, the most important first; commands stand between backticks."""
    bag = shlex.quote(estimate.recording.source or "BAG")
    steps = []
    if estimate.model.status == "mismatch":
        steps.append("do not act on B and βe yet: `eha-monitor diagnose " + bag + "` identifies "
                     "what the model lacks")
    steps += [_ALARMS[a.name][1] for a in _raised(alarms) if a.name in _ALARMS]
    for p in estimate.parameters.values():
        if p.status in _STEPS:
            steps.append(_STEPS[p.status].format(
                name=NAMES[p.name], symbol=SYMBOLS[p.name], bag=bag,
                message=p.message.rstrip(".") or "its channels are missing"))
    judged = {p.name for p in estimate.parameters.values() for a in alarms
              if a.name.startswith(_SECTIONS[p.name])}
    if without := [SYMBOLS[name] for name in estimate.parameters if name not in judged]:
        steps.append(f"set limits for {listed(without)}: `eha-monitor thresholds` derives them "
                     "from healthy recordings")
    return tuple(map(sentence, steps)) or ("Nothing.",)
