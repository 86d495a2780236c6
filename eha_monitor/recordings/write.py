"""Channels to rosbag2 mcap bags with the topics of the interface contract, piece by piece."""

from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.recordings.bag_writer import BagWriter, TopicType, check_bag_target
from eha_monitor.recordings.columns import any_of, let_go
from eha_monitor.recordings.limits import within_limits
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.serialise import messages_of
from eha_monitor.settings.monitor import Settings

ROWS = 4096  # written at a time
__all__ = ["BagWriter", "ChannelWriter", "TopicType", "check_bag_target", "write_recording"]


class ChannelWriter:
    """Writes rows of channels to a new bag; a context manager.

    Header stamps and log times are ``start_ns`` plus the grid; a row in which a topic has no
    finite value is left out.

    Parameters
    ----------
    path, compression, overwrite : see :class:`bag_writer.BagWriter`.
    channels : those that are going to be written.
    sample_time : s.
    namespace : of the topics.
    limited : what no sensor could show is refused; a :class:`Recording` refused it when it was
        made.
    """

    def __init__(self, path: str | Path, channels: tuple[str, ...], sample_time: float,
                 namespace: str, *, compression: str = "zstd", overwrite: bool = False,
                 start_ns: int = 0, limited: bool = True):
        self.channels, self.sample_time, self.namespace = channels, sample_time, namespace
        self._limited = limited
        self.start_ns, self.rows = start_ns, 0
        none = messages_of({name: np.empty(0) for name in channels}, np.empty(0, np.int64),
                           namespace)
        if not none:
            raise InputError(f"{path}: nothing to write, no channel has a finite value")
        self._path = path
        self._bag = BagWriter(path, {one.topic: one.msgtype for one in none},
                              compression=compression, overwrite=overwrite)

    def write(self, channels: dict[str, np.ndarray]) -> None:
        """Append rows; channel -> (m,) SI values.

        Raises
        ------
        InputError
            If a channel runs away; nothing is left of the bag then.
        """
        rows = len(next(iter(channels.values())))
        time = np.arange(self.rows, self.rows + rows) * self.sample_time
        if self._limited:
            channels = {name: within_limits(name, channels[name], time, str(self._path))[0]
                        for name in self.channels}
        for first in range(0, rows, ROWS):
            part = {name: channels[name][first:first + ROWS] for name in self.channels}
            count = min(ROWS, rows - first)
            stamps = self.start_ns + np.round(
                np.arange(self.rows, self.rows + count) * self.sample_time * 1e9).astype(np.int64)
            if stamps[0] < 0 or stamps[-1] >= 2**31 * 1_000_000_000:
                raise InputError(f"{self._path}: stamps from {stamps[0]} to {stamps[-1]} ns do "
                                 "not fit a header")
            self._bag.write_many({one.topic: (one.stamps, one.data) for one in messages_of(
                part, stamps, self.namespace)})
            self.rows += count

    def __enter__(self) -> "ChannelWriter":
        return self

    def __exit__(self, kind, value, traceback) -> None:
        if kind is not None and issubclass(kind, InputError):
            self._bag.discard()
        else:
            self._bag.__exit__(kind, value, traceback)


def write_recording(path: str | Path, recording: Recording | dict[str, np.ndarray],
                    settings: Settings, *, compression: str = "zstd", overwrite: bool = False,
                    start_ns: int | None = None) -> Path:
    """Write a recording as a bag.

    Parameters
    ----------
    path : see :class:`bag_writer.BagWriter`.
    recording : a recording, or channel -> (n,) SI values on the config's sample time.
    settings : ``monitor.namespace``, and ``rig.sample_time`` where arrays are given.
    start_ns : time of the first sample; by default the recording's own.

    Raises
    ------
    InputError
        If the target exists or cannot be written, or there is nothing to write.
    """
    if isinstance(recording, dict):
        lengths = {len(values) for values in recording.values()}
        if len(lengths) > 1:
            raise InputError(f"{path}: channels differ in length: {sorted(lengths)}")
        recording = Recording(settings.rig.sample_time, recording)
    if len(recording) == 0:
        raise InputError(f"{path}: nothing to write, the recording has no samples")
    start = recording.start_ns if start_ns is None else start_ns
    last = start + round((len(recording) - 1) * recording.sample_time * 1e9)
    if start < 0 or last >= 2**31 * 1_000_000_000:
        raise InputError(f"{path}: stamps from {start} to {last} ns do not fit a header")
    names = tuple(name for name, values in recording.channels.items()
                  if any_of((values,), np.isfinite))
    with ChannelWriter(path, names, recording.sample_time, settings.monitor.namespace,
                       compression=compression, overwrite=overwrite, start_ns=start,
                       limited=False) as writer:
        for first in range(0, len(recording), ROWS):
            writer.write({name: recording.channels[name][first:first + ROWS] for name in names})
            let_go(*recording.channels.values())
    return Path(path)
