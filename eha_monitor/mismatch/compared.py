"""What has changed in recordings of a machine against healthy ones.

By its balances; and where these find nothing and the config's own model fits every recording, by
the two-stage filter's B and beta_e: compression that is faster than a balance is the filter's.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from eha_monitor.balances.change_point import since_change
from eha_monitor.balances.changed import WORDS, against, shares_of
from eha_monitor.balances.event import without_events
from eha_monitor.balances.machine import Machine, healthy_machine_of
from eha_monitor.balances.measured import courses_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.scatter import limit_of
from eha_monitor.breakdown import computing
from eha_monitor.errors import InputError
from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.estimation.pipeline import estimate
from eha_monitor.estimation.results import ParameterEstimate
from eha_monitor.mismatch.data.experiment import experiment_of
from eha_monitor.mismatch.diagnosis import Change, Diagnosis, Location, SignalFit, Value
from eha_monitor.mismatch.likelihood.fit import with_unknowns
from eha_monitor.mismatch.name.refit import unfitted
from eha_monitor.mismatch.show.held_out import shown
from eha_monitor.physics.signals import BETA_E, B
from eha_monitor.quantity import with_uncertainty
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

OF = {"B": ("force", WORDS["B"]), "beta_e": ("flow", WORDS["C_h"])}


def compared(recordings: Sequence[Recording], references: Sequence[Recording],
             settings: Settings) -> Diagnosis:
    """Say what has changed in recordings of a machine against healthy ones.

    Parameters
    ----------
    recordings : of the machine now, explained together.
    references : of a healthy machine, of the same or of one like it; one that stands is left out.
    settings : nominal config; its effects count as known.

    Raises
    ------
    InputError
        If the references are too few or too short, nothing in them moves, or one side has no
        force balance.
    """
    started = time.perf_counter()
    with computing(*(one.source for one in (*recordings, *references))):
        recordings, events = without_events(recordings, settings)
        recordings, points = since_change(recordings, settings)
        moving, courses, lines = courses_of(references, settings)
        found = against(healthy_machine_of(courses, settings), recordings, settings,
                        tuple(one.source for one in moving))
        # Where it follows the recordings, a filter knows the oil ten times as well.
        if found.verdict == "consistent" or (found.changes and {
                one.what for one in found.changes} <= {"compliance", "beta_e"}):
            found = _by_filter(found, recordings, moving, settings)
    left_out = tuple(f"reference {line}, so it says nothing of the healthy machine"
                     for line in lines)
    return replace(found, advice=left_out + found.advice).around(events).since(points, started)


def beside(machine: Machine, recordings: Sequence[Recording], settings: Settings) -> Diagnosis:
    """Say what has changed in recordings against a machine that others have shown, as saved.

    Raises
    ------
    InputError
        If one side has no force balance, or numbers break the calculation.
    """
    started = time.perf_counter()
    with computing(*(one.source for one in recordings)):
        recordings, events = without_events(recordings, settings)
        recordings, points = since_change(recordings, settings)
        found = against(machine, recordings, settings, machine.sources)
    return found.around(events).since(points, started)


def _by_filter(found: Diagnosis, recordings: Sequence[Recording], references: Sequence[Recording],
               settings: Settings) -> Diagnosis:
    """Return what the balances say, with B and beta_e where a filter sees that they changed."""
    now = _estimates(recordings, settings)
    healthy = _estimates(references, settings) if now else []
    if not healthy or len(healthy) < POLICY.fewest:
        return found
    changes = tuple(change for name in OF if (change := changed(
        name, [one[name] for one in healthy], [one[name] for one in now])) is not None)
    if not changes:
        return found
    moved = {one.what: one.reference.value for one in changes}
    here = {name: float(np.exp(_mean([one[name] for one in now])[0])) for name in OF}
    signals = _free_runs(recordings, settings, here | moved, here)
    weights = shares_of(changes, found.location.balance)
    return replace(
        found, verdict="mismatch", signals=found.signals | signals,
        message="; ".join(one.statement for one in changes),
        location=Location(weights, "always", ()), changes=changes,
        before=found.before | {one.what: one.reference for one in changes},
        after=found.after | {one.what: one.now for one in changes})


def _estimates(recordings: Sequence[Recording], settings: Settings
               ) -> list[dict[str, ParameterEstimate]]:
    """Return B and beta_e of each recording; empty where the model does not fit every one."""
    found = []
    for recording in recordings:
        with suppress(InputError):
            one = estimate(recording, settings)
            if one.model.status == "consistent":
                found.append(one.parameters)
    return found if len(found) == len(recordings) else []


def changed(name: str, healthy: Sequence[ParameterEstimate], now: Sequence[ParameterEstimate]
            ) -> Change | None:
    """Return the change of a parameter, None where there is none, or one of them is not known.

    Logarithms are compared, by the prediction interval of Student's t for one more healthy
    recording; and a difference below ``worse`` of the value is none.
    """
    if not all(one.status == "converged" for one in (*healthy, *now)):
        return None
    (mean, between, of_mean), (here, _, stddev) = (_mean(some) for some in (healthy, now))
    runs = len(healthy)
    limit = limit_of(runs, 1.0, POLICY.false / len(OF))
    expected = np.hypot(between * np.sqrt(1.0 + 1.0 / runs), of_mean)
    if not abs(here - mean) > np.hypot(limit * expected, POLICY.varied * stddev) + POLICY.worse:
        return None
    balance, words = OF[name]
    unit = now[0].unit
    before, after = (Value(float(np.exp(at)), float(np.exp(at) * by), unit)
                     for at, by in ((mean, np.hypot(between, of_mean)), (here, stddev)))
    return Change(name, "", balance, before, after, unit, (
        f"{words} is {with_uncertainty(after.value, after.stddev, unit)}, where {runs} healthy "
        f"recordings have {with_uncertainty(before.value, before.stddev, unit)}"))


def _free_runs(recordings: Sequence[Recording], settings: Settings, before: dict[str, float],
               after: dict[str, float]) -> dict[str, SignalFit]:
    """Return how far free runs with B and beta_e before and after miss each signal."""
    experiment = experiment_of(list(recordings), resolved(list(recordings), settings)[0], False)
    nominal, fits = unfitted(experiment), []
    for values in (before, after):
        theta = nominal.theta.copy()
        theta[B], theta[BETA_E] = values["B"], values["beta_e"]
        fits.append(with_unknowns(experiment, replace(nominal, theta=theta), nominal.unknowns))
    return shown(experiment, *fits)


def _mean(some: Sequence[ParameterEstimate]) -> tuple[float, float, float]:
    """Return mean, scatter, and deviation of the mean by the estimates' own, of logarithms."""
    values = np.log([one.value for one in some])
    own = np.array([one.stddev / one.value for one in some])
    scatter = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return float(values.mean()), scatter, float(np.sqrt(np.sum(own**2)) / len(own))
