"""What named effects make along a trajectory: the modelled side of the missing term's curve."""

from dataclasses import replace

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.mismatch.experiment import Experiment, Stretch
from eha_monitor.mismatch.fit import Fit
from eha_monitor.mismatch.innovations import CLOSED, FORCED
from eha_monitor.mismatch.inputs import filled
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import (
    add_contributions,
    circuit_of,
    new_memory,
    update_memory,
    with_term,
    with_update,
)
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of
from eha_monitor.physics.plant import (
    Y_OMEGA,
    Y_P1,
    Y_P2,
    Y_SPEED,
    Y_V,
    Y_X,
    drive_rate,
    drive_speed,
    input_at,
    shaft_speed,
)

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


def signals_along(experiment: Experiment, stretch: Stretch, states: np.ndarray) -> np.ndarray:
    """Return the signals of the equations on a smoothed trajectory, (n, N_SIGNALS)."""
    n = len(states)
    found = np.zeros((n, s.N_SIGNALS))
    found[:, s.T] = np.arange(n) * experiment.dt
    found[:, s.X], found[:, s.V] = states[:, Y_X], states[:, Y_V]
    if experiment.mode == FORCED:
        found[:, s.P1], found[:, s.P2] = stretch.p1, stretch.p2
        return found
    found[:, s.P1], found[:, s.P2] = states[:, Y_P1], states[:, Y_P2]
    if experiment.used[4]:  # nearer to the truth than any model of the drive
        speed = stretch.z[:, 4]
        bridged = states[:, Y_OMEGA] + states[:, Y_SPEED]
        found[:, s.OMEGA] = np.where(np.isfinite(speed), speed, bridged)
    elif experiment.mode == CLOSED:
        found[:, s.OMEGA] = states[:, Y_OMEGA] + states[:, Y_SPEED]
    else:
        found[:, s.OMEGA] = stretch.u[:, 0]
    if experiment.mode == CLOSED:
        found[:, s.X_D] = stretch.u[:, 0]
    return found


@njit(nogil=True)
def contributions_along(trajectory, dt, steps, theta, active, memory, out):
    """Write what the active effects contribute on a trajectory.

    Parameters
    ----------
    trajectory : (n, N_SIGNALS) signals, linear between samples.
    steps : steps of the effects' memory in a sample of ``dt`` s.
    out : (n, N_CONTRIBUTIONS) written.
    """
    terms, updates = with_term(active), with_update(active)
    now = np.zeros(s.N_SIGNALS)
    c = np.zeros(s.N_CONTRIBUTIONS)
    n = trajectory.shape[0]
    for k in range(n):
        now[:] = trajectory[k]
        add_contributions(now, theta, terms, memory, c)
        out[k] = c
        if k + 1 < n and len(updates):
            for i in range(1, steps + 1):
                f = i / steps
                for j in range(now.shape[0]):
                    now[j] = (1.0 - f) * trajectory[k, j] + f * trajectory[k + 1, j]
                update_memory(now, theta, updates, dt / steps, memory)


def contributed(experiment: Experiment, fit: Fit, trajectory: np.ndarray,
                names: tuple[str, ...]) -> np.ndarray:
    """Return the contributions of some effects on a trajectory, (n, N_CONTRIBUTIONS)."""
    active = np.zeros_like(fit.active)
    active[[NAMES.index(name) for name in names]] = True
    found = np.zeros((len(trajectory), s.N_CONTRIBUTIONS))
    contributions_along(trajectory, experiment.dt, experiment.steps, fit.theta, active,
                        new_memory(), found)
    return found


def modelled_force(experiment: Experiment, fit: Fit, trajectory: np.ndarray,
                   names: tuple[str, ...]) -> np.ndarray:
    """Return the force against positive motion that some effects make, N (n,)."""
    c = contributed(experiment, fit, trajectory, names)
    return c[:, s.FORCE] + c[:, s.MASS] * np.gradient(trajectory[:, s.V], experiment.dt)


def modelled_flow(experiment: Experiment, fit: Fit, trajectory: np.ndarray,
                  names: tuple[str, ...], common: bool = False) -> np.ndarray:
    """Return the flow from chamber 2 into 1 that does what some effects do, m^3/s (n,).

    Softer oil or a larger chamber swallow flow when the pressure rises.  ``common`` : the flow
    into both chambers in place of that across.
    """
    theta = fit.theta
    c = contributed(experiment, fit, trajectory, names)
    others = contributed(experiment, fit, trajectory,
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
    c = contributed(experiment, fit, trajectory, fit.named)
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


@njit(nogil=True)
def drive_along(x, u, dt, steps, theta, w, out):
    """Write the shaft speed that a drive makes of the demand and a given position, rad/s.

    Parameters
    ----------
    x : (n,) position, m; u : (n, 4) demanded position as cubics.
    w : (N_CIRCUIT,) constants of the drive; out : (n,) written.
    """
    n = x.shape[0]
    h = dt / steps
    lag, slew = w[s.DRIVE_LAG], w[s.SLEW_LIMIT]
    slow = lag > 0.5 * h or slew < np.inf
    lag = max(lag, 0.5 * h)
    omega = 0.0
    for k in range(n):
        for i in range(steps):
            place = k + i / steps
            late = min(max(place - w[s.FEEDBACK_DELAY] / dt, 0.0), n - 1.0)
            j = min(int(late), n - 2)
            where = x[j] + (late - j) * (x[j + 1] - x[j])
            demand = input_at(u, 1, place - w[s.COMMAND_DELAY] / dt)
            wanted = shaft_speed(drive_speed(demand, where, theta, w), w)
            if k == 0 and i == 0:
                omega = wanted
            if i == 0:
                out[k] = omega if slow else wanted
            if slow:
                rate = drive_rate(wanted, omega, lag, slew)
                omega += rate * lag * (1.0 - np.exp(-h / lag))


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


def erring_outputs(base: Fit, fit: Fit) -> tuple[int, ...]:
    """Return the outputs whose sensors err in ``fit`` and not in ``base``."""
    change = circuit_of(fit.theta, fit.active) != circuit_of(base.theta, base.active)
    either = bool(change[s.PRESSURE_DELAY])
    found = []
    if change[[s.POSITION_DELAY, s.POSITION_SCALE, s.PLAY]].any():
        found.append(0)
    if either or change[[s.PRESSURE_SCALE_1, s.PRESSURE_OFFSET_1, s.PRESSURE_DRIFT_1]].any():
        found.append(2)
    if either or change[[s.PRESSURE_SCALE_2, s.PRESSURE_OFFSET_2, s.PRESSURE_DRIFT_2]].any():
        found.append(3)
    return tuple(found)


def modelled_error(fit: Fit, trajectory: np.ndarray, output: int) -> np.ndarray:
    """Return by how much a sensor of ``fit`` shows too much, m or Pa (n,)."""
    w = circuit_of(fit.theta, fit.active)
    time = trajectory[:, s.T]
    if output == 0:
        true = trajectory[:, s.X]
        late = np.interp(time - w[s.POSITION_DELAY], time, true)
        if w[s.PLAY] > 0.0:
            late = played(late, w[s.PLAY])
        return (1.0 + w[s.POSITION_SCALE]) * late - true
    scale, offset, drift, place = (
        (s.PRESSURE_SCALE_1, s.PRESSURE_OFFSET_1, s.PRESSURE_DRIFT_1, s.P1) if output == 2 else
        (s.PRESSURE_SCALE_2, s.PRESSURE_OFFSET_2, s.PRESSURE_DRIFT_2, s.P2))
    true = trajectory[:, place]
    late = np.interp(time - w[s.PRESSURE_DELAY], time, true)
    return (1.0 + w[scale]) * late + w[offset] + w[drift] * time - true


@njit
def played(x, play):
    """Return positions behind a play of width ``play``, m (n,)."""
    out = x.copy()
    for k in range(1, len(x)):
        out[k] = min(max(out[k - 1], x[k] - 0.5 * play), x[k] + 0.5 * play)
    return out
