"""The one type that all offline work reads: aligned channels on a uniform time grid."""

from dataclasses import dataclass, field, replace

import numpy as np

from eha_monitor.recordings.columns import any_of
from eha_monitor.recordings.limits import LARGEST, within_limits
from eha_monitor.settings.channels import CHANNELS as CHANNELS

# Stamps before 2000 count from the start of a computer or of a simulation.
CALENDAR_NS = 946_684_800 * 10**9
SHORTEST_S = 0.5  # from less nothing is estimated, and nothing is explained


@dataclass(frozen=True)
class Recording:
    """Aligned channels of one recording, SI units, gaps as NaN.

    Every number in it lies where a sensor can show it (:mod:`limits`): whoever makes one of
    channels that run away gets an InputError, and what was left out stands in ``losses``.

    Attributes
    ----------
    sample_time : spacing of the grid, s.
    channels : name -> (n,) float64; NaN where nothing was measured.  A channel that was not
        recorded at all is absent.
    start_ns : absolute time of the first sample, ns since the epoch.
    source : file that it was read from.
    losses : sentences about everything that was lost or repaired on the way here.
    """

    sample_time: float
    channels: dict[str, np.ndarray]
    start_ns: int = 0
    source: str = ""
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
