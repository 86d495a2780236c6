"""What named effects make along a trajectory: the modelled side of the missing term's curve."""

from dataclasses import replace

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment, Stretch
from eha_monitor.mismatch.likelihood.along import contributed, drive_along, played
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.parameters import place_of
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
