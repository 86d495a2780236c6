"""A diagnosis as signals over time, and as a bag that PlotJuggler and Foxglove plot.

Measured, modelled, and what each balance lacks.
The model is that of a written config: its effects count as known, B and beta_e are fitted anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from eha_monitor.balances.candidates import Scale, balances_in, candidates_of
from eha_monitor.balances.measured import course_of
from eha_monitor.balances.policy import POLICY
from eha_monitor.balances.table import tables_of
from eha_monitor.breakdown import computing
from eha_monitor.estimation.hold_choice import resolved
from eha_monitor.mismatch.data.experiment import (
    OUTPUTS,
    Experiment,
    Stretch,
    by_balances,
    experiment_of,
)
from eha_monitor.mismatch.data.inputs import CLOSED, OPEN
from eha_monitor.mismatch.likelihood.fit import Fit, filtered, spread
from eha_monitor.mismatch.locate.terms import made_by, unexplained_terms
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.physics.contributions import ALL_NAMES
from eha_monitor.physics.parameters import theta_of
from eha_monitor.recordings.bag_writer import BagWriter
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.write import MessageStream, messages_of
from eha_monitor.settings.monitor import Settings

WINDOW = 0.5  # s that the model runs free before it starts again from the filter's state


# What a balance lacks without the named physics, SI (n,) each, NaN where unknown: in all, of that
# by the named effects, and without a name.
PARTS = ("needed", "explained", "remaining")
Lack = dict[str, np.ndarray]


@dataclass(frozen=True)
class Series:
    """Signals of a stretch of a recording."""

    source: str  # name of the recording
    start: float  # s
    dt: float  # s
    measured: dict[str, np.ndarray]  # channel -> (n,) SI
    modelled: dict[str, np.ndarray]  # the same of the model, running free
    # Balance (``force`` N, ``flow`` m³/s, ``drive`` rad/s) -> what it lacks
    lacks: dict[str, Lack]


def series_of(recordings: Sequence[Recording], before: Settings, after: Settings) -> list[Series]:
    """Return the signals of each stretch that the models see.

    Parameters
    ----------
    before, after : the config that was diagnosed, and with the named physics in it.

    Raises
    ------
    InputError
        If the recordings hold nothing that a model predicts.
    """
    with computing(*(recording.source for recording in recordings)):
        if by_balances(recordings, before):
            return _of_balances(recordings, before, after)
        held, _ = resolved(list(recordings), after)
        experiment, fit = nominal(experiment_of(list(recordings), held, False))
        known = theta_of(before.rig, before.effects)[1]
        named = theta_of(after.rig, after.effects)[1] & ~known
        names = tuple(ALL_NAMES[i] for i in np.flatnonzero(named))
        fit = replace(fit, named=tuple(ALL_NAMES[i] for i in np.flatnonzero(known)))
        bare = replace(fit, active=fit.active & ~named)
        lacks = _unknowns(experiment, bare, fit, names)
        modelled = spread(lambda stretch: free_everywhere(experiment, fit, stretch),
                          experiment.stretches)
        return [Series(stretch.source, stretch.start, experiment.dt,
                       _measured(experiment, stretch), modelled[i],
                       {balance: rows[i] for balance, rows in lacks.items()})
                for i, stretch in enumerate(experiment.stretches)]


def _measured(experiment: Experiment, stretch: Stretch) -> dict[str, np.ndarray]:
    found = {name: stretch.z[:, j] for j, name in enumerate(OUTPUTS)
             if np.isfinite(stretch.z[:, j]).any()}
    if experiment.mode == CLOSED:
        found["omega_d" if experiment.wanted_speed else "x_d"] = stretch.u[:, 0]
    elif experiment.mode == OPEN:
        found["omega"] = stretch.u[:, 0]
    else:
        found["force"] = stretch.u[:, 0]
    return found


def free_everywhere(experiment: Experiment, fit: Fit, stretch: Stretch) -> dict[str, np.ndarray]:
    """Return what the model shows running free for ``WINDOW`` s at a time, channel -> (n,).

    In two passes, of which each runs free where the other follows the recording.
    """
    turn = (np.arange(len(stretch)) // max(2, round(WINDOW / experiment.dt))) % 2 == 0
    shown = np.full_like(stretch.z, np.nan)
    for free in (turn, ~turn):
        e, _ = filtered(experiment, stretch, fit.theta, fit.active, fit.gains, free=free)
        shown[free] = (stretch.z - e)[free]
    return {OUTPUTS[j]: shown[:, j] for j in experiment.columns if np.isfinite(shown[:, j]).any()}


def _unknowns(experiment: Experiment, bare: Fit, fit: Fit, names: tuple[str, ...]
              ) -> dict[str, list[Lack]]:
    """Return what the filter's unknown force, flow and speed and the named effects make."""
    found: dict[str, list[Lack]] = {}
    for term in unexplained_terms(experiment, fit):
        made = [made_by(experiment, bare, fit, term.balance, stretch, track, names)
                for stretch, track in zip(experiment.stretches, term.tracks, strict=True)]
        found[term.balance] = [dict(zip(PARTS, (left + one, one, left), strict=True))
                               for left, one in zip(term.measured, made, strict=True)]
    return found


def _of_balances(recordings: Sequence[Recording], before: Settings, after: Settings
                 ) -> list[Series]:
    """Return what the balances of recordings lack, without and with the named effects.

    The rest is what B, a constant load, displacement and compliance leave, fitted beside them.
    """
    found = []
    for recording in recordings:
        plain, whole = course_of(recording, before), course_of(recording, after)
        time, scale, lacks = np.arange(len(recording)) * recording.sample_time, Scale.of(
            [whole]), {}
        for balance in balances_in([whole], after.rig):
            candidates = candidates_of(balance, scale, after.rig)
            bare, full = (tables_of([one], after.rig, balance, candidates, POLICY)[0]
                          for one in (plain, whole))
            always = [c.name for c in full.candidates if c.always]
            left = full.rows @ full.mixture(full.gram, always)
            explained = full.known - bare.known
            at = np.arange(len(left)) * full.dt
            gone = np.interp(time, at, (~full.good).astype(float)) > 0.01
            lacks[balance] = {part: np.where(gone, np.nan, np.interp(time, at, one))
                              for part, one in zip(PARTS, (
                                  left + explained, explained, left), strict=True)}
        measured = {name: recording.channels[name] for name in (
            *OUTPUTS, "x_d", "omega_d", "force") if recording.has(name)}
        found.append(Series(recording.source, 0.0, recording.sample_time, measured, {}, lacks))
    return found


FLOAT = "std_msgs/msg/Float64"
BETWEEN_NS = 1_000_000_000  # between recordings whose times overlap
LITTLE_ENDIAN = bytes([0, 1, 0, 0])  # head of a serialised message


def write_diagnosis_bag(path: Path, series: Sequence[Series], recordings: Sequence[Recording],
                        namespace: str) -> tuple[str, ...]:
    """Write the signals of a diagnosis as a bag; returns its topics.

    Time is that of the recordings; one that begins before another has ended is moved behind it.

    Raises
    ------
    InputError
        If the place is taken or cannot be written.
    """
    begins = _begins(recordings)
    whole = [_streams(one, begins[one.source], namespace.rstrip("/")) for one in series]
    types = {stream.topic: stream.msgtype for streams in whole for stream in streams}
    bag = BagWriter(path, types)
    try:
        for streams in whole:
            bag.write_many({stream.topic: (stream.stamps, stream.data) for stream in streams})
        bag.close()
    except KeyboardInterrupt:
        bag.discard()
        raise
    return tuple(types)


def _begins(recordings: Sequence[Recording]) -> dict[str, int]:
    """Return the time of the first sample of each recording, ns, none inside another."""
    found, end = {}, 0
    for one in sorted(recordings, key=lambda recording: recording.start_ns):
        begin = max(one.start_ns, end)
        found[one.source] = begin
        end = begin + round(one.duration * 1e9) + BETWEEN_NS
    return found


def _streams(one: Series, begin: int, namespace: str) -> list[MessageStream]:
    length = len(next(iter(one.measured.values())))
    stamps = begin + np.round((one.start + np.arange(length) * one.dt) * 1e9).astype(np.int64)
    found = []
    for part, channels in (("measured", one.measured), ("modelled", one.modelled)):
        if channels:
            found += messages_of(channels, stamps, f"{namespace}/{part}")
    for balance, lack in one.lacks.items():
        for part, values in lack.items():
            there = np.isfinite(values)
            found.append(MessageStream(f"/{namespace.strip('/')}/missing/{balance}/{part}".replace(
                "//", "/"), FLOAT, stamps[there], _floats(values[there])))
    return found


def _floats(values: np.ndarray) -> np.ndarray:
    """Return std_msgs/Float64 messages in CDR, (n, 12) uint8."""
    rows = np.empty((len(values), 12), dtype=np.uint8)
    rows[:, :4] = np.frombuffer(LITTLE_ENDIAN, dtype=np.uint8)
    rows[:, 4:] = np.ascontiguousarray(values, dtype="<f8").view(np.uint8).reshape(-1, 8)
    return rows
