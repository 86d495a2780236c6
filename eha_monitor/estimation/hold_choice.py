"""Whether a drive holds its command over each sample: asked of the recording, once.

A controller that computes K_pos (x_d - x) once in a sample and holds it turns the pump half a
sample later on average.  Read as a continuous one, beta_e pays for that half sample.  Both inputs
compete; a late sensor or a slow drive, which a held command can be mistaken for, compete as well.
Below this nothing knows of a third kind: the settings have the hold decided.

How well a recording fits an input says :mod:`eha_monitor.estimation.hold_filter`.
Behind a lag the shaft turns smoothly, and the oil cannot tell what its command did in a sample.
The drive's own equation can: tau w' + w = g u + c with u the command as a straight line in each
sample, or as a step at each stamp.  Each input is fitted by least squares in g, c and the speed at
the start, and in tau; with n residuals of sum of squares S, log L = -(n/2) log(S/n).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from eha_monitor import ties
from eha_monitor.estimation.discretisation import LINE_TIME, LOOP
from eha_monitor.estimation.drive import Hold, drive_input, hold_of
from eha_monitor.estimation.hold_filter import Point, Stretch, climbed, fitted
from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.estimation.rig_model import LINE, RigModel, force_of, force_variance, missing
from eha_monitor.estimation.sensors import noise_levels, undo_sensors, without_spikes
from eha_monitor.estimation.stages import most_telling
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.effects import NAMES
from eha_monitor.physics.parameters import theta_of
from eha_monitor.recordings.columns import let_go, mapped
from eha_monitor.recordings.grid import filled
from eha_monitor.recordings.recording import ChannelFinding, Recording
from eha_monitor.settings.monitor import Settings
from eha_monitor.settings.rig import Rig
from eha_monitor.words import odds

CONTINUOUS, SAMPLED, AUTO = "continuous", "sampled", "auto"
ASKED = 3000  # samples: the stretch in which the drive moves most
FEWEST = 300
DECISIVE = 30.0  # log units; the likelihoods know the physics only so well
LATE = (2.0, 3.0)  # samples by which an input may come late, beside a half and one
CLEARLY = 2.0 * DECISIVE
COINCIDENCE = 8.0  # log units that a delay must gain: it could have any length
BEYOND = 1e15  # SI
FINEST = 1e-15  # least noise of a sensor, SI
TOLERANCES = 3.0  # of the config's gain: one that is further off is wrong, and to be named
UNSURE = 4.0  # times the usual variance of the input
SMOOTH_S, SMOOTHED = 0.012, 7  # s and least samples over which velocity is taken
IDEAL, BLOCK = 1.5, 16  # variance over that of the noise, sample by sample and in means
LAGGING = 1.0  # samples: a shorter lag leaves the steps of a held command in the speed
CUBIC = 3  # degree
CREEP = 0.02  # of the highest speed, over which dry friction builds up


def later(hold: Hold, samples: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines (start, end) of an input that comes so many samples later."""
    start, end = hold.start, hold.end
    if samples == 0.0:
        return start, end
    n = len(start)
    area = np.zeros(n)
    area[1:] = 0.5 * (start[:-1] + end[1:])
    whole = np.cumsum(area)

    def up_to(place):
        i = np.clip(np.floor(place).astype(int), 0, n - 2)
        f = np.clip(place - i, 0.0, 1.0)
        return whole[i] + f * (start[i] + 0.5 * f * (end[i + 1] - start[i]))

    place = np.arange(1, n) - samples
    before, middle, after = up_to(place - 1.0), up_to(place - 0.5), up_to(place)
    mean, tilt = after - before, 4.0 * (after - 2.0 * middle + before)
    new = np.copy(start), np.copy(end)
    new[0][:-1], new[1][1:] = mean - 0.5 * tilt, mean + 0.5 * tilt
    return new


@dataclass(frozen=True)
class HoldDecision:
    """What a recording says about the hold.

    Attributes
    ----------
    hold : ``continuous`` or ``sampled``; ``continuous`` where the recording cannot tell.
    evidence : log units by which it is the better one; ``decided`` : whether that is enough.
    channel : that the hold is of: ``x_d`` or ``omega``.
    lagging : the drive's own equation has said so, with a lag.
    """

    hold: str
    evidence: float
    decided: bool
    channel: str
    lagging: bool = False

    @property
    def sentence(self) -> str:
        """Say it in words."""
        much = odds(self.evidence)
        if not self.decided:
            return ("the recording does not show whether the drive holds its command over each "
                    f"sample ({much})")
        if self.hold == SAMPLED and self.evidence < DECISIVE:
            return ("the drive seems to hold its command over each sample (a digital controller): "
                    "it comes half a sample late")
        if self.hold == SAMPLED:
            return ("the drive holds its command over each sample (a digital controller): "
                    f"{much} over a continuous one")
        return f"the drive's command is continuous: {much} over one held over each sample"

    @property
    def findings(self) -> tuple[ChannelFinding, ...]:
        """What a user must know of it: a held command."""
        if not self.decided or self.hold != SAMPLED:
            return ()
        return (ChannelFinding(self.sentence, "hold", (self.channel,), {"command_hold": SAMPLED}),)


def with_hold(settings: Settings, hold: str) -> Settings:
    """Return the settings with this hold."""
    return settings.model_copy(update={"command_hold": hold})


def other_hold(settings: Settings) -> Settings:
    """Return the settings with the hold that they do not say."""
    return with_hold(settings, CONTINUOUS if settings.command_hold == SAMPLED else SAMPLED)


def resolved(recordings: list[Recording], settings: Settings
             ) -> tuple[Settings, HoldDecision | None]:
    """Return the settings with the hold decided, and what the recordings say about it.

    Parameters
    ----------
    recordings : of one rig, which has one hold.

    Returns
    -------
    settings : as given where ``command_hold`` is not ``auto``.
    decision : None where nothing was asked: the config says it, or no recording has a drive
        input beside a position.
    """
    if settings.command_hold != AUTO:
        return settings, None
    found = [one for recording in recordings
             if (one := evidence_of(recording, settings)) is not None]
    if not found:
        return with_hold(settings, CONTINUOUS), None
    evidence = sum(one for one, *_ in found)
    decided = abs(evidence) >= DECISIVE
    hold = SAMPLED if decided and evidence > 0.0 else CONTINUOUS
    return with_hold(settings, hold), HoldDecision(hold, abs(evidence), decided, *found[0][1:])


def for_stages(settings: Settings, decision: HoldDecision | None) -> Settings:
    """Return the settings that the stages take, with the hold that :func:`resolved` gave.

    Behind a lag that the config does not have they know no hold: without that lag the pressures
    would have corners that they have not, and B would pay for it.
    """
    lacking = decision is not None and decision.lagging and not settings.effects.get("drive_lag")
    return with_hold(settings, CONTINUOUS) if lacking else settings


def evidence_of(recording: Recording, settings: Settings) -> tuple[float, str, bool] | None:
    """Return the log units for a held command over a continuous one, of which channel and by whom.

    The last is True where the equation of a drive with a lag says so, see :class:`HoldDecision`.
    None where the recording has no drive input, or too little of it.
    """
    names = [name for name in recording.channels if recording.has(name)]
    if missing(settings, names)[1] is not None or len(recording) < FEWEST:
        return None
    by_drive = evidence_of_drive(recording, settings)
    if by_drive is not None:
        return *by_drive, True
    asked = asked_of(recording, settings)
    if asked is None:
        return None
    stretches, continuous, sampled, channel = asked
    held, flowing = later(sampled, 0.0), later(continuous, 0.0)
    first, second = fitted(stretches, flowing), fitted(stretches, held)
    # Each from where the other has come to, too: a search ends at the top of one hill.
    l_flowing, at = ties.best(
        [first, (*_from(second, flowing),)], lambda one: one[0], within=ties.GUESS)[::2]
    l_held, at_held = ties.best(
        [second, (*_from(first, held),)], lambda one: one[0], within=ties.GUESS)[::2]
    if not (np.isfinite(l_held) and np.isfinite(l_flowing)):
        return None
    return weighed(l_flowing, l_held,
                   lambda by: climbed(first[1], later(continuous, by), at)[0],
                   lambda by: climbed(second[1], later(sampled, by), at_held)[0]
                   ), channel, False


def weighed(l_flowing: float, l_held: float, flowing_late: Callable[[float], float],
            held_late: Callable[[float], float]) -> float:
    """Return the log units for a held command over a continuous one, either of which may be late.

    Parameters
    ----------
    l_flowing, l_held : log likelihoods of the continuous and of the held command.
    flowing_late, held_late : samples by which it comes later -> log likelihood.
    """
    # A held command is half a sample late on average: what is late by just that is taken for one
    # unless it is clearly better, since any other length would be as likely.
    half, one = flowing_late(0.5), flowing_late(1.0)
    late = max([one, *map(flowing_late, LATE)] if one > l_flowing else [one])
    if max(late - COINCIDENCE, half - CLEARLY) > max(l_flowing, l_held - CLEARLY):
        l_held = max(l_held, max(held_late(by - 0.5) for by in (1.0, *LATE)) - COINCIDENCE)
        l_flowing = max(l_flowing, late - COINCIDENCE, half - CLEARLY)
    return float(l_held - l_flowing)


SHORTEST_LAG, LONGEST_LAG = 0.05, 200.0  # samples: how long a lag may be
NEAR = 1e-4  # of a lag's logarithm
SAME_SPEED = 1e-12  # rad/s: what two computations of one speed differ by


class Lagged(NamedTuple):
    """How a drive's speed follows an input.

    Attributes
    ----------
    log_likelihood, lag : log units, s.
    left : (n,) rad/s, what the drive's equation leaves of the speed.
    through : variance of the speed over that of white noise on the input.
    """

    log_likelihood: float
    lag: float
    left: np.ndarray
    through: float


def weights_of(lag: float, dt: float) -> tuple[float, float, float]:
    """Return (pole, start, end): w[k] = pole w[k-1] + start u[k-1] + end u[k] of a straight line.

    The exact answer of the first-order lag over a sample in which its input runs from u[k-1] to
    u[k]; the same at both ends is a command that is held.
    """
    if lag <= 0.0:
        return 0.0, 0.0, 1.0
    pole = math.exp(-dt / lag)
    share = (1.0 - pole) * lag / dt
    return pole, share - pole, 1.0 - share


def followed(start: np.ndarray, end: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Return the speed of a drive behind a lag, (n,) rad/s, which begins at that of its input.

    Parameters
    ----------
    start, end : (n,) the input runs from ``start[k-1]`` to ``end[k]``, rad/s.
    lag : s.
    """
    from scipy.signal import lfilter  # takes half of the start of a command

    pole, first, last = weights_of(lag, dt)
    moved = np.concatenate([start[:1], first * start[:-1] + last * end[1:]])
    return lfilter([1.0], [1.0, -pole], moved)


def lagged(start: np.ndarray, end: np.ndarray, omega: np.ndarray, there: np.ndarray, dt: float
           ) -> Lagged:
    """Fit the drive's equation to a speed.

    Parameters
    ----------
    start, end : (n,) the input runs from ``start[k-1]`` to ``end[k]``, rad/s.
    omega : (n,) rad/s without gaps; ``there`` (n,) bool, where it counts.
    """
    from scipy.optimize import minimize_scalar

    number = np.arange(len(omega))

    def fit(log_lag: float) -> tuple[float, np.ndarray, np.ndarray]:
        lag = dt * math.exp(log_lag)
        columns = np.column_stack([followed(start, end, lag, dt), np.ones(len(omega)),
                                   np.exp(-np.minimum(number * dt / lag, 700.0))])
        found = np.linalg.lstsq(columns[there], omega[there], rcond=None)[0]
        left = omega - columns @ found
        return float(left[there] @ left[there]), found, left

    best = minimize_scalar(lambda at: fit(at)[0], method="bounded", options={"xatol": NEAR},
                           bounds=(math.log(SHORTEST_LAG), math.log(LONGEST_LAG)))
    squares, found, left = fit(best.x)
    lag, n = dt * math.exp(best.x), int(there.sum())
    pole, first, last = weights_of(lag, dt)
    through = (first**2 + last**2 + 2.0 * pole * first * last) / (1.0 - pole**2)
    log_likelihood = -0.5 * n * math.log(max(squares / n, SAME_SPEED**2))
    return Lagged(log_likelihood, lag, left, float(found[0]) ** 2 * through)


def evidence_of_drive(recording: Recording, settings: Settings) -> tuple[float, str] | None:
    """Return what the speed of a drive with a lag says of its command, log units, and of which.

    None where the drive has no lag, where its speed or command is not recorded, and where no lag
    leaves as little of the speed as its noise.
    """
    rig, dt = settings.rig, recording.sample_time
    told = "omega_d" if recording.has("omega_d") else "x_d"
    if not recording.has("omega", told) or (told == "x_d" and rig.position_gain is None):
        return None
    w = circuit_of(*theta_of(rig, settings.effects))
    if w[s.PLAY] or np.isfinite(w[list(s.LIMITS)]).any():
        return None
    _, cut = telling_part(recording, recording.get("omega"))
    if not {"omega", "x", told} <= cut.keys() or beyond(cut):
        return None
    noise = noise_levels(Recording(dt, cut), settings.noise)
    cut, _ = without_spikes(cut, noise)
    if told == "omega_d":
        parts, unsure = [(cut["omega_d"], s.COMMAND_DELAY)], 0.0
    else:
        gain = rig.position_gain
        parts = [(gain * cut["x_d"], s.COMMAND_DELAY), (-gain * cut["x"], s.FEEDBACK_DELAY)]
        unsure = (gain * noise["x"].value) ** 2
    there = np.isfinite(cut["omega"]) & np.isfinite(sum(part for part, _ in parts))
    # What came before the first sample is not known as long as it is still to come.
    there[: math.ceil(max(w[delay] for _, delay in parts) / dt + max(LATE)) + 1] = False
    there[-1] = False
    if there.sum() < FEWEST:
        return None
    omega, tried = filled(cut["omega"]), []
    inputs = {held: [(hold_of(filled(part), 0.0, sampled=held), w[delay] / dt)
                     for part, delay in parts] for held in (False, True)}

    def log_likelihood(held: bool, by: float) -> float:
        lines = [later(one, samples + by) for one, samples in inputs[held]]
        tried.append(lagged(*map(sum, zip(*lines, strict=True)), omega, there, dt))
        return tried[-1].log_likelihood

    found = weighed(log_likelihood(False, 0.0), log_likelihood(True, 0.0),
                    partial(log_likelihood, False), partial(log_likelihood, True))
    best = ties.best(tried, lambda one: one.log_likelihood, within=ties.GUESS)
    level = np.sqrt(noise["omega"].value ** 2 + best.through * unsure)
    if best.lag < LAGGING * dt or not white(best.left[there] / max(level, FINEST)):
        return None
    return found, told


def command_is_held(recording: Recording, settings: Settings) -> bool:
    """Tell whether a drive with a lag holds its command: by the config, or by its speed."""
    if settings.command_hold != AUTO:
        return settings.command_hold == SAMPLED
    found = evidence_of_drive(recording, settings)
    return found is not None and found[0] >= DECISIVE


def telling_part(recording: Recording, raw: np.ndarray) -> tuple[int, dict[str, np.ndarray]]:
    """Return the stretch in which an input moves most: its first sample and its channels.

    Channel -> (n,), NaN where not finite.
    """
    length = min(len(raw), ASKED)
    start = most_telling(raw, recording.get("x"), length)
    let_go(raw)
    cut = {name: np.where(np.isfinite(values[start:start + length]),
                          values[start:start + length], np.nan)
           for name, values in recording.channels.items()}
    return start, {name: values for name, values in cut.items() if np.isfinite(values).any()}


def beyond(channels: dict[str, np.ndarray]) -> bool:
    """Tell of values that no rig has, and whose squares would not fit into a number."""
    return any(np.nanmax(np.abs(values)) > BEYOND for values in channels.values())


def _from(found: tuple[float, Stretch, Point], lines) -> tuple[float, Stretch, Point]:
    """Return the fit of another input that starts where one has ended."""
    best, at = climbed(found[1], lines, found[2])
    return best, found[1], at


def asked_of(recording: Recording, settings: Settings
             ) -> tuple[list[Stretch], Hold, Hold, str] | None:
    """Return what is asked: the stretch that tells most, both inputs on it, and of which channel.

    The stretch comes once for each friction that is taken as known.
    """
    rig, dt = settings.rig, recording.sample_time
    commanded = rig.position_gain is not None and recording.has("x_d")
    raw = (mapped(lambda x_d, x: rig.position_gain * (x_d - x), recording.get("x_d"),
                  recording.get("x")) if commanded else recording.get("omega"))
    start, cut = telling_part(recording, raw)
    if settings.effects.get(NAMES[LINE]):
        return None  # a line is late by itself, and is not in this filter
    part = Recording(dt, cut)
    if beyond(cut) or missing(settings, part.channels)[1] is not None:
        return None
    noise = noise_levels(part, settings.noise)
    recorded, _ = without_spikes(dict(part.channels), noise)
    circuit = circuit_of(*theta_of(rig, settings.effects))
    channels, noise = undo_sensors(recorded, noise, circuit, dt * (start + np.arange(len(part))))
    if commanded:
        gain = gain_followed(channels, noise, rig)
        if gain is None:
            channels = {name: values for name, values in channels.items() if name != "x_d"}
        elif gain != rig.position_gain:
            rig = rig.model_copy(update={"position_gain": gain})
            settings = settings.model_copy(update={"rig": rig})
    if missing(settings, channels)[1] is not None:
        return None  # the pump does not do as told, and what it does is not recorded
    by_demand = "x_d" in channels and rig.position_gain is not None
    continuous, sampled = (open_input(recorded, channels, noise, settings, hold, dt)
                           for hold in (CONTINUOUS, SAMPLED))
    if continuous is None or sampled is None:
        return None
    sigma = noise["x"].value * abs(rig.position_gain) if by_demand else noise["omega"].value
    return (stretches_of(channels, noise, settings, continuous, sigma, dt), continuous, sampled,
            "x_d" if by_demand else "omega")


def gain_followed(channels: dict[str, np.ndarray], noise: dict[str, NoiseEstimate], rig: Rig
                  ) -> float | None:
    """Return the K_pos that the pump follows at each stamp, rad/(s m); None where it follows none.

    That is the config's, or speed over position error by least squares within ``TOLERANCES`` of
    it: the config knows it to a few per cent, such a recording to a thousandth.
    """
    if follows(channels, noise, rig.position_gain):
        return rig.position_gain
    error, omega = channels["x_d"] - channels["x"], channels["omega"]
    rows = np.isfinite(error) & np.isfinite(omega)
    power = float(error[rows] @ error[rows])
    gain = float(error[rows] @ omega[rows]) / power if power > 0.0 else 0.0
    off = np.log(max(gain / rig.position_gain, FINEST))
    within = abs(off) <= TOLERANCES * rig.tolerance.log_spread("position_gain")
    return gain if within and follows(channels, noise, gain) else None


def follows(channels: dict[str, np.ndarray], noise: dict[str, NoiseEstimate], gain: float) -> bool:
    """Tell whether the pump follows K_pos (x_d - x) at each stamp, or is not recorded.

    Where it does not, the drive has a lag, a delay or a limit, and the speed that it made is the
    better input.
    """
    if "omega" not in channels:
        return True
    left = channels["omega"] - gain * (channels["x_d"] - channels["x"])
    return white(left[np.isfinite(left)] / np.hypot(noise["omega"].value, gain * noise["x"].value))


def white(left: np.ndarray, block: int = BLOCK) -> bool:
    """Tell whether residuals in standard deviations of the noise are no more than that, (n,)."""
    blocks = len(left) // block
    if not blocks:
        return True
    means = left[: blocks * block].reshape(blocks, block).mean(axis=1) * np.sqrt(block)
    return bool(np.mean(left**2) < IDEAL and np.mean(means**2) < IDEAL)


def open_input(recorded: dict, channels: dict, noise: dict, settings: Settings, hold: str,
               dt: float) -> Hold | None:
    """Return the pump's speed in each sample under a hold, without gaps; None where none came."""
    model = replace(RigModel.of(with_hold(settings, hold), commanded="x_d" in channels),
                    loop=False)
    made, _ = drive_input(model, recorded, channels, noise, dt)
    lines = []
    for line in (made.start, made.end):
        if np.isfinite(line).sum() < FEWEST:
            return None
        lines.append(filled(line))
    return made._replace(start=lines[0], end=lines[1])


def stretches_of(channels: dict, noise: dict, settings: Settings, drive: Hold, sigma: float,
                 dt: float) -> list[Stretch]:
    """Return the samples that are asked: without friction of their own, and with it."""
    rig = settings.rig
    model = RigModel.of(settings, commanded=False)
    constants = model.hydraulics.copy()
    constants[LOOP] = constants[LINE_TIME] = 0.0
    x, force = channels["x"], force_of(rig, channels)
    unsure = ~(drive.variance <= UNSURE * np.nanmedian(drive.variance))
    speed = float(np.sqrt(np.mean(drive.start**2)))
    # Without a force a wrong B looks like a late input: it may be off by as much as itself.
    wide = max(rig.viscous_damping, settings.stage_two.damping_stddev)
    ranges = [(np.zeros(len(x)), (rig.viscous_damping, wide))]
    z, levels = x[:, None], [noise["x"].value]
    usual = rig.viscous_damping * speed * rig.pump_displacement / rig.area_1
    if force is not None and np.isfinite(force).any():
        ranges = [friction_of(x, force, settings, dt, terms) for terms in (0, 2)]
        z = np.column_stack([x, force])
        levels.append(np.sqrt(force_variance(rig, noise, 0.0)))
        usual = float(np.sqrt(np.nanmean(force**2)))
    return [Stretch(np.ascontiguousarray(z), np.maximum(levels, FINEST), known, unsure, constants,
                    model.leak, dt, sigma, damping, max(usual, 1e-9), max(speed, 1e-9))
            for known, damping in ranges]


def friction_of(x: np.ndarray, force: np.ndarray, settings: Settings, dt: float, terms: int
                ) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the force that is not viscous, N (n,), and B with no limit to its deviation.

    F - M a = F_0 + B v + F_c tanh(v/v_c) + a_2 v |v| by least squares, friction never negative; of
    the last two ``terms`` are taken.
    """
    from scipy.optimize import nnls
    from scipy.signal import savgol_filter

    rig, whole = settings.rig, filled(x)
    window = max(SMOOTHED, round(SMOOTH_S / dt) // 2 * 2 + 1)
    v, a = (savgol_filter(whole, window, CUBIC, deriv=order, delta=dt) for order in (1, 2))
    highest = max(float(np.abs(v).max()), 1e-12)
    columns = np.column_stack([np.ones(len(v)), v / highest, np.tanh(v / (CREEP * highest)),
                               v * np.abs(v / highest) / highest][: 2 + terms])
    rest = force - rig.mass * a
    rows = np.isfinite(rest)
    # Only the constant force may have either sign: it is a difference of two.
    weights = nnls(np.column_stack([columns, -columns[:, :1]])[rows], rest[rows])[0]
    weights = np.append(weights[0] - weights[-1], weights[1:-1])
    damping = max(weights[1] / highest, 0.1 * rig.viscous_damping)
    return weights[0] + columns[:, 2:] @ weights[2:], (damping, np.inf)
