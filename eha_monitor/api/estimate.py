"""``estimate`` in Python: B and the bulk modulus of a recording, judged against the thresholds."""

import math
import os
import time
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eha_monitor.api.common import Progress, Record, calling, chosen, frame_of, read_only, reporter
from eha_monitor.api.config import Config, path_of
from eha_monitor.api.read import (
    Given,
    ImplausibleError,
    checked,
    config_for,
    recordings_of,
)
from eha_monitor.api.recording import Recording
from eha_monitor.compiled import load_runtime
from eha_monitor.errors import InputError
from eha_monitor.estimation.inputs import time_of
from eha_monitor.estimation.joint import ObservabilityTable, observability
from eha_monitor.estimation.pipeline import estimate as run
from eha_monitor.estimation.results import NEAR_S, ParameterEstimate, converged_where, stands
from eha_monitor.estimation.results import Estimate as Found
from eha_monitor.health.alarms import Alarm, ParameterSeries, judge_series
from eha_monitor.indicators.assemble import evidence_of_estimate, indicators
from eha_monitor.indicators.indicator import Indicator
from eha_monitor.output import finite, write_text
from eha_monitor.quantity import SYMBOLS
from eha_monitor.recordings.columns import blocks
from eha_monitor.recordings.recording import SHORTEST_S
from eha_monitor.recordings.recording import Recording as InnerRecording

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


def estimate(recording: Given, config: Config | str | os.PathLike | dict | None = None, *,
             progress: Progress = False) -> "Estimate":
    """Estimate B and the effective bulk modulus, and judge them against the thresholds.

    Parameters
    ----------
    recording : Recording or path
        What was recorded; a path is read with the config.
    config : Config, path, mapping or None
        The rig and how to judge it; without it what the recording was read or simulated with,
        and of a path the paper's EHA.
    progress : bool or callable
        True: a line on the standard error; a function is called with (text, share from 0 to 1).

    Returns
    -------
    Estimate
        The answer of the command ``estimate``.

    Raises
    ------
    InputError
        One line: what is wrong with recording or config.
    ImplausibleError
        If the recording's channels contradict the config (signs, units, swapped channels).

    Examples
    --------
    >>> e = em.estimate("bags/air_ingress")
    >>> e.parameters["B"].shown, e.parameters["B"].status
    ('599.8 ± 0.2 N·s/m', 'converged')
    >>> [alarm.name for alarm in e.alarms if alarm.level == "WARN"]
    ['bulk_modulus_low']
    """
    with calling():
        say, config = reporter(progress), config_for(recording, config, "recording")
        load_runtime()
        started = time.perf_counter()
        say(f"reading {_named(recording)}", 0.0)
        recorded, *others = recordings_of(recording, config, "recording")
        if others:
            raise InputError(f"recording: expected one, got {1 + len(others)}: "
                             "[em.estimate(one) for one in ...]")
        (recorded,), channels = checked([recorded], config.settings)
        refuse_short(recorded)  # a clock that runs wrong has been reported before
        say("estimating", 0.2)
        found = run(recorded, config.settings)
        channels = (*channels, *found.channels)
        alarms, history = judged(found)
        made = Estimate(**vars(found) | {
            "recording": Recording.of(recorded, config), "channels": channels,
            "warnings": (*found.warnings, *(finding.finding for finding in channels)),
            # What a user waits for: the file is read within this time.
            "wall_s": time.perf_counter() - started},
            config=config, alarms=alarms, alarm_history=history)
        say("estimated", 1.0)
    return made


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Estimate(Record, Found):
    """What :func:`estimate` found in one recording; B in N·s/m, beta_e in Pa.

    Attributes
    ----------
    recording : Recording
        What was recorded.
    joint : JointResult or None
        B, beta_e and leakage L at once, of pressures and pump speed; None without them.
    model : ModelStatus
        Whether the model explains the recording: status, message, mismatches.
    stage_one : StageResult
        Stage one over time: time, value and stddev of B, states, innovations; (n,) each.
    stage_two : StageResult
        Stage two over time: time, value and stddev of beta_e, states, innovations.
    events : tuple of Event
        What the stages did: converged, detected a change, were reset.
    warnings : tuple of str
        Sentences on what limits the answer.
    config : Config
        What it was made with.
    alarms : tuple of Alarm
        Each alarm at the end of the recording: name, level, message, time_s.
    alarm_history : tuple of Alarm
        Every change of a level, in order of time.
    channels : tuple of ChannelFinding
        What the channels say of the config where it may be wrong, or of the hold of the demand.
    """

    recording: Recording
    config: Config
    alarms: tuple[Alarm, ...]
    alarm_history: tuple[Alarm, ...]

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """``B`` of stage one, ``beta_e`` of stage two: value, stddev, unit, status, message."""
        return read_only(super().parameters)

    @cached_property
    def observability(self) -> ObservabilityTable:
        """Which combination of channels would estimate B, beta_e and leakage, and how well.

        Relative standard deviations (Cramér-Rao bound); computed when first requested.
        """
        with calling():
            # The filters take arrays that can be written.
            return observability(Found(**{one.name: getattr(self, one.name) for one in
                                          fields(Found)} | {"recording": self.recording.inner}))

    @cached_property
    def indicators(self) -> tuple[Indicator, ...]:
        """Health in units to act on, leakage to drive lag; or why not (docs/health.md)."""
        return indicators(evidence_of_estimate(self), self.settings)

    @property
    def healthy(self) -> bool:
        """Whether no alarm stands and the model fits: exit status 0 with ``--exit-code``."""
        return self.model.status != "mismatch" and not any(
            alarm.level in ("WARN", "ERROR") for alarm in self.alarms)

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as JSON's plain types.

        Returns
        -------
        dict
            What ``eha-monitor estimate --json`` writes (schema ``eha_monitor/estimate/1``).

        Examples
        --------
        >>> e.to_dict()["schema"]
        'eha_monitor/estimate/1'
        """
        return answer(self, self.alarms, self.alarm_history, self.observability) | {
            "channels": finite(self.channels),
            "indicators": [one.tree(self.config.settings) for one in self.indicators]}

    def to_frame(self, table: str = "parameters") -> "pandas.DataFrame":
        """Return a table of the answer.

        Parameters
        ----------
        table : str
            ``parameters`` (a row for each estimator and parameter), ``course`` (B and beta_e
            with their standard deviations as they converge, index ``time_s``), ``alarms``,
            ``alarm_history`` or ``events``.

        Returns
        -------
        pandas.DataFrame
            SI units.

        Raises
        ------
        InputError
            If there is no such table.

        Examples
        --------
        >>> list(e.to_frame().index)
        ['B', 'beta_e', 'B', 'beta_e', 'L']
        >>> list(e.to_frame("course").columns)
        ['B', 'B_stddev', 'beta_e', 'beta_e_stddev']
        """
        return chosen(table, {
            "parameters": self._parameters, "course": self._course,
            "alarms": lambda: _alarms(self.alarms),
            "alarm_history": lambda: _alarms(self.alarm_history),
            "events": lambda: frame_of(map(asdict, self.events),
                                       ("time_s", "stage", "message"))}, "table")()

    def plot(self, what: str = "parameters") -> "Figure":
        """Draw B and beta_e as they converge, with their band and the alarm limits.

        Parameters
        ----------
        what : str
            ``parameters`` (both), ``B`` or ``beta_e``.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("estimate.png")`` keeps it.

        Raises
        ------
        InputError
            If there is no such picture.
        """
        from eha_monitor.reports.api_figures import estimate_drawing

        names = chosen(what, {"parameters": lambda: ("B", "beta_e"), "B": lambda: ("B",),
                              "beta_e": lambda: ("beta_e",)}, "what")()
        return estimate_drawing(self, names)

    def report(self, path: str | os.PathLike) -> Path:
        """Write the self-contained HTML report of ``eha-monitor estimate --report``.

        Parameters
        ----------
        path : str or path
            The file; it is replaced when the new one is complete.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        from eha_monitor.reports.estimate_report import estimate_page

        with calling():
            place = path_of(path, "a file to write")
            write_text(place, estimate_page(self, self.alarms, self.alarm_history,
                                            self.observability, self.indicators))
            return place

    def _parameters(self) -> "pandas.DataFrame":
        return frame_of(({"parameter": p.name, "estimator": estimator} | _parameter(p)
                         for estimator, p in by_estimator(self)),
                        ("parameter", "estimator", "value", "stddev", "unit", "status",
                         "message"), "parameter")

    def _course(self) -> "pandas.DataFrame":
        import pandas

        columns = {}
        for name, stage in (("B", self.stage_one), ("beta_e", self.stage_two)):
            for column, values in ((name, stage.value), (f"{name}_stddev", stage.stddev)):
                index = pandas.Index(stage.time, name="time_s", dtype=float)
                columns[column] = pandas.Series(values, index, dtype=float)
        return pandas.DataFrame(columns).rename_axis("time_s")

    def _short(self):
        rows = [[estimator, SYMBOLS.get(p.name, p.name), p.shown, p.status]
                for estimator, p in by_estimator(self)]
        rows += [["alarm", alarm.name, alarm.message, alarm.word] for alarm in self.alarms
                 if alarm.level != "OK"]
        return (self.recording.source or "recording",
                f"model: {self.model.status}: {self.model.message}",
                ("estimator", "parameter", "value", "status"), rows,
                tuple(f"lost: {loss}" for loss in self.recording.losses)
                + tuple(f"note: {warning}" for warning in self.warnings))


def by_estimator(found: Found) -> list[tuple[str, ParameterEstimate]]:
    """Return every parameter with the estimator that it is of."""
    return [*((f"stage {stage.stage}", stage.estimate)
              for stage in (found.stage_one, found.stage_two)),
            *(("joint", one) for one in (found.joint.parameters.values() if found.joint else ()))]


def refuse_short(recording: InnerRecording) -> None:
    """Refuse a recording that is shorter than any answer needs."""
    if recording.duration < SHORTEST_S:
        raise InputError(f"{recording.source}: expected a recording of at least {SHORTEST_S:g} s, "
                         f"found {recording.duration:.3g} s")


def _alarms(alarms: tuple[Alarm, ...]) -> "pandas.DataFrame":
    return frame_of(map(asdict, alarms), ("name", "level", "message", "time_s"))


def _named(recording: Any) -> str:
    return recording.source if isinstance(recording, Recording) else str(recording)


# ---- the alarms, and the JSON of the contract --------------------------------------------------

SCHEMA = "eha_monitor/estimate/1"


def judged(found: Found) -> tuple[tuple[Alarm, ...], tuple[Alarm, ...]]:
    """Return the alarms at the end of the recording, and every change of a level."""
    recording = found.recording
    temperature = recording.get("temperature") if recording.has("temperature") else None
    measured = recording.get("x") if recording.has("x") else None
    return judge_series(found.settings, time_of(recording), series_of(found), temperature,
                        measured, found.model.tainted, found.beside)


def series_of(found: Found) -> dict[str, ParameterSeries]:
    """Return each parameter as it converged, as the alarms judge it."""
    stages = {"B": found.stage_one, "beta_e": found.stage_two}
    first, second = found.settings.stage_one, found.settings.stage_two
    priors = {"B": (first.prior, first.prior_stddev),
              "beta_e": (second.prior, second.prior_stddev, second.largest)}
    return {name: ParameterSeries(
        stage.estimate, stage.value, stage.stddev,
        lambda value, stddev, prior=priors[name]: converged_where(value, stddev, *prior))
        for name, stage in stages.items()}


def judged_series(found: Found) -> dict[str, ParameterSeries]:
    """Return each parameter as the alarms judge it: by least squares where its stage is in doubt.

    What nothing determines has not converged.  The stage's value from before the mismatch showed
    counts no more: a model that does not fit did not fit before either.
    """
    series, time = series_of(found), time_of(found.recording)
    times = [one.time_s for one in found.beside]
    for name, taint in found.model.tainted.items():
        one = series[name]
        if not len(one.value):
            continue
        looks = [stands(found.beside, at, name) for at in times]
        place = np.searchsorted(times, time - time[0] + NEAR_S, side="right")
        value, stddev = (np.array([math.nan, *(
            getattr(look, key) if look else math.nan for look in looks)])[place]
            for key in ("value", "stddev"))
        series[name] = ParameterSeries(
            found.parameters[name] if taint.instead else replace(one.final, status="not_excited"),
            value, stddev, np.isfinite(value))
    return series


def answer(found: Found, alarms: tuple[Alarm, ...], history: tuple[Alarm, ...],
           observable: ObservabilityTable | None = None) -> dict:
    """Return the JSON tree: the contract's keys, then what extends it.  NaN becomes null."""
    recording = found.recording
    return finite(_head(recording, found.wall_s) | {
        "parameters": {name: {**_parameter(p), "by": found.model.origin(name),
                              "in_doubt": found.model.in_doubt(name)}
                       for name, p in found.parameters.items()},
        "alarms": alarms, "model": found.model,
        "stages": {stage.stage: {"parameter": stage.estimate.name, **_parameter(stage.estimate),
                                 "consistency": stage.consistency}
                   for stage in (found.stage_one, found.stage_two)},
        "joint": found.joint and {
            "parameters": {n: _parameter(p) for n, p in found.joint.parameters.items()},
            "correlation": found.joint.correlation, "message": found.joint.message},
        "least_squares": [{"time_s": one.time_s, "parameters": {
            name: _parameter(p) for name, p in one.parameters.items()}} for one in found.beside],
        "observability": None if observable is None else observable.rows,
        "noise": found.noise,
        "channel_samples": {name: sum(int(np.isfinite(rows).sum())
                                      for _, _, (rows,) in blocks(values))
                            for name, values in recording.channels.items()},
        "events": found.events, "alarm_history": history,
        "losses": list(recording.losses), "warnings": list(found.warnings)})


def refusal(problem: ImplausibleError) -> dict:
    """Return the JSON tree of a recording that contradicts its config; no number is given."""
    recording, message = problem.recordings[0], str(problem)
    nothing = {"value": None, "stddev": None, "status": "no_data", "message": message}
    return finite(_head(recording, 0.0) | {
        "parameters": {"B": nothing, "beta_e": nothing}, "alarms": [],
        "model": {"status": "not_judged", "message": message, "mismatches": [], "tainted": {}},
        "channels": problem.channels, "losses": list(recording.losses), "warnings": [message]})


def _head(recording: InnerRecording, wall_s: float) -> dict:
    return {"schema": SCHEMA, "bag": recording.source, "samples": len(recording),
            "duration_s": recording.duration, "wall_s": wall_s}


def _parameter(p: ParameterEstimate) -> dict:
    return {"value": p.value, "stddev": p.stddev, "unit": p.unit, "status": p.status,
            "message": p.message}
