"""Running stage two over a recording: where it starts, and anew after a large change."""

from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.filters import kernel_two
from eha_monitor.filters.engine import engine_of
from eha_monitor.filters.inputs import StageInputs
from eha_monitor.filters.known import new_known_memory
from eha_monitor.filters.stage_two import C_PLACE, states_beside_c
from eha_monitor.filters.supervision import FROZEN, HELD, gave_up, new_supervision
from eha_monitor.settings.monitor import Settings

BANK_RATIO = 1.06  # spacing of the bulk moduli tried; half a ring's phase over its life
BANK_SPAN = 30.0  # times below and above the prior
BANK_SECONDS = 2.0
NEARLY = 0.3  # share of the most that a stretch tells, with which an earlier one is taken
BANK_LONGER = 4  # times as long a stretch, while the bank's sigma is above
BANK_LONGEST = 30.0  # s
BANK_SHARP = 0.04  # of the compliance
BANK_FAR = 0.5  # relative sigma above which no filter is started: it would go astray
BANK_UNLIKELY = 1e-6  # weight over the best one's below which a compliance is not tried again
SHARP = 0.005  # relative sigma below which a second pass is worth it
CLOSE = 0.01  # and that at least, with which it starts
LARGE = 0.03  # relative change of the modulus upon which the bank is asked again
SHORTEST = 500  # samples between two such starts
MOST_STARTS = 6
MOST_EVENTS = 200  # detected changes that are kept


def most_telling(drive: np.ndarray, x: np.ndarray, length: int) -> int:
    """Return the start of the stretch of ``length`` samples where the drive moves most.

    Among stretches that are nearly as good the first one: the filter starts where the recording
    starts, and a later stretch may show a modulus that has changed since.
    """
    moved = np.abs(np.diff(drive, prepend=drive[:1]))
    moved[~(np.isfinite(moved) & np.isfinite(x))] = 0.0
    total = np.concatenate([[0.0], np.cumsum(moved**2)])
    if len(moved) <= length:
        return 0
    told = total[length:] - total[:-length]
    return int(np.argmax(told >= NEARLY * told.max()))


def start_compliance(inputs: StageInputs, settings: Settings,
                     damping: np.ndarray) -> tuple[float, float]:
    """Return where stage two's compliance starts and its variance, from a bank of filters.

    The bank takes the stretch that tells most, and a longer one while that tells too little: an
    extended filter that starts far away learns from a trajectory that is not the rig's, and can
    settle anywhere with a small sigma.  The variance is 25 times what the bank says, so that the
    stretch which is then filtered again is not counted twice (4 % of its information at most);
    8 times where it took a longer stretch, since from farther away the filter goes astray
    (10 um on triangles, 12 draws each: error over sigma 1.4 at 12 s, 1.0 at 24 s with 8; 2.5 with
    25.  The 8 was picked on these draws).

    Where the bank cannot tell, as while the motion is steady, it is the prior's: 1 and its
    variance.
    """
    broad = prior_variance(settings)
    steps = round(np.log(BANK_SPAN) / np.log(BANK_RATIO))
    grid = BANK_RATIO ** np.arange(-steps, steps + 1)
    length = min(len(inputs.x), round(BANK_SECONDS / inputs.dt))
    longest = min(len(inputs.x), round(BANK_LONGEST / inputs.dt))
    inflation = 25.0
    while True:
        weight = bank_weights(inputs, settings, damping, grid, length)
        if weight is None:
            return 1.0, broad
        mean = float(weight @ grid)
        variance = float(weight @ (grid - mean) ** 2) + (BANK_RATIO - 1.0) ** 2 * mean**2 / 12.0
        if variance <= (BANK_SHARP * mean) ** 2 or length >= longest:
            break
        grid = grid[weight > BANK_UNLIKELY * weight.max()]
        length = min(longest, BANK_LONGER * length)
        inflation = 8.0
    variance *= inflation
    return (mean, variance) if variance < min(broad, (BANK_FAR * mean) ** 2) else (1.0, broad)


def bank_weights(inputs: StageInputs, settings: Settings, damping: np.ndarray,
                 grid: np.ndarray, length: int) -> np.ndarray | None:
    """Return the posterior weights of the compliances ``grid`` from ``length`` samples."""
    start = most_telling(inputs.drive.start, inputs.x, length)
    if not np.nan_to_num(np.diff(inputs.drive.start)).any():
        return None  # a drive at rest tells nothing
    part = slice(start, start + length)
    model = inputs.model
    likelihood = kernel_two.bank_two(
        inputs.x[part], inputs.drive.start[part], inputs.drive.end[part],
        inputs.drive.variance[part], inputs.drive.instrument[part],
        damping[start + length // 2], grid, model.hydraulics, model.leak, inputs.leak_flow[part],
        inputs.dt, inputs.position_variance, force_noise_variance(settings),
        inputs.mean[part] if len(inputs.mean) > 1 else inputs.mean, model.theta, model.plain,
        model.remembering, model.flows, new_known_memory())
    likelihood = np.where(np.isfinite(likelihood), likelihood, -np.inf)
    if not np.isfinite(likelihood).any():
        return None
    weight = np.exp(likelihood - likelihood.max()) * grid  # even in c on a logarithmic grid
    return weight / weight.sum()


def prior_variance(settings: Settings) -> float:
    """Variance of the relative compliance before any data."""
    return (settings.stage_two.prior_stddev / settings.stage_two.prior) ** 2


def force_noise_variance(settings: Settings) -> float:
    """Variance of an unmodelled force on a sample in stage two, N^2."""
    return (settings.rig.mass * settings.stage_two.acceleration_noise) ** 2


@dataclass(frozen=True)
class KernelTwoResult:
    """What stage two leaves: (8, n) output, changes, and the state to go on from."""

    out: np.ndarray
    changes: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    sensitivity: np.ndarray
    watch: np.ndarray
    memory: np.ndarray
    matrices: np.ndarray
    at: np.ndarray


def run_stage_two_kernel(inputs: StageInputs, settings: Settings, damping: np.ndarray,
                         damping_variance: np.ndarray) -> KernelTwoResult:
    """Run stage two over the whole recording.

    It starts where the bank of filters says.  After a large change the linear step that the
    watch makes is only a hint: the filter starts anew from the bank, at the samples that showed
    the change.  A modulus that hops to and fro without large steps is held.
    """
    n = len(inputs.x)
    out = np.empty((8, n))
    kept: list[np.ndarray] = []
    begin = 0
    for _ in range(MOST_STARTS):
        result = run_from(begin, inputs, settings, damping, damping_variance, out)
        changes = result.changes
        if kept:  # what the change led to is known now
            kept[-1][2] = out[3, min(int(kept[-1][0]) + SHORTEST, n - 1)]
        large = [row for row in changes if row[0] - row[3] >= begin + SHORTEST
                 and abs(row[2] / row[1] - 1.0) > LARGE]
        if not large:
            if gave_up(result.watch):
                result = run_from(0, inputs, settings, damping, damping_variance, out,
                                  frozen=True)
                return replace(result, out=out)
            break
        sample, window = large[0][0], large[0][3]
        kept += [row for row in changes if row[0] <= sample]
        begin = int(sample - window)
    return replace(result, out=out, changes=np.array([*kept, *result.changes]).reshape(-1, 4))


def run_from(begin: int, inputs: StageInputs, settings: Settings, damping: np.ndarray,
             damping_variance: np.ndarray, out: np.ndarray, *,
             frozen: bool = False) -> KernelTwoResult:
    """Run the stage from sample ``begin`` to the end, writing ``out`` from there on.

    Where the recording's start does not tell the compliance it is held at the prior: while the
    motion is steady an extended filter gathers information that is not there (a piston at
    constant speed: 4e9 +- 1e8 Pa after half a second, for 6e8).
    """
    part = inputs.part(begin, len(inputs.x)) if begin else inputs
    b, b_variance = damping[begin:], damping_variance[begin:]
    start, variance = start_compliance(part, settings, b)
    model, drive = inputs.model, part.drive
    broad, run_two = prior_variance(settings), engine_of(settings)[1]
    written, changes = np.empty((8, len(part.x))), np.empty((MOST_EVENTS, 4))
    held = begin == 0 and variance == broad
    # Once more from where it led, if that is sharp: what the filter learns from a ringing oil
    # column is right only near the answer.
    for _ in range(2):
        m = np.zeros(states_beside_c(model.hydraulics) + 1)
        m[0], m[C_PLACE] = np.nan, start
        p = np.zeros((len(m), len(m)))
        p[C_PLACE, C_PLACE] = variance
        sens, watch, memory = np.zeros(len(m)), new_supervision(frozen), new_known_memory()
        if held:
            watch[FROZEN] = HELD
        matrices, at = kernel_two.new_step(model.hydraulics)
        found = run_two(
            part.x, drive.start, drive.end, drive.variance, drive.instrument, b, b_variance,
            model.hydraulics, model.leak, part.leak_flow, inputs.dt, inputs.position_variance,
            force_noise_variance(settings), broad, part.mean, model.theta, model.plain,
            model.remembering, model.flows, memory, m, p, sens, watch, matrices, at, 0, written,
            changes)
        last = max(int(changes[0, 0] - 2 * changes[0, 3]), 0) if found else len(part.x) - 1
        sigma = written[4, last] / written[3, last]  # what it came to before any change
        if not sigma < SHARP:
            break
        start = model.beta_0 / written[3, last]
        variance = min(variance, max(25.0 * sigma**2, CLOSE**2) * start**2)
    out[:, begin:] = written
    changes = changes[: min(found, MOST_EVENTS)].copy()
    changes[:, 0] += begin
    return KernelTwoResult(out, changes, m, p, sens, watch, memory, matrices, at)
