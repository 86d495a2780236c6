"""B, beta_e and leakage at once where pressure and drive are recorded.

The paper found both parameters together not observable; that holds for the position alone under
one tone.  With the force and the drive input measured they are, and the covariance says so.  B,
beta_e and leakage are constant states of one filter over position, force and drive.

Which channels make which parameters observable is computed from a recording's motion.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.estimation.discretisation import BETA_0, LOOP, MASS, discretise
from eha_monitor.estimation.drive import Hold, hold_of, speed_hold
from eha_monitor.estimation.hold_choice import white
from eha_monitor.estimation.inputs import Inputs, Piece, PiecedInputs, inputs_of
from eha_monitor.estimation.results import (
    LARGEST_NIS,
    Estimate,
    JointResult,
    ParameterEstimate,
    StageResult,
    judge_parameter,
    units_of,
)
from eha_monitor.estimation.rig_model import force_variance, measures_leakage
from eha_monitor.estimation.stage_one import GATE, SPIKES, UNSEEN
from eha_monitor.estimation.stage_two import start_two
from eha_monitor.recordings.columns import Table, sampled
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

# x, v, F, B, c = beta_0/beta_e, leak = C_T/2 (1/V1 + 1/V2), and the present sample's error of the
# input: it acts in this step and the next, so it must be a state for the innovations to be white.
STATES = 7
REFRESH_C, REFRESH_B, REFRESH_LEAK = 5e-3, 1e-2, 1e-3
LEAKAGE_SPREAD = 20.0  # prior standard deviation of C_T over its configured value
SHORTEST = 200  # samples
NARROW = 100.0
MEDIAN_SQUARE = 0.4549  # of a normal deviate
BLOCK = 64  # samples of the means by which the drive is ideal
WRONG = 10.0  # NIS above which the joint answer is none


class RowsJoint(NamedTuple):
    """What the joint filter takes of each sample.

    Attributes
    ----------
    z, force : (n,) measured position m and force N; NaN where missing.
    u_start, u_end, Q_u : (n,) the drive input and its variance (:class:`drive.Hold`).
    """

    z: np.ndarray
    force: np.ndarray
    u_start: np.ndarray
    u_end: np.ndarray
    Q_u: np.ndarray


class ConstantsJoint(NamedTuple):
    """What stays the same over a recording.

    Attributes
    ----------
    k, dt : lumped hydraulics (:func:`discretisation.hydraulics`), s.
    R_x, R_f : variances of the measurements; R_f infinite leaves the force out.
    frozen : the measurements move neither states nor parameters (the model's own motion under
        the drive input); P learns all the same and ends as the inverse of prior plus Fisher
        information.
    """

    k: np.ndarray
    dt: float
    R_x: float
    R_f: float
    frozen: bool


class StateJoint(NamedTuple):
    """State (7,) and covariance (7, 7), x[0] NaN for a fresh start; the step's matrices.

    ``matrices`` (5, 3, 7) hold at (B, c, leak) of ``at``, whose last place counts spikes in a row.
    """

    x: np.ndarray
    P: np.ndarray
    matrices: np.ndarray
    at: np.ndarray


class SampleJoint(NamedTuple):
    """Input at both ends of a sample, and its variance."""

    u0: float
    u1: float
    Q_u: float


def new_state_joint(parameters, variances) -> StateJoint:
    """Return the state before the first sample, from (B, c, leak) and their variances."""
    return StateJoint(np.array([np.nan, 0.0, 0.0, *parameters, 0.0]),
                      np.diag([0.0, 0.0, 0.0, *variances, 0.0]), np.empty((5, 3, STATES)),
                      np.array([np.nan, np.nan, np.nan, 0.0]))


@njit
def update_scalar(state, index, z, R, frozen, K):
    """Update with a scalar measurement of state ``index``; return innovation and variance.

    ``frozen``: see :class:`ConstantsJoint`.
    """
    x, P = state.x, state.P
    S = P[index, index] + R
    nu = z - x[index]
    for i in range(STATES):
        K[i] = P[i, index] / S
        if not frozen:
            x[i] += K[i] * nu
    for i in range(STATES):
        row = P[index, i]
        if i != index:
            for j in range(STATES):
                if j != index:
                    P[j, i] -= K[j] * row
    lead = 1.0 - K[index]
    for i in range(STATES):
        if i != index:
            P[index, i] *= lead
            P[i, index] = P[index, i]
    P[index, index] *= lead
    return nu, S


@njit
def filter_joint(rows, constants, state, first, out):
    """Run the filter over the samples from ``first`` on.

    Rows taken in two runs, the second with the last sample of the first before its own, give the
    same numbers as in one.

    Parameters
    ----------
    rows, constants, state : :class:`RowsJoint`, :class:`ConstantsJoint`, :class:`StateJoint`.
    out : (7, n) written: B, beta_e, leak, innovation and sigma of x, of the force.
    """
    z, force, u_start, u_end, Q_u = rows
    lumped, dt, R_x, R_f, frozen = constants
    x, P, matrices, at = state
    work = np.empty((10, 3, 3))
    base, d_c, d_cc, d_b, d_leak = matrices
    step = np.empty((3, 7))
    F = np.zeros((3, STATES))
    FP = np.empty((3, STATES))
    K = np.empty(STATES)
    at_b, at_c, at_l, spikes = at
    mass = lumped[MASS]
    nan = math.nan
    for k in range(first, z.shape[0]):
        lost = math.isnan(x[0])
        if not lost and k > 0:
            sample = SampleJoint(u_start[k - 1], u_end[k], Q_u[k])
            if math.isnan(sample.u0 + sample.u1):
                lost = True
            else:
                b, c, leak = x[3], max(x[4], 1e-3), x[5]
                beta = lumped[BETA_0] / c
                if not (abs(c - at_c) <= REFRESH_C * at_c
                        and abs(b - at_b) <= REFRESH_B * (abs(at_b) + 0.01 * mass / dt)
                        and abs(leak - at_l) * beta * dt <= REFRESH_LEAK):
                    at_b, at_c, at_l = b, c, leak
                    discretise(lumped, b, c, leak, dt, work, matrices)
                e_c, e_b, e_l = c - at_c, b - at_b, leak - at_l
                for i in range(3):
                    for j in range(7):
                        step[i, j] = (base[i, j] + e_c * (d_c[i, j] + 0.5 * e_c * d_cc[i, j])
                                      + e_b * d_b[i, j] + e_l * d_leak[i, j])
                predict(state, step, sample, F, FP)
        nu_x, sd_x, nu_f, sd_f = nan, nan, nan, nan
        if lost and not math.isnan(z[k]):
            restart(x, P, z[k], R_x, mass, dt)
        elif lost:
            x[0] = nan
        elif not math.isnan(z[k]):
            far = (z[k] - x[0]) ** 2 > GATE * (P[0, 0] + R_x)
            if far and not frozen and spikes < SPIKES:  # as the stages do
                spikes += 1
            else:
                spikes = 0.0
                nu_x, S = update_scalar(state, 0, z[k], R_x, frozen, K)
                sd_x = math.sqrt(S)
        if not math.isnan(x[0]) and R_f < math.inf and not math.isnan(force[k]):
            nu_f, S = update_scalar(state, 2, force[k], R_f, frozen, K)
            sd_f = math.sqrt(S)
        out[0, k], out[1, k], out[2, k] = x[3], lumped[BETA_0] / max(x[4], 1e-9), x[5]
        out[3, k], out[4, k], out[5, k], out[6, k] = nu_x, sd_x, nu_f, sd_f
    at[0], at[1], at[2], at[3] = at_b, at_c, at_l, spikes


@njit
def restart(x, P, z, R, mass, dt):
    """(Re)start the states and the input's error; parameters and their variance stay."""
    start_two(x, P, z, R, dt, mass)
    x[6] = 0.0
    for j in range(STATES):
        P[6, j] = 0.0
        P[j, 6] = 0.0


@njit
def predict(state, step, sample, F, FP):
    """Predict over one sample; regressors that are no larger than noise carry no information.

    Parameters
    ----------
    step : (3, 7) transition at the present parameters.
    F, FP : (3, 7) scratch.
    """
    x, P = state.x, state.P
    d_c, d_b, d_leak = state.matrices[1], state.matrices[3], state.matrices[4]
    Q_u = sample.Q_u
    y = (x[0], x[1], x[2], sample.u0 - x[6], sample.u1)
    new = np.zeros(3)
    for i in range(3):
        to_b, to_c, to_l = 0.0, 0.0, 0.0
        for j in range(5):
            new[i] += step[i, j] * y[j]
            to_b += d_b[i, j] * y[j]
            to_c += d_c[i, j] * y[j]
            to_l += d_leak[i, j] * y[j]
        for j in range(3):
            F[i, j] = step[i, j]
        F[i, 3], F[i, 4], F[i, 5] = to_b, to_c, to_l
    noise = Q_u * (d_c[2, 3] + d_c[2, 4]) ** 2
    for i in range(3):
        for j in range(3):
            noise += d_c[2, i] * P[i, j] * d_c[2, j]
    lean = d_c[2, 0] * P[0, 4] + d_c[2, 1] * P[1, 4] + d_c[2, 2] * P[2, 4]
    noise -= lean * lean / P[4, 4]  # what the parameter's own uncertainty makes is no noise
    seen_b = x[1] * x[1] >= UNSEEN * (P[1, 1] - P[1, 3] * P[1, 3] / P[3, 3])
    seen_c = F[2, 4] * F[2, 4] >= UNSEEN * noise
    seen_l = x[2] * x[2] >= UNSEEN * (P[2, 2] - P[2, 5] * P[2, 5] / P[5, 5])
    for i in range(3):
        if not seen_b:
            F[i, 3] = 0.0
        if not seen_c:
            F[i, 4] = 0.0
        if not seen_l:
            F[i, 5] = 0.0
    for i in range(3):
        for j in range(STATES):
            total = -step[i, 3] * P[6, j]
            for k in range(6):
                total += F[i, k] * P[k, j]
            FP[i, j] = total
    for i in range(3):
        for j in range(i, 3):
            total = -FP[i, 6] * step[j, 3]
            for k in range(6):
                total += FP[i, k] * F[j, k]
            total += Q_u * step[i, 4] * step[j, 4]
            P[i, j] = total
            P[j, i] = total
        for j in range(3, 6):
            P[i, j] = FP[i, j]
            P[j, i] = FP[i, j]
        P[i, 6] = -Q_u * step[i, 4]
        P[6, i] = P[i, 6]
    for j in range(3, 6):
        P[6, j] = 0.0
        P[j, 6] = 0.0
    P[6, 6] = Q_u
    x[0], x[1], x[2], x[6] = new[0], new[1], new[2], 0.0


def prior_of(settings: Settings, leak: float) -> np.ndarray:
    """Return the prior variances of (B, c, leak)."""
    one, two = settings.stage_one, settings.stage_two
    return np.array([one.prior_stddev, two.prior_stddev / two.prior,
                     LEAKAGE_SPREAD * max(leak, 1e-12)]) ** 2


def fits(stage: StageResult) -> bool:
    """Tell whether a stage has an answer and its model explains its data."""
    return (stage.estimate.status == "converged" and stage.consistency is not None
            and stage.consistency.consistent)


def hold_of_speed(recording: Recording, inputs: Inputs) -> Hold:
    """Return the hold of the measured pump speed.

    The measured force sees what smoothing leaves of the noise, so all of it passes the oil here.
    """
    hold = speed_hold(recording.channels["omega"], inputs.noise["omega"].value,
                      inputs.model.ringing * inputs.dt, sampled=inputs.model.held)
    return hold._replace(variance=hold.variance + hold.slow)


def drive_is_ideal(recording: Recording, settings: Settings, inputs: Inputs) -> bool:
    """Tell whether the measured pump speed is K_pos (x_d - x) to within the sensors' noise.

    Then x_d is an input without noise and says far more than the speed sensor; a drive with lag
    or limits fails this, and the measured speed is taken.
    """
    if isinstance(inputs, PiecedInputs):
        return drive_is_ideal(inputs.sample, settings, inputs.facts)
    gain = settings.rig.position_gain
    if gain is None or not recording.has("x_d", "omega") or not inputs.model.loop:
        return False
    residual = recording.channels["omega"] - gain * (recording.channels["x_d"] - inputs.x)
    sigma = np.hypot(inputs.noise["omega"].value, gain * inputs.noise["x"].value)
    residual = residual[np.isfinite(residual)] / sigma
    return len(residual) >= BLOCK and white(residual, BLOCK)


def run_joint(inputs: Inputs, recording: Recording, settings: Settings, one: StageResult,
              two: StageResult, since: int = 0) -> JointResult | None:
    """Estimate B, beta_e and C_T together, or return None where pressure or omega is missing.

    Starts from the two stages' answers, with a hundred times the variance of one that fits (a
    hundredth of its information counts twice; a broader start leads astray), and takes what came
    after the last change that a stage saw (sample ``since``): its parameters are constant.
    """
    model = inputs.model
    if (not recording.has("omega") or model.hydraulics is None or inputs.no_force is not None
            or not recording.has("p1", "p2") or model.active.any()
            or measures_leakage(settings.rig, recording.channels)):
        return None
    if len(recording) - since < SHORTEST:
        since = 0  # it never settles: whether one set of parameters fits is the question then
    rig = settings.rig
    constants = model.hydraulics.copy()
    words, ideal = "pump speed", drive_is_ideal(recording, settings, inputs)
    if ideal:
        words = "demanded position (the drive follows it within the noise)"
    else:
        constants[LOOP] = 0.0  # the measured speed is the input: the loop is open
    start, variance = [settings.stage_one.prior, 1.0], prior_of(settings, model.leak)
    if one.estimate.status == "converged":
        start[0] = one.estimate.value
    if fits(one):
        variance[0] = min(variance[0], NARROW * one.estimate.stddev**2)
    if two.estimate.status == "converged":
        start[1] = model.beta_0 / two.estimate.value
    if fits(two):
        variance[1] = min(variance[1], NARROW * (
            start[1] * two.estimate.stddev / two.estimate.value) ** 2)
    state = new_state_joint([*start, model.leak], variance)
    R_f = force_variance(rig, inputs.noise, 0.0)
    given = ConstantsJoint(constants, inputs.dt, inputs.position_variance, R_f, False)
    written = Table()
    for piece in inputs.pieces(recording, since):
        part, rows = piece.inputs, piece.recording
        hold = (hold_of(rows.channels["x_d"], 0.0) if ideal
                else hold_of_speed(rows, inputs)).part(piece.within)
        out = np.empty((7, part.rows))
        hold = hold._replace(start=part.moving(hold.start))
        filter_joint(RowsJoint(part.x, part.moving(part.measured_force), *hold[:3]), given, state,
                     piece.first, out)
        written.append(out[3:, piece.first:])
    P = state.P
    nu_x, sd_x, nu_f, sd_f = map(sampled, written.values())
    with np.errstate(invalid="ignore"):
        squares = np.concatenate([(nu_x / sd_x) ** 2, (nu_f / sd_f) ** 2])
        squares = squares[np.isfinite(squares)]
        # The median, since a few samples at a jump of the command say nothing about the fit.
        nis = np.median(squares) / MEDIAN_SQUARE if len(squares) else np.nan
    if not np.isfinite(nis):
        return None
    if not (np.isfinite(P).all() and (np.diag(P)[3:6] > 0).all()):
        nis = np.inf  # the covariance broke down: the model is far off
        P = np.eye(len(P))
    return joint_result(state.x, P, float(nis), settings, model.beta_0, words)


def joint_result(x: np.ndarray, P: np.ndarray, nis: float, settings: Settings, beta_0: float,
                 words: str) -> JointResult:
    """Turn the filter's parameters (B, c, leak) into estimates of B, beta_e and C_T."""
    rig = settings.rig
    per_volume = 0.5 * (1 / rig.volume_1 + 1 / rig.volume_2)
    factor = np.sqrt(nis) if LARGEST_NIS < nis < WRONG else 1.0
    c = max(x[4], 1e-9)
    scale = np.array([1.0, -beta_0 / c**2, 1.0 / per_volume])
    covariance = P[3:6, 3:6] * np.outer(scale, scale)
    sigma = factor * np.sqrt(np.diag(covariance))
    values = {"B": x[3], "beta_e": beta_0 / c, "L": x[5] / per_volume}
    units = units_of(rig.motion)
    one, two = settings.stage_one, settings.stage_two
    priors = {"B": (one.prior, one.prior_stddev),
              "beta_e": (two.prior, two.prior_stddev, two.largest),
              "L": (rig.leakage, LEAKAGE_SPREAD * max(rig.leakage, 1e-15))}
    estimates: dict[str, ParameterEstimate] = {
        name: judge_parameter(name, float(value), float(sigma[i]), units[name], *priors[name])
        for i, (name, value) in enumerate(values.items())}
    if nis > WRONG:
        estimates = {name: ParameterEstimate(name, np.nan, np.nan, units[name], "diverged",
                                             f"the joint model does not fit: NIS {nis:.3g}")
                     for name in estimates}
    root = np.sqrt(np.diag(covariance))
    return JointResult(estimates, covariance / np.outer(root, root),
                       f"position, pressure force and {words} together, NIS {nis:.3g}",
                       nis <= WRONG, nis)


COMBINATIONS = (("x", "x_d"), ("x", "omega"), ("x", "p1", "p2"), ("x", "x_d", "p1", "p2"),
                ("x", "omega", "p1", "p2"))
VAGUE = 1e3  # prior standard deviation over the value: what stays near it is not observable
STILL = 3.0  # rms of the pump speed over its noise


@dataclass(frozen=True)
class ObservabilityRow:
    """Standard deviations of B, beta_e and L (C_T), all three unknown, from some channels.

    ``relative_stddev`` is the Cramer-Rao bound over the value; infinite where the parameter
    cannot be told.
    """

    channels: tuple[str, ...]
    relative_stddev: dict[str, float]


@dataclass(frozen=True)
class ObservabilityTable:
    """Rows for each combination of channels that the recording holds."""

    rows: tuple[ObservabilityRow, ...]


def observability(estimate: Estimate) -> ObservabilityTable:
    """Compute the bound of B, beta_e and L for each combination of recorded channels.

    The joint filter runs with its parameters frozen at the estimates (nominal values where
    there are none) and a vague prior; its covariance then is the inverse Fisher information,
    unknown initial state included.  The states are the model's own motion under the recorded
    drive input, so that a recording which the model does not fit cannot pretend to tell more.
    Without a drive input the pump's flow is unknown, so the flow balance says nothing about beta_e
    and L; the force balance is stage one, whose covariance is the bound of B.
    """
    recording, settings = estimate.recording, estimate.settings
    inputs = inputs_of(recording, settings)
    if inputs.model.hydraulics is None:
        return ObservabilityTable(())
    bounds = [Bound(channels, estimate, inputs) for channels in COMBINATIONS
              if all(recording.has(name) for name in channels) and (
                  "x_d" not in channels or settings.rig.position_gain is not None)]
    if any(bound.driven for bound in bounds):
        for piece in inputs.pieces(recording):
            for bound in bounds:
                bound.take(piece)
    return ObservabilityTable(tuple(ObservabilityRow(bound.channels, bound.relative)
                                    for bound in bounds))


class Bound:
    """The bound of B, beta_e and L from some channels, over the pieces of a recording.

    ``driven`` : whether a drive input is among the channels.
    """

    def __init__(self, channels: tuple[str, ...], estimate: Estimate, inputs: Inputs):
        self.channels, self.estimate, self.inputs = channels, estimate, inputs
        self.driven = "x_d" in channels or "omega" in channels
        model, rig = inputs.model, estimate.settings.rig
        damping, modulus = (estimate.by_stages[name] for name in ("B", "beta_e"))
        b = damping.value if damping.status == "converged" else rig.viscous_damping
        beta = modulus.value if modulus.status == "converged" else rig.bulk_modulus
        self._values = np.array([max(abs(b), 1e-9), model.beta_0 / beta, max(model.leak, 1e-15)])
        self._constants = model.hydraulics.copy()
        self._constants[LOOP] = rig.position_gain if "x_d" in channels else 0.0
        self._still = False
        if self.driven and "x_d" not in channels:
            omega = (inputs.sample if isinstance(inputs, PiecedInputs)
                     else estimate.recording).channels["omega"]
            self._still = bool(  # the speed is nothing but its sensor's noise
                np.nanmean(omega**2) < STILL**2 * inputs.noise["omega"].value ** 2)
        self._state = new_state_joint(self._values, (VAGUE * self._values) ** 2)

    def take(self, piece: Piece) -> None:
        """Learn from some rows."""
        if not self.driven:
            return
        part, rows, inputs = piece.inputs, piece.recording, self.inputs
        if "x_d" in self.channels:
            hold = hold_of(rows.channels["x_d"], 0.0)
        else:
            hold = hold_of_speed(rows, inputs)
        variance = hold.variance
        if self._still:
            hold = hold_of(np.zeros(len(rows)), 0.0)  # its noise is no motion
        force, R_f = np.full(part.rows, np.nan), np.inf
        if "p1" in self.channels:
            force = part.moving(part.measured_force)
            R_f = force_variance(self.estimate.settings.rig, inputs.noise, 0.0)
        hold = hold._replace(variance=variance).part(piece.within)
        hold = hold._replace(start=part.moving(hold.start))
        given = ConstantsJoint(self._constants, inputs.dt, inputs.position_variance, R_f, True)
        filter_joint(RowsJoint(part.x, force, *hold[:3]), given, self._state, piece.first,
                     np.empty((7, part.rows)))

    @property
    def relative(self) -> dict[str, float]:
        """Relative standard deviations of B, beta_e and L."""
        if not self.driven:
            b = self.estimate.by_stages["B"]
            told = b.status == "converged" and b.value != 0.0
            return {"B": float(b.stddev / abs(b.value)) if told else np.inf, "beta_e": np.inf,
                    "L": np.inf}
        found = np.sqrt(np.maximum(np.diag(self._state.P)[3:6], 0.0)) / self._values
        found = np.where(found > 0.1 * VAGUE, np.inf, found)
        return dict(zip(("B", "beta_e", "L"), map(float, found), strict=True))
