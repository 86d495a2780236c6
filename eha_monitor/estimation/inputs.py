"""From a recording to what the stages take: force, drive input, noise, constants, reasons."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from eha_monitor.estimation.drive import Hold, drive_input, hold_of
from eha_monitor.estimation.results import NoiseEstimate
from eha_monitor.estimation.rig_model import (
    RigModel,
    force_of,
    force_variance,
    mean_pressure,
    measured_leakage,
    missing,
    model_for,
    valve_open,
)
from eha_monitor.estimation.sensors import noise_levels, undo_sensors, without_spikes
from eha_monitor.estimation.stage_one import RowsOne
from eha_monitor.estimation.stage_two import RowsTwo
from eha_monitor.physics import signals as s
from eha_monitor.physics.contributions import circuit_of
from eha_monitor.physics.parameters import theta_of
from eha_monitor.recordings import columns
from eha_monitor.recordings.columns import Table
from eha_monitor.recordings.position import quantum
from eha_monitor.recordings.recording import Recording, rows_of, sample_of
from eha_monitor.settings.monitor import Settings

BESIDE = 32  # rows on both sides that holds, smoothing and spikes look at


@dataclass(frozen=True)
class Known:
    """What the live estimator knows about its rows and does not measure anew on each batch.

    The reasons are those of the rows that it began with; ``started`` is what the drive
    remembers at the first row; ``counted`` are the rows whose spikes are counted; ``rest`` tells
    of each row whether everything rests.
    """

    model: RigModel
    noise: dict[str, NoiseEstimate]
    quantum: float
    no_force: str | None
    no_drive: str | None
    started: np.ndarray | None = None
    counted: slice | None = None
    rest: np.ndarray | None = None


@dataclass(frozen=True)
class Piece:
    """Rows that a stage takes at a time.

    Attributes
    ----------
    inputs : of these rows; the one before them comes first where there is one.
    first : the first of them in ``inputs``; ``row`` : its number in the recording.
    recording, within : rows that hold these and their neighbours, and where ``inputs`` lie there.
    """

    inputs: "StageInputs"
    first: int
    row: int
    recording: Recording | None
    within: slice


@dataclass(frozen=True)
class StageInputs:
    """Everything the two kernels take from one recording.

    ``measured_force`` is the force as sampled, N.  The holds' variances include the sensors'
    noise; the reasons are None where the stage can run.
    ``p1``, ``p2`` are the mean pressures of the sample before each, or one charge pressure;
    ``mean`` is :func:`mean_pressure`.
    ``quantum`` is the position's resolution in m, 0 where it is continuous; ``spikes`` counts the
    samples of each channel that were left out.  ``x``, ``noise`` and all that comes of them have
    the sensors' known errors undone.  ``kept`` is what the drive remembers after each sample.
    ``rest`` is where nothing moves, (n,) bool: the stages get no input there; stage two gets none
    where a stiff ``valve`` is open either, None without one.
    """

    model: RigModel
    dt: float
    x: np.ndarray
    measured_force: np.ndarray
    force: Hold
    drive: Hold
    leak_flow: np.ndarray
    p1: np.ndarray
    p2: np.ndarray
    mean: np.ndarray
    noise: dict[str, NoiseEstimate]
    position_variance: float
    quantum: float
    no_force: str | None
    no_drive: str | None
    spikes: dict[str, int]
    kept: np.ndarray
    rest: np.ndarray
    valve: np.ndarray | None = None

    @classmethod
    def of(cls, recording: Recording, settings: Settings, known: Known | None = None,
           since: float = 0.0) -> "StageInputs":
        """Collect the inputs of a recording that starts ``since`` s after the record did."""
        rig = settings.rig
        names = [name for name in recording.channels if known or recording.has(name)]
        noise = shown = known.noise if known else noise_levels(recording, settings.noise)
        recorded, spikes = without_spikes(
            {name: recording.channels[name] for name in names}, noise,
            known.counted if known else None)
        circuit = known.model.circuit if known else circuit_of(*theta_of(rig, settings.effects))
        channels, noise = undo_sensors(
            recorded, noise, circuit, since + recording.sample_time * np.arange(len(recording)))
        if known:
            model, step = known.model, known.quantum
            no_force, no_drive = known.no_force, known.no_drive
        else:
            model, step = model_for(channels, settings), quantum_of(channels)
            no_force, no_drive = missing(settings, channels)
        measured_force = np.full(len(recording), np.nan)
        force = drive = Hold(*(measured_force,) * 4)
        kept = np.empty((len(recording), 0))
        if no_force is None:
            variance = force_variance(rig, noise, settings.stage_one.force_noise)
            measured_force = force_of(rig, channels)
            force = hold_of(measured_force, variance**0.5, kinked=model.held).with_noise(variance)
        if no_drive is None:
            drive, kept = drive_input(model, recorded, channels, noise, recording.sample_time,
                                      known.started if known else None)
        both = "p1" in channels and "p2" in channels
        charge = np.array([rig.charge_pressure])
        leak_flow = measured_leakage(rig, channels)
        return cls(
            model, recording.sample_time,
            channels.get("x", np.full(len(recording), np.nan)), measured_force, force, drive,
            np.zeros(len(recording)) if leak_flow is None else between(leak_flow),
            between(channels["p1"]) if both else charge,
            between(channels["p2"]) if both else charge, mean_pressure(channels, rig), noise,
            position_variance(noise, step), step, no_force, no_drive, spikes, kept,
            known.rest if known and known.rest is not None else
            resting(recording.channels, shown, recording.sample_time, step),
            valve_open(model, channels, noise["p1"].value) if model.valves else None)

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(self.x)

    @property
    def course(self) -> tuple[np.ndarray, np.ndarray]:
        """The drive's input at the start of each sample, and the position; (n,) each."""
        return self.drive.start, self.x

    def rows_one(self, stop: int | None = None) -> RowsOne:
        """Return what stage one takes of the samples up to ``stop``."""
        force = self.force
        return RowsOne(*(values[:stop] for values in (
            self.x, self.moving(force.start), self.moving(force.end), force.variance, self.p1,
            self.p2)))

    def moving(self, values: np.ndarray) -> np.ndarray:
        """Return an input, NaN where everything rests."""
        return np.where(self.rest, np.nan, values) if self.rest.any() else values

    def rows_two(self, b: np.ndarray | float, b_variance: np.ndarray | float,
                 stop: int | None = None) -> RowsTwo:
        """Return what stage two takes of the samples up to ``stop``, with a damping for each."""
        size = self.rows if stop is None else stop
        given = (np.full(size, values, dtype=float) if np.ndim(values) == 0
                 else np.array(values[:size], dtype=float) for values in (b, b_variance))
        start, *others = self.drive
        start = self.moving(start)
        if self.valve is not None:
            start = np.where(self.valve, np.nan, start)
        return RowsTwo(self.x[:stop], *(values[:stop] for values in (start, *others)), *given,
                       self.leak_flow[:stop], self.mean[:stop])

    def pieces(self, recording: Recording | None = None, begin: int = 0) -> Iterator[Piece]:
        """Yield the rows of ``recording`` from ``begin`` on at once, see :class:`PiecedInputs`."""
        part = self.part(begin, self.rows) if begin else self
        yield Piece(part, 0, begin, recording, slice(begin, None))

    def part(self, start: int, stop: int) -> "StageInputs":
        """Return the inputs of samples ``start`` to ``stop``."""
        n, cut = len(self.x), slice(start, stop)
        changed = {
            field.name: value[cut] for field in fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray) and len(value) == n}
        for name in ("force", "drive"):
            changed[name] = getattr(self, name).part(cut)
        return replace(self, **changed)


def quantum_of(channels: dict[str, np.ndarray]) -> float:
    """Return the step of the position, m; 0 where it is continuous or absent."""
    x = channels.get("x", np.empty(0))
    return quantum(x[np.isfinite(x)])


def position_variance(noise: dict[str, NoiseEstimate], step: float) -> float:
    """Return the variance of the measured position, m^2.

    A rounding error is not white: on periodic motion it repeats with the motion.  Where it
    dominates it counts with twice its standard deviation, step/sqrt(3).
    """
    if "x" not in noise:
        return np.nan
    return max(noise["x"].value, step / np.sqrt(3.0)) ** 2


def between(values: np.ndarray) -> np.ndarray:
    """Return the mean over the sample before each; at one end alone where the other is missing.

    A pressure taken from one end would be half a sample late or early, which a modelled leakage
    shows as a change of beta_e.
    """
    before = np.concatenate([values[:1], values[:-1]])
    mean = 0.5 * (before + values)
    return np.where(np.isnan(mean), np.where(np.isnan(values), before, values), mean)


def time_of(recording: Recording) -> np.ndarray:
    """Return (n,) s since the first sample, in memory or not as the columns of a stage."""
    made = Table()
    for start, stop in columns.pieces(len(recording)):
        made.append((np.arange(start, stop) * recording.sample_time)[None, :])
    return made.only()


def inputs_of(recording: Recording, settings: Settings,
              size: int | None = None) -> "StageInputs | PiecedInputs":
    """Return what the stages take from a recording: at once, or piece by piece where it is long.

    ``size`` : rows of a piece, whatever the length.
    """
    if size is None and len(recording) <= columns.IN_MEMORY:
        return StageInputs.of(recording, settings)
    return PiecedInputs(recording, settings, size or columns.PIECE)


class PiecedInputs:
    """The inputs of a long recording; what :class:`StageInputs` is, but for its arrays.

    Each piece is made as the live estimator makes a batch: with the neighbours that a hold looks
    at on both sides, and with what is known about all rows.  So a stage that goes from piece to
    piece gets the numbers that it would get at once.  What must be known of all rows before the
    first, such as the sensors' noise, is measured on stretches from all over the recording.

    Attributes
    ----------
    rows : of the recording.
    sample, facts : stretches from all over it, and the inputs of these.
    spikes : samples of each channel that were left out, once all pieces have been asked for.
    """

    def __init__(self, recording: Recording, settings: Settings, size: int):
        self.recording, self.settings, self.size = recording, settings, max(size, 4 * BESIDE)
        self.rows, self.dt = len(recording), recording.sample_time
        self.sample = sample_of(recording)
        self.facts = StageInputs.of(self.sample, settings)
        names = [name for name in recording.channels if recording.has(name)]
        self.no_force, self.no_drive = missing(settings, names)
        self.noise, self.quantum = self.facts.noise, self.facts.quantum
        self._shown = noise_levels(self.sample, settings.noise)  # before known errors are undone
        self.position_variance, self.model = self.facts.position_variance, self.facts.model
        circuit = self.model.circuit
        self._ahead = BESIDE + math.ceil(
            max(circuit[s.POSITION_DELAY], circuit[s.PRESSURE_DELAY]) / self.dt)
        self._back = BESIDE + math.ceil(
            max(circuit[s.COMMAND_DELAY], circuit[s.FEEDBACK_DELAY], REST_S) / self.dt)
        self._kept: dict[int, np.ndarray | None] = {0: None}  # piece -> what the drive remembers
        self._course, self._spikes, self._seen = Table(), {}, 0

    @property
    def rest(self) -> np.ndarray:
        """Of the sample."""
        return self.facts.rest

    @property
    def spikes(self) -> dict[str, int]:
        """How many lone wild samples of each channel were left out."""
        self._survey()
        return self._spikes

    @property
    def course(self) -> tuple[np.ndarray, np.ndarray]:
        """The drive's input at the start of each sample, and the position; (n,) each."""
        self._survey()
        start, x = self._course.values()
        return start, x

    def _survey(self) -> None:
        """Go through what no stage has gone through."""
        while self._seen < self._pieces:
            self._piece(self._seen)

    @property
    def _pieces(self) -> int:
        return -(-self.rows // self.size)

    def _piece(self, number: int) -> tuple[StageInputs, int, Recording]:
        """Return the inputs of a piece with its neighbours, their first row, and the rows."""
        first, last = number * self.size, min((number + 1) * self.size, self.rows)
        begin, end = max(first - self._back, 0), min(last + self._ahead, self.rows)
        while self._seen < number:  # what the drive remembers comes from the piece before
            self._piece(self._seen)
        inputs, rows = self._between(begin, end, number, slice(first - begin, last - begin))
        if number == self._seen:
            self._seen += 1
            following = max(last - self._back, 0) - begin
            self._kept[number + 1] = (inputs.kept[following].copy()
                                      if inputs.kept.shape[1] else None)
            here = slice(first - begin, last - begin)
            self._course.append(np.stack([inputs.drive.start[here], inputs.x[here]]))
            for name, count in inputs.spikes.items():
                self._spikes[name] = self._spikes.get(name, 0) + count
        return inputs, begin, rows

    def pieces(self, recording: Recording | None = None, begin: int = 0) -> Iterator[Piece]:
        """Yield the rows from ``begin`` on, piece by piece."""
        for number in range(begin // self.size, self._pieces):
            inputs, at, rows = self._piece(number)
            first, last = max(number * self.size, begin), min((number + 1) * self.size, self.rows)
            before = max(first - 1, begin)
            within = slice(before - at, last - at)
            yield Piece(inputs.part(within.start, within.stop), first - before, first, rows,
                        within)

    def part(self, start: int, stop: int) -> StageInputs:
        """Return the inputs of rows ``start`` to ``stop``, which fit into memory."""
        number = start // self.size
        self._survey()
        begin, end = max(number * self.size - self._back, 0), min(stop + self._ahead, self.rows)
        return self._between(begin, end, number)[0].part(start - begin, stop - begin)

    def _between(self, begin: int, end: int, number: int, counted: slice | None = None
                 ) -> tuple[StageInputs, Recording]:
        """Return the inputs of rows ``begin`` to ``end``, the first of piece ``number``'s."""
        rows = rows_of(self.recording, begin, end)
        return StageInputs.of(rows, self.settings, Known(
            self.model, self._shown, self.quantum, self.no_force, self.no_drive,
            self._kept[number], counted), begin * self.dt), rows


Inputs = StageInputs | PiecedInputs


REST_S = 0.25  # s without motion that make a rest
RESTING = 1.5  # times the noise: the deviation over so long of what does not move
DRIVE, FORCE = ("x_d", "omega_d", "omega"), ("force", "p1", "p2")  # what moves a piston
SMALLEST = 1e-9  # of the largest value: the noise of a demand that holds none


def resting(channels: Mapping[str, np.ndarray], noise: Mapping[str, NoiseEstimate], dt: float,
            step: float) -> np.ndarray:
    """Return where neither the piston nor its drive has moved for ``REST_S``, (n,) bool.

    Parameters
    ----------
    channels : by name, (n,) SI, NaN where missing.
    noise : of the channels; ``step`` of the position, m.
    dt : s between samples.
    """
    moves = ([name for name in DRIVE if name in channels]
             or [name for name in FORCE if name in channels])
    count = max(round(REST_S / dt), 4)
    if "x" not in channels or len(channels["x"]) < count:
        return np.zeros(len(channels.get("x", ())), dtype=bool)
    found = np.ones(len(channels["x"]), dtype=bool)
    for name in ("x", *moves):
        level = noise[name].value if name in noise else 0.0
        if name == "x":
            level = max(level, step / np.sqrt(3.0))
        found &= _still(channels[name], count, level)
    return found


def _still(values: np.ndarray, count: int, level: float) -> np.ndarray:
    """Return where the last ``count`` values differ by no more than noise of that level."""
    there = np.isfinite(values)
    if not there.any():
        return np.ones(len(values), dtype=bool)
    level = max(level, SMALLEST * float(np.abs(values[there]).max()))
    plain = np.where(there, values - values[there][0], 0.0)
    known, first, second = (np.concatenate([[0.0], np.cumsum(one)])
                            for one in (there.astype(float), plain, plain**2))
    n, one, two = (total[count:] - total[:-count] for total in (known, first, second))
    still = two - one**2 / np.maximum(n, 1.0) <= (RESTING * level) ** 2 * n
    # Before the first window is whole, its own verdict stands.
    return np.concatenate([np.full(count - 1, still[0]), still])
