"""A recording as the Python interface shows it: channels that cannot be written, as a table."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eha_monitor.api.common import ReadOnly, Record, calling, chosen, read_only
from eha_monitor.api.config import Config, path_of
from eha_monitor.errors import InputError
from eha_monitor.quantity import number, quantity
from eha_monitor.recordings.columns import blocks
from eha_monitor.recordings.recording import CHANNELS
from eha_monitor.recordings.recording import Recording as Inner
from eha_monitor.settings.channels import CHANNEL_UNITS

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

UNITS = ReadOnly(CHANNEL_UNITS)
UNEVEN = 1e-3  # of a step: by which the steps of a table may differ


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Recording(Record, Inner):
    """Channels of one recording on one time grid, SI; gaps are NaN.

    :func:`read` and :func:`simulate` return one; one of your own arrays is
    ``em.Recording({"x": x, "x_d": x_d}, sample_time=1e-3)``.  Arrays are copied, and what a
    recording shows cannot be written: ``dataclasses.replace(recording, channels={...})`` makes
    another one.

    Parameters
    ----------
    channels : mapping of str to array_like
        Channel -> (n,) values: x and x_d (piston, demanded; m), v (m/s), omega and omega_d
        (pump; rad/s), p1 and p2 (chambers; Pa, absolute), force (N), temperature (°C).
    sample_time : float
        Spacing of the rows, s.
    start_ns : int
        Time of the first row, ns since 1970; 0 where it is not known.
    source : str
        Where it is from: the path, or a name for errors and reports.
    losses : tuple of str
        Sentences about what was lost or repaired on the way here.
    config : Config or None
        What it was read or simulated with; the functions take it where they are given no other.

    Attributes
    ----------
    duration : float
        Seconds from the first to behind the last row.
    time : (n,) array
        Seconds since the first row.

    Raises
    ------
    InputError
        If a channel has no such name, is no column of numbers, is longer than another one, or
        runs away.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 4.0, 1e-3)
    >>> own = em.Recording({"x": 0.01 * np.sin(t)}, sample_time=1e-3, source="bench")
    >>> own.duration, own.channels["x"][1000].round(5)
    (4.0, np.float64(0.00841))
    """

    config: Config | None = None
    kind: str = field(init=False, default="")  # "bag", "table"; "" of arrays
    # What the filters read: compiled code takes arrays that can be written.
    inner: Inner = field(init=False)

    def __init__(self, channels: Mapping[str, np.ndarray], sample_time: float, start_ns: int = 0,
                 source: str = "", losses: tuple[str, ...] = (), config: Config | None = None):
        said = source or "recording"
        if not isinstance(channels, Mapping) or not channels:
            raise InputError(f"{said}: channels: expected a mapping of channel to array, such "
                             f"as {{'x': x}}, got {type(channels).__name__}")
        columns = {name: _column(said, name, values) for name, values in channels.items()}
        lengths = {name: len(values) for name, values in columns.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"{said}: channels differ in length: " + ", ".join(
                f"{name} {length}" for name, length in lengths.items()))
        try:
            step = float(sample_time)
        except (TypeError, ValueError):
            step = np.nan
        if not 0.0 < step < np.inf:
            raise InputError(f"{said}: sample_time: expected seconds, more than 0, got "
                             f"{sample_time!r}")
        if config is not None and not isinstance(config, Config):
            raise InputError(f"{said}: config: expected an em.Config or None, got "
                             f"{type(config).__name__}")
        self._set(Inner(step, columns, int(start_ns), str(source), tuple(losses)), config, "")

    def _set(self, inner: Inner, config: Config | None, kind: str) -> "Recording":
        for name, value in {**vars(read_only(inner)), "inner": inner, "config": config,
                            "kind": kind}.items():
            object.__setattr__(self, name, value)
        return self

    def __reduce__(self):
        return type(self).of, (self.inner, self.config, self.kind)

    @classmethod
    def of(cls, inner: Inner, config: Config | None = None, kind: str = "") -> "Recording":
        """Return an inner recording as it is; for the functions of this room."""
        return cls.__new__(cls)._set(inner, config, kind)

    @classmethod
    def from_frame(cls, frame: "pandas.DataFrame", sample_time: float | None = None, *,
                   source: str = "") -> "Recording":
        """Return a recording of a table, such as :meth:`to_frame` gives.

        Parameters
        ----------
        frame : pandas.DataFrame
            Columns are channels, SI.
        sample_time : float, optional
            Spacing of the rows, s; without it the index is the time in s, evenly spaced.
        source : str
            A name for errors and reports.

        Returns
        -------
        Recording
            The columns; rows follow one another on one grid.

        Raises
        ------
        InputError
            If the index is no even time, or a column is no channel.

        Examples
        --------
        >>> em.Recording.from_frame(r.to_frame()).duration == r.duration
        True
        """
        if not hasattr(frame, "columns") or not hasattr(frame, "index"):
            raise InputError("from_frame: expected a pandas.DataFrame, got "
                             f"{type(frame).__name__}")
        if sample_time is None:
            sample_time = _step_of(frame.index, source or "table")
        return cls({str(name): frame[name] for name in frame.columns}, sample_time, source=source)

    def between(self, start: float, stop: float) -> "Recording":
        """Return a part of it as a recording of its own.

        Parameters
        ----------
        start, stop : float
            Seconds since the first row.

        Returns
        -------
        Recording
            The rows from ``start`` to before ``stop``.

        Raises
        ------
        InputError
            If no row lies there.

        Examples
        --------
        >>> r.between(2.0, 5.0).duration
        3.0
        """
        try:
            first, last = (round(float(np.clip(float(at), 0.0, self.duration)) / self.sample_time)
                           for at in (start, stop))
        except (TypeError, ValueError):  # NaN as well
            first = last = 0
        if not first < last:
            raise InputError(f"{self.source or 'recording'}: between {start!r} and {stop!r}: "
                             f"expected two times in s, from 0 to {self.duration:g}")
        return self.of(self.inner.part(first, last), self.config, self.kind)

    def to_dict(self) -> dict[str, Any]:
        """Return what it is, as JSON's plain types; the rows are in :meth:`to_frame`.

        Returns
        -------
        dict
            source, sample_time, duration_s, samples, start_ns, channels with their finite
            samples, unit, least and largest value, losses.
        """
        return {"source": self.source, "sample_time": self.sample_time,
                "duration_s": self.duration, "samples": len(self), "start_ns": self.start_ns,
                "channels": {name: {"unit": UNITS.get(name, "")} | _facts(values)
                             for name, values in self.inner.channels.items()},
                "losses": list(self.losses)}

    def to_frame(self) -> "pandas.DataFrame":
        """Return the rows.

        Returns
        -------
        pandas.DataFrame
            Index ``time_s``, s since the first row; a column for each channel, SI.

        Examples
        --------
        >>> list(r.to_frame().columns)
        ['x', 'x_d', 'omega', 'p1', 'p2']
        """
        import pandas

        return pandas.DataFrame({name: np.array(values) for name, values
                                 in self.inner.channels.items()},
                                index=pandas.Index(self.inner.time, name="time_s"))

    def plot(self, *channels: str) -> "Figure":
        """Draw channels against time, those of one quantity together.

        Parameters
        ----------
        *channels : str
            Which ones; all of them without a name.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("channels.png")`` keeps it.

        Raises
        ------
        InputError
            If there is no such channel.
        """
        from eha_monitor.reports.api_figures import recording_drawing

        for name in channels:
            chosen(name, dict.fromkeys(self.channels, len), "plot")
        return recording_drawing(self.inner, channels or tuple(self.channels), UNITS)

    def write(self, path: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """Write it as a rosbag2 mcap bag, with the topics of docs/topics.md.

        Parameters
        ----------
        path : str or path
            Folder of the new bag, or a single .mcap file.
        overwrite : bool
            Replace a bag that is there already.

        Returns
        -------
        Path
            The bag.

        Raises
        ------
        InputError
            If it is there already, or cannot be written.
        """
        from eha_monitor.recordings.write import write_recording

        with calling():
            return write_recording(path_of(path, "a bag to write"), self.inner,
                                   (self.config or Config()).settings, overwrite=overwrite)

    def _short(self):
        facts = self.to_dict()["channels"]
        rows = [[name, str(one["samples"]), *(quantity(one[key], one["unit"])
                                              for key in ("least", "largest"))]
                for name, one in facts.items()]
        return (self.source or "recording",
                f"{number(self.duration)} s, {len(self)} samples at "
                f"{number(1.0 / self.sample_time)} Hz",
                ("channel", "samples", "least", "largest"), rows,
                tuple(f"lost: {loss}" for loss in self.losses))


def _column(source: str, name: Any, values: Any) -> np.ndarray:
    """Return a channel as a column of its own."""
    if name not in CHANNELS:
        raise InputError(f"{source}: channel {name!r}: expected one of {', '.join(CHANNELS)}")
    try:
        column = np.array(values, dtype=float)
    except (TypeError, ValueError) as problem:
        raise InputError(f"{source}: channel {name}: expected numbers in {UNITS[name]}: "
                         f"{problem}") from problem
    if column.ndim != 1 or not len(column):
        raise InputError(f"{source}: channel {name}: expected a column of numbers (n,), got shape "
                         f"{column.shape}")
    return column


def _step_of(index: "pandas.Index", source: str) -> float:
    """Return the spacing of an index in s."""
    time = np.asarray(index)
    if time.dtype.kind == "M" or time.dtype.kind == "m":
        time = (time - time[0]) / np.timedelta64(1, "s")
    try:
        steps = np.diff(time.astype(float))
    except (TypeError, ValueError):
        steps = np.empty(0)
    usual = float(np.median(steps)) if len(steps) else np.nan
    if not usual > 0.0 or np.abs(steps - usual).max() > UNEVEN * usual:
        raise InputError(f"{source}: expected an index of evenly spaced times in s, or "
                         "sample_time; em.read of a file puts rows on a grid")
    # The mean is finer than a single difference; what is left is rounding.
    return float(f"{(float(time[-1]) - float(time[0])) / len(steps):.12g}")


def _facts(values: np.ndarray) -> dict[str, Any]:
    """Return how many finite samples a channel has, and between what they lie."""
    count, least, largest = 0, np.inf, -np.inf
    for _, _, (rows,) in blocks(values):
        good = rows[np.isfinite(rows)]
        if len(good):
            count += len(good)
            least, largest = min(least, float(good.min())), max(largest, float(good.max()))
    return {"samples": count, "least": least if count else None,
            "largest": largest if count else None}
