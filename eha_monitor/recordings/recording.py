"""The one type that all offline work reads: aligned channels on a uniform time grid.

With it: which numbers can be measurements, parts that fit into memory, and what channels show
about how they were configured.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.recordings import columns
from eha_monitor.recordings.columns import any_of, let_go, stretches
from eha_monitor.settings.channels import CHANNELS as CHANNELS

# Channel -> largest absolute value that can be a measurement, and its unit.  Far beyond any
# sensor, and beyond any mistake of unit that is worth naming (micrometres for metres, bar for
# pascals a second time, rpm for rad/s), so that such recordings are read and the mistake is
# reported.  What lies further out is no measurement: a damaged message, or a simulation that ran
# away.
LIMITS = {"x": (1e9, "m"), "v": (1e9, "m/s"), "x_d": (1e9, "m"), "omega": (1e9, "rad/s"),
          "omega_d": (1e9, "rad/s"), "p1": (1e13, "Pa"), "p2": (1e13, "Pa"),
          "force": (1e12, "N"), "temperature": (1e6, "°C")}
LARGEST = {name: largest for name, (largest, _) in LIMITS.items()}
# Stamps before 2000 count from the start of a computer or of a simulation.
CALENDAR_NS = 946_684_800 * 10**9
SHORTEST_S = 0.5  # from less nothing is estimated, and nothing is explained
STRETCH = 4096  # rows of each stretch of a sample
Kind = Literal["swapped", "sign", "unit", "offset", "hold", "zero"]
FEW = 3  # samples in a row, or in all, that a channel may spend out there at its end
SHARE = 0.01  # of a channel's numbers


def within_limits(name: str, values: np.ndarray, time: np.ndarray, source: str
                  ) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a channel with NaN for what is no measurement, and sentences about it.

    A few such values are left out; a channel that goes there and stays is refused, because what it
    showed on the way there is no measurement either.  Raises InputError if the channel ran away:
    it went beyond the limit and did not come back, or is there for more than 1 % of its numbers.

    Parameters
    ----------
    name : channel; one that has no limit is only freed of infinities.
    values : (n,) SI, NaN where nothing was measured.
    time : (n,) s, for the sentences.
    source : file (and topic), for errors.
    """
    limit, unit = LIMITS.get(name, (np.inf, ""))
    finite = min(limit, np.finfo(float).max)
    if np.fmax.reduce(values, initial=0.0) <= finite and (
            np.fmin.reduce(values, initial=0.0) >= -finite):
        return values, ()
    infinite = np.isinf(values)
    beyond = (np.abs(values) > limit) & ~infinite
    said = []
    if infinite.any():
        said.append(f"{name}: {int(infinite.sum())} of {len(values)} values are infinite, "
                    "left out")
    if beyond.any():
        first = int(np.argmax(beyond))
        where = (f"{values[first]:.3g} {unit} at t = {time[first]:.3f} s, beyond ±{limit:.0e} "
                 f"{unit}")
        numbers = np.flatnonzero(np.isfinite(values))
        good = numbers[~beyond[numbers]]
        after = int(np.sum(numbers > good[-1])) if len(good) else len(numbers)
        if after > FEW or beyond.sum() > max(FEW, SHARE * len(numbers)):
            raise InputError(
                f"{source}: {name} is out of range: {where}, as {int(beyond.sum())} of its "
                f"{len(numbers)} numbers are; expected a measurement in SI")
        said.append(f"{name}: {int(beyond.sum())} of {len(values)} values are not valid "
                    f"measurements ({where}), left out")
    return np.where(infinite | beyond, np.nan, values), tuple(said)


@dataclass(frozen=True)
class Recording:
    """Aligned channels of one recording, SI units, gaps as NaN.

    Every number in it lies where a sensor can show it (:data:`LIMITS`): whoever makes one of
    channels that run away gets an InputError, and what was left out stands in ``losses``.
    """

    sample_time: float  # spacing of the grid, s
    channels: dict[str, np.ndarray]  # those recorded: (n,) float64, NaN where nothing was measured
    start_ns: int = 0  # absolute time of the first sample, ns since the epoch
    source: str = ""  # file that it was read from
    # Sentences about what was lost or repaired till here.
    losses: tuple[str, ...] = field(default=())

    def __post_init__(self):
        kept, said = {}, []
        for name, values in self.channels.items():
            kept[name], told = values, ()
            limit = LARGEST.get(name, np.finfo(float).max)
            if any_of((values,), lambda rows, limit=limit: np.abs(rows) > limit):
                kept[name], told = within_limits(name, values, self.time,
                                                 self.source or "recording")
            said += told
        if said:
            object.__setattr__(self, "channels", kept)
            object.__setattr__(self, "losses", (*self.losses, *said))

    def __len__(self) -> int:
        return len(next(iter(self.channels.values()))) if self.channels else 0

    @property
    def time(self) -> np.ndarray:
        """(n,) seconds since the first sample."""
        return np.arange(len(self)) * self.sample_time

    @property
    def duration(self) -> float:
        """Seconds from the first to behind the last sample."""
        return len(self) * self.sample_time

    @property
    def dated(self) -> bool:
        """Whether the stamps are calendar time."""
        return self.start_ns >= CALENDAR_NS

    def has(self, *names: str) -> bool:
        """Tell whether every named channel was recorded and holds a finite value."""
        return all(name in self.channels and any_of((self.channels[name],), np.isfinite)
                   for name in names)

    def get(self, name: str) -> np.ndarray:
        """Return a channel, or NaN throughout where it was not recorded; (n,)."""
        found = self.channels.get(name)
        return np.full(len(self), np.nan) if found is None else found

    def part(self, start: int, stop: int) -> "Recording":
        """Return samples ``start`` to ``stop`` as a recording of their own."""
        return replace(
            self, channels={name: values[start:stop] for name, values in self.channels.items()},
            start_ns=self.start_ns + round(start * self.sample_time * 1e9))


def sampled_rows(rows: int) -> np.ndarray:
    """Return numbers of the rows that :func:`sample_of` takes, and of the gaps in it, (n,)."""
    if rows <= columns.IN_MEMORY:
        return np.arange(rows)
    starts = np.linspace(0, rows - STRETCH, max(columns.IN_MEMORY // (STRETCH + 1), 1)).astype(int)
    return np.add.outer(starts, np.arange(STRETCH + 1)).ravel()  # the last one is the gap


def sample_of(recording: Recording) -> Recording:
    """Return stretches from all over a long recording, a missing row between two; or itself."""
    rows = len(recording)
    if rows <= columns.IN_MEMORY:
        return recording
    starts = sampled_rows(rows)[:: STRETCH + 1]
    channels = {}
    for name, values in recording.channels.items():
        channels[name] = np.concatenate([
            part for start in starts.tolist()
            for part in (values[start:start + STRETCH], [np.nan])])
        let_go(values)
    return replace(recording, channels=channels)


def rows_of(recording: Recording, start: int, stop: int) -> Recording:
    """Return rows of a recording, in memory."""
    part = {name: values[start:stop].copy() for name, values in recording.channels.items()}
    let_go(*recording.channels.values())
    return replace(recording, channels=part, losses=())


@dataclass(frozen=True)
class ChannelFinding:
    """One thing that the channels of a recording say about their configuration."""

    finding: str  # a sentence with its evidence in numbers
    kind: Kind
    channels: tuple[str, ...]  # the channels, or keys of the rig, that it concerns
    # Fragment of a config that mends it, by section; empty where no key does.
    correction: dict[str, Any] = field(default_factory=dict)


OVER = 0.04  # s over which the velocity is taken
STANDS = 0.05  # of the largest speed: slower is standing
LASTING = 0.03  # s: a shorter stand is a reversal
PRESSES = 2.0  # times the median force in motion: more than friction holds, so a stop does
NEAR = 0.1  # of the stroke: a stop gives way, and the force turns round there


def between_stops(x: np.ndarray, force: np.ndarray, dt: float) -> list[tuple[int, int]]:
    """Return the parts of a record that are away from every stop; all of it where none is.

    A piston that stands at an end of its way, under a force far beyond what moves it, is held by a
    stop.  What lies nearer to it than ``NEAR`` of the stroke is left out.

    Parameters
    ----------
    x, force : (n,) m and N, NaN where missing.
    dt : sample time, s.

    Returns
    -------
    (first, last) of each part; ``last`` is not in it.
    """
    measured = np.isfinite(x) & np.isfinite(force)
    reach, every = max(1, round(0.5 * OVER / dt)), np.arange(len(x))
    if len(x) < 4 * reach or not measured.any():
        return [(0, len(x))]
    x, force = (np.interp(every, every[measured], one[measured]) for one in (x, np.abs(force)))
    speed = np.pad(np.abs(x[2 * reach :] - x[: -2 * reach]), reach, mode="edge")
    top, near = np.quantile(speed, 0.998), NEAR * np.ptp(x)
    moves = np.median(force[speed >= 0.5 * top])
    held = (speed < STANDS * top) & ((x < x.min() + near) | (x > x.max() - near))
    places = [float(np.median(x[a:b])) for a, b in stretches(held)
              if (b - a) * dt >= LASTING and np.median(force[a:b]) > PRESSES * moves]
    if not places:
        return [(0, len(x))]
    away = np.all(np.abs(x[:, None] - np.array(places)) > near, axis=1)
    return list(map(tuple, stretches(away).tolist()))
