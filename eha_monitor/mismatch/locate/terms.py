"""The missing term of each balance: what the record needs, and what the named effects make."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, Stretch, smooth
from eha_monitor.mismatch.likelihood.along import signals_along
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.likelihood.innovations import smoothed
from eha_monitor.mismatch.locate.missing import (
    balance_flow,
    erring_outputs,
    modelled_error,
    modelled_flow,
    modelled_force,
    modelled_speed,
    without,
)
from eha_monitor.mismatch.name.base import limits_of
from eha_monitor.mismatch.name.refit import at_level
from eha_monitor.physics import signals as s
from eha_monitor.physics.effects import CATALOGUE
from eha_monitor.physics.plant import Y_FLOW, Y_FORCE, Y_SPEED

BALANCES = ("force", "flow", "drive", "sensor")
UNITS = {"force": "N", "flow": "m³/s", "drive": "rad/s"}
STATES = {"force": Y_FORCE, "flow": Y_FLOW, "drive": Y_SPEED}
SENSORS = {0: s.X, 2: s.P1, 3: s.P2}  # output -> what it ought to show
VISIBLE = 0.3  # of a sensor's noise: an error below needs no curve


@dataclass(frozen=True)
class Missing:
    """A missing term along each stretch.

    Attributes
    ----------
    balance : whose term it is; ``unit`` its unit.
    tracks : for each stretch (n, N_SIGNALS), the smoothed trajectory.
    measured : for each stretch (n,), what the record needs; NaN where it does not say.
    modelled : for each stretch (n,), what the named effects make; None where nothing is named.
    output : place of the sensor that errs, or -1.
    """

    balance: str
    unit: str
    tracks: tuple[np.ndarray, ...]
    measured: tuple[np.ndarray, ...]
    modelled: tuple[np.ndarray, ...] | None = None
    output: int = -1

    @property
    def best(self) -> tuple[np.ndarray, ...]:
        """The modelled term, which has no noise, or else the measured one."""
        return self.measured if self.modelled is None else self.modelled


def missing_terms(experiment: Experiment, before: Fit, after: Fit | None) -> list[Missing]:
    """Return the missing terms of the balances that the named effects are in, or of all.

    With named effects ``measured`` is what the record needs when those of that balance are
    switched off in ``after``: at its B and beta_e, so that neither absorbs a part of the term.
    """
    if after is None or not after.named:
        return unexplained_terms(experiment, before)

    def one(balance: str) -> list[Missing]:
        names = tuple(name for name in after.named if CATALOGUE[name].balance == balance)
        if not names:
            return []
        base = without(before, after, balance)
        found = sensor_terms(experiment, base, after, balance)
        if balance in UNITS and set(names) != {"backlash"}:
            found.append(balance_term(experiment, base, after, balance, names))
        return found

    return [term for terms in spread(one, BALANCES) for term in terms]


def unexplained_terms(experiment: Experiment, fit: Fit) -> list[Missing]:
    """Return the unknown force, flow and speed that a fit needs, smoothed."""
    states = smoothed(experiment, fit)
    tracks = tracks_of(experiment, states)
    small, large = (limit.as_array() for limit in limits_of(experiment))
    return [Missing(balance, UNITS[balance], tracks,
                    tuple(one[:, STATES[balance]] for one in states))
            for i, balance in enumerate(UNITS) if large[i] > small[i]]


def tracks_of(experiment: Experiment, states: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the signals along each stretch."""
    return tuple(signals_along(experiment, stretch, one)
                 for stretch, one in zip(experiment.stretches, states, strict=True))


def following(experiment: Experiment, base: Fit, balance: str) -> Fit:
    """Return a fit whose unknown of one balance follows what the record needs, no other."""
    low = smallest_unknowns(experiment).as_array()
    i = list(UNITS).index(balance)
    floor = np.minimum(base.unknowns.as_array(), 10.0 * low)
    floor[i] = 10.0 * low[i]
    start, high = floor.copy(), floor.copy()
    start[i] = 300.0 * low[i]
    high[i] = max(limits_of(experiment)[1].as_array()[i], 1e3 * low[i])
    return at_level(experiment, with_unknowns(experiment, base, Unknowns(*start)),
                    (Unknowns(*floor), Unknowns(*high)))


def balance_term(experiment: Experiment, base: Fit, after: Fit, balance: str,
                 names: tuple[str, ...]) -> Missing:
    """Return a missing force, flow or speed."""
    states = smoothed(experiment, following(experiment, base, balance))
    tracks = tracks_of(experiment, states)
    measured = tuple(one[:, STATES[balance]] for one in states)
    if balance == "force":
        modelled = tuple(modelled_force(experiment, after, track, names) for track in tracks)
    elif balance == "drive":
        modelled = tuple(modelled_speed(experiment, base, after, stretch, track)
                         for stretch, track in zip(experiment.stretches, tracks, strict=True))
    else:
        modelled = tuple(modelled_flow(experiment, after, track, names) for track in tracks)
        shown = tuple(as_measured(stretch, track)
                      for stretch, track in zip(experiment.stretches, tracks, strict=True))
        both = tuple(modelled_flow(experiment, after, track, names, common=True)
                     for track in shown)
        if experiment.used[2] and experiment.used[3] and rms(both) > rms(modelled):
            # Lost to outside or swallowed by both chambers: no flow across shows that.
            modelled, tracks = both, shown
            measured = tuple(balance_flow(experiment, base, stretch, track)
                             for stretch, track in zip(experiment.stretches, tracks, strict=True))
    return Missing(balance, UNITS[balance], tracks, measured, modelled)


def as_measured(stretch: Stretch, track: np.ndarray) -> np.ndarray:
    """Return a trajectory with the pressures that were measured, where they were.

    No unknown of the filter moves the mean pressure, so a model that lacks a leak to outside
    does not follow it.
    """
    other = track.copy()
    for output in (2, 3):
        if np.isfinite(stretch.z[:, output]).any():
            other[:, SENSORS[output]] = smooth(stretch.z[:, output], 0.0)
    return other


def rms(parts: tuple[np.ndarray, ...]) -> float:
    """Return the root mean square over all stretches."""
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def sensor_terms(experiment: Experiment, base: Fit, after: Fit, balance: str) -> list[Missing]:
    """Return what sensors show beyond what all others imply, and what their model says."""
    outputs = [output for output in erring_outputs(base, after) if experiment.used[output]]
    if not outputs:
        return []
    tracks = tracks_of(experiment, smoothed(experiment, with_unknowns(
        experiment, after, after.unknowns)))
    outputs = [output for output in outputs
               if rms(tuple(modelled_error(after, track, output) for track in tracks))
               > VISIBLE * experiment.noise[output]]
    return sensor_errors(experiment, base, balance, outputs, after)


def sensor_errors(experiment: Experiment, base: Fit, balance: str, outputs: list[int],
                  after: Fit | None = None) -> list[Missing]:
    """Return the errors of some sensors, found from all other channels."""
    used = experiment.used.copy()
    used[outputs] = False
    if not outputs or not used.any():
        return []
    others = replace(experiment, used=used)
    tracks = tracks_of(others, smoothed(others, with_unknowns(others, base)))
    return [Missing(
        balance, "m" if output == 0 else "Pa", tracks,
        tuple(stretch.z[:, output] - track[:, SENSORS[output]]
              for stretch, track in zip(experiment.stretches, tracks, strict=True)),
        None if after is None else tuple(modelled_error(after, track, output)
                                         for track in tracks), output) for output in outputs]
