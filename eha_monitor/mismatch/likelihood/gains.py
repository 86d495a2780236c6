"""Gains of the mismatch filter: the plant linearised at a typical point, Riccati to the end."""

from dataclasses import dataclass

import numpy as np

from eha_monitor.mismatch.data.experiment import Experiment
from eha_monitor.mismatch.data.inputs import CLOSED, FORCED, OPEN
from eha_monitor.mismatch.likelihood.innovations import N_FILTERED, riccati, transition
from eha_monitor.physics import plant
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of

CORRELATION = 0.02  # s, for which an unknown force, flow or speed lasts
SHORT = 5.0  # samples: the shortest
FORGOTTEN = 1e-3  # share left after a sample
TRANSIENT = 3000  # samples after a start until the gains stand


@dataclass(frozen=True)
class Unknowns:
    """Standing deviation of what no equation accounts for: N, m^3/s, rad/s."""

    force: float
    flow: float
    speed: float

    def as_array(self) -> np.ndarray:
        """(3,) in the order of the filter's states."""
        return np.array([self.force, self.flow, self.speed])


def decay_of(experiment: Experiment) -> float:
    """Share of an unknown that is left after a sample.

    Where the force drives the model, the force balance is all there is, and what an unknown force
    of some length takes over is taken from friction: there it is as short as can be, so that
    what lasts falls to the parameters, as in a fit of the balance itself.
    """
    dt = experiment.dt
    lasting = 0.0 if experiment.mode == FORCED else CORRELATION
    return float(np.exp(-dt / max(lasting, SHORT * dt)))


def smallest_unknowns(experiment: Experiment) -> Unknowns:
    """Return unknowns so small that they do not show: 0.01 % of what the record covers."""
    r = experiment.ranges
    return Unknowns(1e-4 * r.force, 1e-4 * max(r.flow, 1e-12), 1e-4 * r.pump_speed[1])


def operating_point(experiment: Experiment) -> np.ndarray:
    """Return a state in typical motion, (N_STATE,)."""
    middle = experiment.stretches[0].middle
    rig = experiment.settings.rig
    y = np.zeros(plant.N_STATE)
    y[plant.Y_X] = y[plant.Y_PLAYED] = middle[0]
    y[plant.Y_V] = 0.5 * experiment.ranges.speed
    for place, column in ((plant.Y_P1, 2), (plant.Y_P2, 3)):
        known = np.isfinite(middle[column])
        y[place] = middle[column] if known else rig.charge_pressure
    if rig.area_1 and rig.pump_displacement:
        y[plant.Y_OMEGA] = rig.area_1 * y[plant.Y_V] / rig.pump_displacement
    return y


@dataclass(frozen=True)
class Linear:
    """The plant linearised in typical motion, as the filter's gains are computed from it."""

    a: np.ndarray  # (N_FILTERED, N_FILTERED) over one sample
    h: np.ndarray  # (N_OUTPUTS, N_FILTERED)
    q: np.ndarray  # (N_FILTERED,) variances of a sample's process noise
    r: np.ndarray  # (N_OUTPUTS,) variances of the sensors
    start: np.ndarray  # (N_FILTERED,) variances at the start of a stretch


def linear_of(experiment: Experiment, theta: np.ndarray, active: np.ndarray,
              unknowns: Unknowns) -> Linear:
    """Linearise the plant with parameters ``theta`` and ``active`` effects in typical motion."""
    dt, r = experiment.dt, experiment.ranges
    decay = decay_of(experiment)
    y = operating_point(experiment)
    u = np.zeros((1, 4))
    if experiment.mode == CLOSED:
        u[0, 0] = y[plant.Y_X] + y[plant.Y_OMEGA] / theta[s.K_POS]
    elif experiment.mode == OPEN:
        u[0, 0] = y[plant.Y_OMEGA]
    else:
        u[0, 0] = theta[s.B] * y[plant.Y_V]
    noise = np.where(experiment.used, np.nan_to_num(experiment.noise, nan=1.0), 1.0)
    pump = r.pump_speed[2]
    size = np.array([r.position, r.speed, r.pressure_difference[2], r.pressure_difference[2],
                     pump, r.force, max(r.flow, 1e-12), pump])
    a, h = transition(experiment.mode, experiment.held, experiment.hears,
                      plant.Step(dt, experiment.steps), theta, active, decay, y, u, 1e-3 * size)
    away = np.zeros(N_FILTERED, dtype=bool)
    if experiment.mode == FORCED:
        away[[plant.Y_P1, plant.Y_P2, plant.Y_OMEGA, plant.Y_FLOW, plant.Y_SPEED]] = True
    elif experiment.mode == OPEN:
        away[plant.Y_OMEGA] = True
    a[away], a[:, away], h[:, away] = 0.0, 0.0, 0.0
    intensity = unknowns.as_array()
    q = np.zeros(N_FILTERED)
    q[:5] = (1e-7 * size[:5]) ** 2  # rounding and integration: keeps P positive
    q[[plant.Y_P1, plant.Y_P2]] += experiment.drift**2
    q[5:] = intensity**2 * (1.0 - decay**2)
    q[away] = 0.0
    variance = noise**2
    late = circuit_of(theta, active)[s.PRESSURE_DELAY]
    if late > 0.0 and experiment.mode != FORCED:
        kept = np.flatnonzero(~away)
        rows, more = looking_back(a[np.ix_(kept, kept)], h[np.ix_([2, 3], kept)], q[kept],
                                  size[kept], late / dt)
        h[np.ix_([2, 3], kept)] = rows
        variance[[2, 3]] += more
    start = np.zeros(N_FILTERED)
    start[plant.Y_X] = (2.0 * noise[0]) ** 2
    start[plant.Y_V] = r.speed**2
    for place, column in ((plant.Y_P1, 2), (plant.Y_P2, 3)):
        start[place] = ((2.0 * noise[column]) ** 2 if experiment.used[column]
                        else (r.pressure_difference[3] + 0.1 * r.mean_pressure) ** 2)
    start[plant.Y_OMEGA] = pump**2
    start[plant.Y_FORCE:] = intensity**2
    start[away] = 0.0
    return Linear(a, h, q, variance, start)


def looking_back(a: np.ndarray, h: np.ndarray, q: np.ndarray, size: np.ndarray, late: float
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Return how an old reading depends on the present state, and its further variance.

    A gain that takes an old pressure for a new one makes the filter swing.  With
    x(t) = A^m x(t - T) + sum A^i w, y = H x(t - T) is H A^-m x(t) less the noise since.

    Parameters
    ----------
    a, h, q, size : (n, n) of one sample, (k, n), (n,) variances, (n,) scales of the state.
    late : samples.
    """
    scaled = a / size[:, None] * size
    rows = (h * size) @ power_of(scaled, -late) / size
    one_back = power_of(scaled, -1.0)
    more, past = np.zeros(len(h)), h * size
    for i in range(int(np.ceil(late))):
        past = past @ one_back
        more += min(1.0, late - i) * ((past / size) ** 2 @ q)
    return rows, more


def power_of(a: np.ndarray, exponent: float) -> np.ndarray:
    """Return A^exponent of a diagonalisable matrix with eigenvalues off the negative axis."""
    values, vectors = np.linalg.eig(a)
    # What is forgotten within a sample (the speed of a drive without lag) has no past.
    lasting = np.where(np.abs(values) > FORGOTTEN, values, 1.0).astype(complex)
    return np.real((vectors * lasting**exponent) @ np.linalg.inv(vectors))


def gains_of(experiment: Experiment, theta: np.ndarray, active: np.ndarray,
             unknowns: Unknowns) -> np.ndarray:
    """Return the gains of a filter linearised at a model, (m, N_FILTERED, N_OUTPUTS).

    The last serves from there on.
    """
    m = linear_of(experiment, theta, active, unknowns)
    longest = max(len(stretch) for stretch in experiment.stretches)
    gains = np.zeros((min(TRANSIENT, longest), N_FILTERED, len(m.r)))
    count = riccati(m.a, m.h, m.q, m.r, np.diag(m.start), experiment.used, gains)
    return gains[:count]


def expected_covariance(experiment: Experiment, theta: np.ndarray, active: np.ndarray,
                        unknowns: Unknowns, gains: np.ndarray) -> np.ndarray:
    """Return the innovations' covariance that the steady filter leads to expect, (c, c) SI.

    By R = (1 - H K) S, of the used channels.
    """
    m, used = linear_of(experiment, theta, active, unknowns), experiment.columns
    return np.linalg.solve(np.eye(len(used)) - m.h[used] @ gains[-1][:, used], np.diag(m.r[used]))
