"""What the stages take from a recording that is too long to be held at once.

Each piece is made as the live estimator makes a batch: with the neighbours that a hold looks at on
both sides, and with what is known about all rows.  So a stage that goes from piece to piece gets
the numbers that it would get at once.  What must be known of all rows before the first, such as
the sensors' noise, is measured on stretches from all over the recording.
"""

import math
from collections.abc import Iterator

import numpy as np

from eha_monitor.filters.inputs import Known, Piece, StageInputs, missing
from eha_monitor.filters.noise import noise_levels
from eha_monitor.physics import signals as s
from eha_monitor.recordings import columns
from eha_monitor.recordings.columns import Table
from eha_monitor.recordings.recording import Recording, rows_of, sample_of
from eha_monitor.settings.monitor import Settings

BESIDE = 32  # rows on both sides that holds, smoothing and spikes look at


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
            max(circuit[s.COMMAND_DELAY], circuit[s.FEEDBACK_DELAY]) / self.dt)
        self._kept: dict[int, np.ndarray | None] = {0: None}  # piece -> what the drive remembers
        self._course, self._spikes, self._seen = Table(), {}, 0

    @property
    def measured_force(self) -> np.ndarray:
        """Of the sample."""
        return self.facts.measured_force

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
        rows = rows_of(self.recording, begin, end)
        inputs = StageInputs.of(rows, self.settings, Known(
            self.model, self._shown, self.quantum, self.no_force, self.no_drive,
            self._kept[number], slice(first - begin, last - begin)), begin * self.dt)
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
        inputs = StageInputs.of(rows_of(self.recording, begin, end), self.settings, Known(
            self.model, self._shown, self.quantum, self.no_force, self.no_drive,
            self._kept[number]), begin * self.dt)
        return inputs.part(start - begin, stop - begin)
