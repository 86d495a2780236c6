"""B, beta_e and leakage at once where pressure and drive are recorded.

The paper found both parameters together not observable; that holds for the position alone under
one tone.  With the force and the drive input measured they are, and the covariance says so.
"""

import numpy as np

from eha_monitor.filters import kernel_joint
from eha_monitor.filters.hold import Hold, hold_of
from eha_monitor.filters.inputs import force_variance, measures_leakage, with_noise
from eha_monitor.filters.pieces import PiecedInputs
from eha_monitor.filters.results import JointResult, ParameterEstimate, StageResult
from eha_monitor.filters.run_two import Inputs
from eha_monitor.filters.stage_two import LOOP
from eha_monitor.filters.status import judge_parameter, units_of
from eha_monitor.recordings.columns import Table, sampled
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings.monitor import Settings

LEAKAGE_SPREAD = 20.0  # prior standard deviation of C_T over its configured value
SHORTEST = 200  # samples
NARROW = 100.0
MEDIAN_SQUARE = 0.4549  # of a normal deviate
IDEAL = 1.5  # variance over that of the noise, sample by sample and in means of 64
WRONG = 10.0  # NIS above which the joint answer is none
HONEST = 1.5  # NIS above which the standard deviations grow with its root


def prior_of(settings: Settings, leak: float) -> np.ndarray:
    """Return the prior variances of (B, c, leak)."""
    one, two = settings.stage_one, settings.stage_two
    return np.array([one.prior_stddev, two.prior_stddev / two.prior,
                     LEAKAGE_SPREAD * max(leak, 1e-12)]) ** 2


def fits(stage: StageResult) -> bool:
    """Tell whether a stage has an answer and its model explains its data."""
    return (stage.estimate.status == "converged" and stage.consistency is not None
            and stage.consistency.consistent)


def speed_hold(recording: Recording, settings: Settings, inputs: Inputs) -> Hold | None:
    """Return the hold of the measured pump speed, or None."""
    if "omega" not in recording.channels:
        return None
    sigma = inputs.noise["omega"].value
    return with_noise(hold_of(recording.channels["omega"], sigma,
                              sampled=settings.command_hold == "sampled"), sigma**2)


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
    blocks = len(residual) // 64
    if not blocks:
        return False
    means = residual[: blocks * 64].reshape(blocks, 64).mean(axis=1) * 8.0
    return bool(np.mean(residual**2) < IDEAL and np.mean(means**2) < IDEAL)


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
    m = np.array([np.nan, 0.0, 0.0, *start, model.leak, 0.0])
    p = np.diag([0.0, 0.0, 0.0, *variance, 0.0])
    r_f = force_variance(rig, inputs.noise, 0.0)
    (matrices, at), written = kernel_joint.new_step(), Table()
    for piece in inputs.pieces(recording, since):
        part, rows = piece.inputs, piece.recording
        hold = (hold_of(rows.channels["x_d"], 0.0) if ideal
                else speed_hold(rows, settings, inputs)).part(piece.within)
        out = np.empty((7, part.rows))
        kernel_joint.run_joint(
            part.x, part.measured_force, hold.start, hold.end, hold.variance, hold.instrument,
            constants, inputs.dt, inputs.position_variance, r_f, 0.0, False, m, p, matrices, at,
            piece.first, out)
        written.append(out[3:, piece.first:])
    nu_x, sd_x, nu_f, sd_f = map(sampled, written.values())
    with np.errstate(invalid="ignore"):
        squares = np.concatenate([(nu_x / sd_x) ** 2, (nu_f / sd_f) ** 2])
        squares = squares[np.isfinite(squares)]
        # The median, since a few samples at a jump of the command say nothing about the fit.
        nis = np.median(squares) / MEDIAN_SQUARE if len(squares) else np.nan
    if not np.isfinite(nis):
        return None
    if not (np.isfinite(p).all() and (np.diag(p)[3:6] > 0).all()):
        nis = np.inf  # the covariance broke down: the model is far off
        p = np.eye(len(p))
    return joint_result(m, p, float(nis), settings, model.beta_0, words)


def joint_result(m: np.ndarray, p: np.ndarray, nis: float, settings: Settings, beta_0: float,
                 words: str) -> JointResult:
    """Turn the filter's parameters (B, c, leak) into estimates of B, beta_e and C_T."""
    rig = settings.rig
    per_volume = 0.5 * (1 / rig.volume_1 + 1 / rig.volume_2)
    factor = np.sqrt(nis) if HONEST < nis < WRONG else 1.0
    c = max(m[4], 1e-9)
    scale = np.array([1.0, -beta_0 / c**2, 1.0 / per_volume])
    covariance = p[3:6, 3:6] * np.outer(scale, scale)
    sigma = factor * np.sqrt(np.diag(covariance))
    values = {"B": m[3], "beta_e": beta_0 / c, "L": m[5] / per_volume}
    units = units_of(rig.motion)
    priors = {"B": (settings.stage_one.prior, settings.stage_one.prior_stddev),
              "beta_e": (settings.stage_two.prior, settings.stage_two.prior_stddev,
                         settings.stage_two.largest),
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
                       nis <= WRONG)


