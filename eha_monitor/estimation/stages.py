"""Running both stages over a recording: what they take, where they start, anew after a change."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from eha_monitor.estimation import stage_one, stage_two
from eha_monitor.estimation.inputs import Inputs
from eha_monitor.estimation.modelled import contributions_along
from eha_monitor.estimation.rig_model import RigModel, moved_mass
from eha_monitor.estimation.stage_one import ConstantsOne, new_state_one
from eha_monitor.estimation.stage_two import ConstantsTwo, StateTwo, new_state_two
from eha_monitor.estimation.supervision import gave_up
from eha_monitor.physics.contributions import new_memory
from eha_monitor.physics.signals import FORCE, N_CONTRIBUTIONS, N_SIGNALS, P1, P2, V, X
from eha_monitor.physics.signals import M as MASS_PLACE
from eha_monitor.recordings.columns import Table, any_of, blocks, let_go
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


def engine_of(settings: Settings) -> tuple[Callable[..., int], Callable[..., int]]:
    """Return how stage one and stage two are run over rows, see :func:`stage_one.run_one`.

    Compiled, or filterpy as the readable reference.
    """
    if settings.engine == "compiled":
        return stage_one.run_one, stage_two.run_two
    from eha_monitor.estimation import reference_stages  # takes 0.3 s to load

    return reference_stages.run_one, reference_stages.run_two


def constants_one(inputs: Inputs, settings: Settings) -> ConstantsOne:
    """Return what stage one takes beside its rows."""
    return ConstantsOne(inputs.dt, moved_mass(inputs.model, inputs.dt), inputs.position_variance,
                        settings.stage_one.prior_stddev**2, settings.discretisation == "euler")


def constants_two(inputs: Inputs, settings: Settings) -> ConstantsTwo:
    """Return what stage two takes beside its rows."""
    model = inputs.model
    return ConstantsTwo(model.hydraulics, model.leak, inputs.dt, inputs.position_variance,
                        (settings.rig.mass * settings.stage_two.acceleration_noise) ** 2,
                        prior_variance(settings))


def prior_variance(settings: Settings) -> float:
    """Variance of the relative compliance before any data."""
    return (settings.stage_two.prior_stddev / settings.stage_two.prior) ** 2


class Changes:
    """The changes that a stage detects, piece by piece; the first of them are kept."""

    def __init__(self, rows: np.ndarray | None = None):
        self._parts = [np.empty((0, 4)) if rows is None else rows]
        self.found = len(self._parts[0])

    def add(self, events: np.ndarray, found: int, row: int) -> None:
        """Take what a stage wrote for a piece whose first row is ``row``."""
        part = events[: min(found, max(MOST_EVENTS - self.found, 0))].copy()
        part[:, 0] += row
        self._parts.append(part)
        self.found += found

    @property
    def rows(self) -> np.ndarray:
        """(k, 4) sample, before, after, samples that showed it."""
        return np.concatenate(self._parts)


def run_stage_one_kernel(inputs: Inputs, settings: Settings, frozen: bool = False
                         ) -> tuple[list[np.ndarray], Changes, np.ndarray]:
    """Run stage one over a recording.

    ``frozen`` : B is one constant; no change is looked for.

    Returns
    -------
    out, changes, watch
        The six outputs of :func:`stage_one.run_one` and the acceleration, (n,) each; the changes
        of B; the supervision at the end.
    """
    constants, effects = constants_one(inputs, settings), inputs.model.effects
    state = new_state_one(settings.stage_one.prior, constants.prior_variance, frozen)
    written, seen, memory = Table(), Changes(), new_memory()
    for piece in inputs.pieces():
        part = piece.inputs
        out, changes = np.empty((6, part.rows)), np.empty((MOST_EVENTS, 4))
        found = engine_of(settings)[0](part.rows_one(), constants, effects, state, piece.first,
                                       out, changes)
        seen.add(changes, found, piece.row - piece.first)
        acceleration = (part.force.start - out[2] * out[1] - modelled_along(
            part, out, inputs.model, memory)) / effects.theta[MASS_PLACE]
        written.append(np.vstack([out, acceleration])[:, piece.first:])
    return written.values(), seen, state.watch


def modelled_along(part: Inputs, out: np.ndarray, model: RigModel, memory: np.ndarray
                   ) -> np.ndarray | float:
    """Return the force of the config's effects at the states of stage one, (n,) N.

    ``memory`` is theirs, and goes on from part to part.
    """
    if not len(model.effects.plain) + len(model.effects.remembering):
        return 0.0
    track, found = np.zeros((part.rows, N_SIGNALS)), np.empty((part.rows, N_CONTRIBUTIONS))
    track[:, X], track[:, V], track[:, P1], track[:, P2] = out[0], out[1], part.p1, part.p2
    contributions_along(np.nan_to_num(track), part.dt, 2, model.theta, model.active, memory, found)
    return found[:, FORCE]


def most_telling(drive: np.ndarray, x: np.ndarray, length: int) -> int:
    """Return the start of the stretch of ``length`` samples where the drive moves most.

    Among stretches that are nearly as good the first one: the filter starts where the recording
    starts, and a later stretch may show a modulus that has changed since.
    """
    if len(drive) <= length:
        return 0
    best = max(float(told.max(initial=0.0)) for _, told in _told(drive, x, length))
    return next(first + int(np.argmax(told >= NEARLY * best))
                for first, told in _told(drive, x, length) if (told >= NEARLY * best).any())


def _told(drive: np.ndarray, x: np.ndarray, length: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield, piece by piece, the first start and how much the drive moves from each start on."""
    last, sums, seen = drive[:1].copy(), np.zeros(1), 0
    for _, stop, (u, measured) in blocks(drive, x):
        moved = np.abs(np.diff(u, prepend=last))
        moved[~(np.isfinite(moved) & np.isfinite(measured))] = 0.0
        # One running sum over all pieces; of the sums before, as many as a stretch is long.
        further = np.cumsum(np.concatenate([sums[-1:], moved**2]))
        sums, last = np.concatenate([sums[:-1], further]), u[-1:].copy()
        if len(sums) > length:
            yield seen, sums[length:] - sums[:-length]
            sums = sums[len(sums) - length:]
            seen = stop + 1 - length


def start_compliance(inputs: Inputs, settings: Settings, damping: np.ndarray,
                     begin: int = 0) -> tuple[float, float]:
    """Return where stage two's compliance starts and its variance, from a bank of filters.

    The bank takes the stretch that tells most, and a longer one while that tells too little: an
    extended filter that starts far away learns from a trajectory that is not the rig's, and can
    settle anywhere with a small sigma.  The variance is 25 times what the bank says, so that the
    stretch which is then filtered again is not counted twice (4 % of its information at most);
    8 times where it took a longer stretch, since from farther away the filter goes astray
    (10 um on triangles, 12 draws each: error over sigma 1.4 at 12 s, 1.0 at 24 s with 8; 2.5 with
    25.  The 8 was picked on these draws).

    Asked are the samples from ``begin`` on.  Where the bank cannot tell, as while the motion is
    steady, it is the prior's: 1 and its variance.
    """
    broad = prior_variance(settings)
    steps = round(np.log(BANK_SPAN) / np.log(BANK_RATIO))
    grid = BANK_RATIO ** np.arange(-steps, steps + 1)
    rows = inputs.rows - begin
    length = min(rows, round(BANK_SECONDS / inputs.dt))
    longest = min(rows, round(BANK_LONGEST / inputs.dt))
    inflation = 25.0
    while True:
        weight = bank_weights(inputs, settings, damping, grid, length, begin)
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


def bank_weights(inputs: Inputs, settings: Settings, damping: np.ndarray,
                 grid: np.ndarray, length: int, begin: int = 0) -> np.ndarray | None:
    """Return the posterior weights of the compliances ``grid`` from ``length`` samples."""
    drive, x = (values[begin:] for values in inputs.course)
    if not any_of((drive,), lambda rows: np.nan_to_num(np.diff(rows)) != 0.0):
        return None  # a drive at rest tells nothing
    start = begin + most_telling(drive, x, length)
    part, model = inputs.part(start, start + length), inputs.model
    rows = part.rows_two(damping[start + length // 2], 0.0)
    constants = constants_two(inputs, settings)
    likelihood = np.array([stage_two.log_likelihood_two(rows, constants, model.effects, c)
                           for c in grid])
    likelihood = np.where(np.isfinite(likelihood), likelihood, -np.inf)
    if not np.isfinite(likelihood).any():
        return None
    weight = np.exp(likelihood - likelihood.max()) * grid  # even in c on a logarithmic grid
    return weight / weight.sum()


@dataclass(frozen=True)
class StageTwoRun:
    """What stage two leaves: (8, n) output, changes, and the state to go on from."""

    out: list[np.ndarray]
    changes: np.ndarray
    state: StateTwo


def run_stage_two_kernel(inputs: Inputs, settings: Settings, damping: np.ndarray,
                         damping_variance: np.ndarray) -> StageTwoRun:
    """Run stage two over the whole recording.

    It starts where the bank of filters says.  After a large change the linear step that the
    watch makes is only a hint: the filter starts anew from the bank, at the samples that showed
    the change.  A modulus that hops to and fro without large steps is held.
    """
    kept: list[np.ndarray] = []
    begin, before = 0, None
    for _ in range(MOST_STARTS):
        result = run_from(begin, inputs, settings, damping, damping_variance, before=before)
        changes, before = result.changes, result.out
        if kept:  # what the change led to is known now
            kept[-1][2] = result.out[3][min(int(kept[-1][0]) + SHORTEST, inputs.rows - 1)]
        large = [row for row in changes if row[0] - row[3] >= begin + SHORTEST
                 and abs(row[2] / row[1] - 1.0) > LARGE]
        if not large:
            if gave_up(result.state.watch):
                return run_from(0, inputs, settings, damping, damping_variance, frozen=True)
            break
        sample, window = large[0][0], large[0][3]
        kept += [row for row in changes if row[0] <= sample]
        begin = int(sample - window)
    return replace(result, changes=np.array([*kept, *result.changes]).reshape(-1, 4))


def run_from(begin: int, inputs: Inputs, settings: Settings, damping: np.ndarray,
             damping_variance: np.ndarray, *, frozen: bool = False,
             before: list[np.ndarray] | None = None) -> StageTwoRun:
    """Run the stage from sample ``begin`` to the end; ``before`` is the output up to there.

    Where the recording's start does not tell the compliance it is held at the prior: while the
    motion is steady an extended filter gathers information that is not there (a piston at
    constant speed: 4e9 +- 1e8 Pa after half a second, for 6e8).
    """
    start, variance = start_compliance(inputs, settings, damping, begin)
    model, constants = inputs.model, constants_two(inputs, settings)
    run_two = engine_of(settings)[1]
    held = begin == 0 and variance == constants.prior_variance
    # Once more from where it led, if that is sharp: what the filter learns from a ringing oil
    # column is right only near the answer.
    for _ in range(2):
        state = new_state_two(model.hydraulics, start, variance, frozen, held)
        written, seen = Table.begun(before, begin), Changes()
        for piece in inputs.pieces(begin=begin):
            part, row = piece.inputs, piece.row - piece.first
            out, changes = np.empty((8, part.rows)), np.empty((MOST_EVENTS, 4))
            here = slice(row, row + part.rows)
            found = run_two(part.rows_two(damping[here], damping_variance[here]), constants,
                            model.effects, state, piece.first, out, changes)
            written.append(out[:, piece.first:])
            seen.add(changes, found, row)
            let_go(damping, damping_variance)
        out, changes = written.values(), seen.rows
        last = (max(int(changes[0, 0] - 2 * changes[0, 3]), begin) if len(changes)
                else inputs.rows - 1)
        sigma = out[4][last] / out[3][last]  # what it came to before any change
        if not sigma < SHARP:
            break
        start = model.beta_0 / out[3][last]
        variance = min(variance, max(25.0 * sigma**2, CLOSE**2) * start**2)
    return StageTwoRun(out, changes, state)
