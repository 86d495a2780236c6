"""The missing term of each balance: what the record needs, and what the named effects make."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.balances.candidates import SIDES
from eha_monitor.balances.least_squares import rms
from eha_monitor.estimation.sensors import PRESSURE_ERRORS
from eha_monitor.mismatch.data.experiment import Experiment, Stretch, smooth
from eha_monitor.mismatch.likelihood.along import (
    contributed,
    drive_along,
    played,
    signals_along,
    smoothed,
)
from eha_monitor.mismatch.likelihood.fit import Fit, spread, with_unknowns
from eha_monitor.mismatch.likelihood.gains import Unknowns, smallest_unknowns
from eha_monitor.mismatch.name.columns import PLACES
from eha_monitor.mismatch.name.refit import at_level
from eha_monitor.mismatch.name.starts import limits_of
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of
from eha_monitor.physics.plant import shown_position
from eha_monitor.recordings.grid import filled

DRIVE_STEPS = 5  # in a sample; a lag below half a step is taken as none


def without(before: Fit, after: Fit, balance: str) -> Fit:
    """Return the fit ``after`` with the effects of one balance as they were in ``before``."""
    theta, active = after.theta.copy(), after.active.copy()
    gone = [name for name in after.named if CATALOGUE[name].balance == balance]
    for name in gone:
        active[NAMES.index(name)] = before.active[NAMES.index(name)]
        for p in CATALOGUE[name].parameters:
            place = place_of(f"{name}.{p.name}")
            theta[place] = before.theta[place]
    return replace(after, theta=theta, active=active,
                   named=tuple(name for name in after.named if name not in gone))


def modelled_force(experiment: Experiment, fit: Fit, trajectory: np.ndarray,
                   names: tuple[str, ...]) -> np.ndarray:
    """Return the force against positive motion that some effects make, N (n,)."""
    c = contributed(experiment, fit.theta, trajectory, names)
    return c[:, s.FORCE] + c[:, s.MASS] * np.gradient(trajectory[:, s.V], experiment.dt)


def modelled_flow(experiment: Experiment, fit: Fit, trajectory: np.ndarray,
                  names: tuple[str, ...], common: bool = False) -> np.ndarray:
    """Return the flow from chamber 2 into 1 that does what some effects do, m^3/s (n,).

    Softer oil or a larger chamber swallow flow when the pressure rises.  ``common`` : the flow
    into both chambers in place of that across.
    """
    theta = fit.theta
    c = contributed(experiment, fit.theta, trajectory, names)
    others = contributed(experiment, fit.theta, trajectory,
                         tuple(name for name in fit.named if name not in names))
    pumped = theta[s.D_P] * c[:, s.SPEED]
    flows = []
    for sign, flow, more, volume, chamber, pressure in (
            (1.0, s.FLOW_1, s.COMPLIANCE_1, s.VOLUME_1, s.VOL_1, s.P1),
            (-theta[s.AREA_2] / theta[s.AREA_1], s.FLOW_2, s.COMPLIANCE_2, s.VOLUME_2, s.VOL_2,
             s.P2)):
        soft = 1.0 / theta[s.BETA_E] + others[:, more]
        plain = (theta[chamber] + others[:, volume]) * soft
        whole = (theta[chamber] + others[:, volume] + c[:, volume]) * (soft + c[:, more])
        rate = np.gradient(trajectory[:, pressure], experiment.dt)
        flows.append((c[:, flow] + sign * pumped - (whole - plain) * rate) / plain)
    # An unknown flow q moves the pressures by q/C1 and -q/C2.
    plain = 1.0 / theta[s.VOL_1] + 1.0 / theta[s.VOL_2]
    second = flows[1] if common else -flows[1]
    return (flows[0] + second) / (plain * theta[s.BETA_E])


def balance_flow(experiment: Experiment, fit: Fit, stretch: Stretch,
                 trajectory: np.ndarray) -> np.ndarray:
    """Return the flow into both chambers alike that the measured pressures need, m^3/s (n,).

    ``fit`` : the model without the effects in question.
    """
    theta = fit.theta
    c = contributed(experiment, fit.theta, trajectory, fit.named)
    p = [filled(stretch.z[:, 2]), filled(stretch.z[:, 3])]
    pumped = theta[s.D_P] * (trajectory[:, s.OMEGA] + c[:, s.SPEED])
    makeup, v = theta[s.G_MAKEUP], trajectory[:, s.V]
    crossing = 0.5 * (theta[s.C_T] - makeup) * (p[0] - p[1])
    rows = []
    for i, (moved, chamber, volume, more, flow) in enumerate((
            (pumped - theta[s.AREA_1] * v - crossing, s.VOL_1, s.VOLUME_1, s.COMPLIANCE_1,
             s.FLOW_1),
            (-pumped * theta[s.AREA_2] / theta[s.AREA_1] + theta[s.AREA_2] * v + crossing,
             s.VOL_2, s.VOLUME_2, s.COMPLIANCE_2, s.FLOW_2))):
        into = moved - makeup * (p[i] - theta[s.P_CHARGE]) + c[:, flow]
        capacity = (theta[chamber] + c[:, volume]) * (1.0 / theta[s.BETA_E] + c[:, more])
        rows.append((np.gradient(p[i], experiment.dt) - into / capacity, capacity))
    return (rows[0][0] + rows[1][0]) / (1.0 / rows[0][1] + 1.0 / rows[1][1])


def modelled_speed(experiment: Experiment, base: Fit, fit: Fit, stretch: Stretch,
                   trajectory: np.ndarray) -> np.ndarray:
    """Return the shaft speed that the drive of ``fit`` makes beyond that of ``base``, (n,)."""
    made = []
    for one in (fit, base):
        out = np.zeros(len(trajectory))
        drive_along(np.ascontiguousarray(trajectory[:, s.X]), stretch.u, experiment.dt,
                    DRIVE_STEPS, one.theta, circuit_of(one.theta, one.active), out)
        made.append(out)
    return made[0] - made[1]


def made_by(experiment: Experiment, base: Fit, fit: Fit, balance: str, stretch: Stretch,
            trajectory: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return the force, flow or shaft speed that some effects of ``fit`` make, SI (n,).

    Of the drive what ``fit`` makes beyond ``base``, which is without them.
    """
    if balance == "force":
        return modelled_force(experiment, fit, trajectory, names)
    if balance == "flow":
        return modelled_flow(experiment, fit, trajectory, names)
    return modelled_speed(experiment, base, fit, stretch, trajectory)


def erring_outputs(base: Fit, fit: Fit) -> tuple[int, ...]:
    """Return the outputs whose sensors err in ``fit`` and not in ``base``."""
    change = circuit_of(fit.theta, fit.active) != circuit_of(base.theta, base.active)
    of = {0: (s.POSITION_DELAY, s.POSITION_SCALE, s.PLAY),
          2: (s.PRESSURE_DELAY, *PRESSURE_ERRORS["p1"]),
          3: (s.PRESSURE_DELAY, *PRESSURE_ERRORS["p2"])}
    return tuple(output for output, errors in of.items() if change[[*errors]].any())


def modelled_error(fit: Fit, trajectory: np.ndarray, output: int) -> np.ndarray:
    """Return by how much a sensor of ``fit`` shows too much, m or Pa (n,)."""
    w = circuit_of(fit.theta, fit.active)
    time = trajectory[:, s.T]
    if output == 0:
        true = trajectory[:, s.X]
        late = np.interp(time - w[s.POSITION_DELAY], time, true)
        if w[s.PLAY] > 0.0:
            late = played(late, w[s.PLAY])
        return shown_position.py_func(late, w) - true
    scale, offset, drift = PRESSURE_ERRORS["p1" if output == 2 else "p2"]
    true = trajectory[:, SENSORS[output]]
    late = np.interp(time - w[s.PRESSURE_DELAY], time, true)
    return (1.0 + w[scale]) * late + w[offset] + w[drift] * time - true


BALANCES = ("force", "flow", "drive", "sensor")
SENSORS = {0: s.X, 2: s.P1, 3: s.P2}  # output -> what it ought to show
VISIBLE = 0.3  # of a sensor's noise: an error below needs no curve


@dataclass(frozen=True)
class Missing:
    """A missing term along each stretch."""

    balance: str  # whose term it is
    unit: str
    tracks: tuple[np.ndarray, ...]  # for each stretch (n, N_SIGNALS), the smoothed trajectory
    measured: tuple[np.ndarray, ...]  # (n,) each, what the record needs; NaN where it does not say
    modelled: tuple[np.ndarray, ...] | None = None  # (n,) each, what the named effects make


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
        if balance in SIDES and set(names) != {"backlash"}:
            found.append(balance_term(experiment, base, after, balance, names))
        return found

    return [term for terms in spread(one, BALANCES) for term in terms]


def unexplained_terms(experiment: Experiment, fit: Fit) -> list[Missing]:
    """Return the unknown force, flow and speed that a fit needs, those that are possible."""
    small, large = (limit.as_array() for limit in limits_of(experiment))
    return unknown_terms(experiment, fit, [
        balance for balance, able in zip(SIDES, large > small, strict=True) if able])


def unknown_terms(experiment: Experiment, fit: Fit, balances: Sequence[str]) -> list[Missing]:
    """Return the unknowns of some balances that a fit needs, smoothed."""
    states = smoothed(experiment, fit)
    tracks = tracks_of(experiment, states)
    return [Missing(balance, SIDES[balance], tracks,
                    tuple(one[:, PLACES[balance]] for one in states)) for balance in balances]


def tracks_of(experiment: Experiment, states: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return the signals along each stretch."""
    return tuple(signals_along(experiment, stretch, one)
                 for stretch, one in zip(experiment.stretches, states, strict=True))


def following(experiment: Experiment, base: Fit, balance: str) -> Fit:
    """Return a fit whose unknown of one balance follows what the record needs, no other."""
    low = smallest_unknowns(experiment).as_array()
    i = list(SIDES).index(balance)
    floor = np.minimum(base.unknowns.as_array(), 10.0 * low)
    floor[i] = 10.0 * low[i]
    start, high = floor.copy(), floor.copy()
    start[i] = 300.0 * low[i]
    high[i] = max(limits_of(experiment)[1].as_array()[i], 1e3 * low[i])
    return at_level(experiment, with_unknowns(experiment, base, Unknowns(*start)),
                    (Unknowns(*floor), Unknowns(*high)))


def needed(experiment: Experiment, base: Fit, balance: str) -> Missing:
    """Return the force, flow or speed that the record needs beside a model."""
    return unknown_terms(experiment, following(experiment, base, balance), [balance])[0]


def balance_term(experiment: Experiment, base: Fit, after: Fit, balance: str,
                 names: tuple[str, ...]) -> Missing:
    """Return a missing force, flow or speed."""
    lacking = needed(experiment, base, balance)
    tracks, measured = lacking.tracks, lacking.measured
    modelled = tuple(made_by(experiment, base, after, balance, stretch, track, names)
                     for stretch, track in zip(experiment.stretches, tracks, strict=True))
    if balance == "flow" and experiment.used[2] and experiment.used[3]:
        shown = tuple(as_measured(stretch, track)
                      for stretch, track in zip(experiment.stretches, tracks, strict=True))
        both = tuple(modelled_flow(experiment, after, track, names, common=True)
                     for track in shown)
        if rms(np.concatenate(both)) > rms(np.concatenate(modelled)):
            # Lost to outside or swallowed by both chambers: no flow across shows that.
            modelled, tracks = both, shown
            measured = tuple(balance_flow(experiment, base, stretch, track)
                             for stretch, track in zip(experiment.stretches, tracks, strict=True))
    return Missing(balance, SIDES[balance], tracks, measured, modelled)


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


def sensor_terms(experiment: Experiment, base: Fit, after: Fit, balance: str) -> list[Missing]:
    """Return what sensors show beyond what all others imply, and what their model says."""
    outputs = [output for output in erring_outputs(base, after) if experiment.used[output]]
    if not outputs:
        return []
    tracks = tracks_of(experiment, smoothed(experiment, with_unknowns(experiment, after)))
    outputs = [output for output in outputs
               if rms(np.concatenate([modelled_error(after, track, output) for track in tracks]))
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
                                         for track in tracks)) for output in outputs]
