"""Bags to recordings: which topic is which channel, and what was lost.

Where stamps are what a sampled system writes (on an even grid, to within what counts as exact),
channels are put onto their grid while the bag is read, so that the messages need not be kept.
Anything else (jitter, a clock that drifts or jumps, late messages) asks for the stamps of the
whole recording at once, and :mod:`align` has them.  What both take they read alike.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.recordings import align as whole
from eha_monitor.recordings import cdr
from eha_monitor.recordings.align import align
from eha_monitor.recordings.bag import Bag
from eha_monitor.recordings.cdr import Series, TopicReader, Want, types_of
from eha_monitor.recordings.columns import PIECE, Column
from eha_monitor.recordings.grid import JITTER, Grid, fit_grid, repair, simple_step
from eha_monitor.recordings.recording import CHANNELS, LARGEST, Recording
from eha_monitor.settings.channels import DEFAULT_CHANNELS, Channel
from eha_monitor.settings.monitor import Settings

FEWEST = 1000  # samples of the reference from which its grid is told
OUTLIERS = 0.001  # share of the stamps that may lie off, as in grid.fit_grid
SLOWER = 3.0  # times: a channel so slow is kept as it came, and interpolated at the end
LONGEST_GAP_S = 3600.0  # a longer one is for the whole recording to judge

# channel -> (who reads its topic, what of it)
Sources = dict[str, tuple[TopicReader, Want]]


class NotEvenError(Exception):
    """The stamps are not on an even grid: the recording is aligned as a whole."""


@dataclass
class _Lane:
    """One channel on its way: its column, and what has been counted."""

    column: Column
    count: int = 0
    missing: int = 0
    off: int = 0


class Stream:
    """Takes what the topics' readers have collected, batch by batch.

    Raises NotEvenError, by any method, once the stamps turn out not to be on an even grid.

    Parameters
    ----------
    settings : channel map and sample time.
    sources : tells which topic each channel is read from, as far as topics have come.
    """

    def __init__(self, settings: Settings, sources: Callable[[], Sources]):
        self.settings, self.sources = settings, sources
        self.grid: Grid | None = None
        self.begun: Sources = {}
        self.lanes: dict[str, _Lane] = {}
        self.slow: Sources = {}
        self.last: dict[tuple[TopicReader, Want], int] = {}
        self.origin = self.end = 0

    def take(self) -> None:
        """Put what has come on the grid and forget the messages."""
        fast: dict[TopicReader, list[str]] = {}
        for name in self.lanes:
            fast.setdefault(self.begun[name][0], []).append(name)
        for reader, names in fast.items():
            wants = tuple(dict.fromkeys(self.begun[name][1] for name in names))
            for stamps, columns in self._drained(reader, wants):
                self._place(stamps, columns, [
                    name for name in names if self.begun[name][1] in columns])

    def begin(self) -> None:
        """Find the grid on the first batch, and which channels keep to it."""
        found = self.sources()
        if "x" not in found or found["x"][0].count < FEWEST:
            raise NotEvenError
        series = {}
        for name, (reader, want) in found.items():
            one = reader.series(want)
            if one is None:
                raise NotEvenError  # none of it yet: whether it is a channel shows later
            series[name] = one.in_si(self.settings.channels[name])
        leader = series["x"]
        self._check(leader)
        self.origin = int(leader.stamp_ns[0])
        nominal = self.settings.rig.sample_time
        grid = fit_grid((leader.stamp_ns - self.origin) * 1e-9, leader.values, nominal)
        if grid.mode != "exact" or grid.step != simple_step(grid.step, nominal):
            raise NotEvenError
        for name, one in series.items():
            t = (one.stamp_ns - self.origin) * 1e-9
            own = fit_grid(t, one.values, grid.step) if len(t) > 1 else None
            if own is not None and own.mode == "exact" and abs(own.step / grid.step - 1) < 0.1:
                self._check(one)
                self.lanes[name] = _Lane(Column())
            elif own is None or own.step > SLOWER * grid.step:
                self.slow[name] = found[name]
            else:
                raise NotEvenError
        self.grid, self.begun = grid, found

    @staticmethod
    def _check(series: Series) -> None:
        if not series.stamped or (np.diff(series.stamp_ns) <= 0).any():
            raise NotEvenError

    def _place(self, stamps: np.ndarray, columns: dict[Want, np.ndarray], names: list[str]
               ) -> None:
        """Put channels that share their stamps on the grid."""
        for name in names:
            channel, lane = self.settings.channels[name], self.lanes[name]
            t = (stamps - round(channel.delay * 1e9) - self.origin) * 1e-9
            place = (t - self.grid.start) / self.grid.step
            index = np.round(place)
            lane.off += int(np.count_nonzero(np.abs(place - index) > JITTER))
            lane.count += len(t)
            # Where fit_grid would have looked again: off the grid, or two on one place.
            if (lane.off > OUTLIERS * lane.count or (np.diff(index) <= 0).any()):
                raise NotEvenError
            values = channel.in_si(columns[self.begun[name][1]])
            missing = int(np.count_nonzero(np.isnan(values)))
            if np.count_nonzero(np.abs(values) <= LARGEST[name]) + missing < len(values):
                raise NotEvenError  # no measurement: how many there are in all decides
            lane.missing += missing
            if name == "x":
                self.end = int(index[-1]) + 1
            self._append(lane.column, index.astype(np.int64), values)

    def _drained(self, reader: TopicReader, wants: tuple[Want, ...]
                 ) -> list[tuple[np.ndarray, dict[Want, np.ndarray]]]:
        """Return the stamps and columns that a reader has collected, if any, and empty it."""
        taken = reader.take(wants)
        if taken is None:
            raise NotEvenError
        taken = [group for group in taken if len(group[0])]
        for stamps, columns in taken:
            before = max(self.last.get((reader, want), int(stamps[0]) - 1) for want in columns)
            steps = np.diff(stamps, prepend=before)
            if (steps <= 0).any() or steps.max() > LONGEST_GAP_S * 1e9:
                raise NotEvenError
            self.last |= {(reader, want): int(stamps[-1]) for want in columns}
        return taken

    @staticmethod
    def _append(column: Column, index: np.ndarray, values: np.ndarray) -> None:
        """Add rows at rising places; those between stay NaN."""
        ahead = index >= column.rows
        if not ahead.all():
            if index[np.argmax(ahead)] > 0 and column.rows and not ahead[0]:
                raise NotEvenError  # it comes at a place that is taken
            index, values = index[ahead], values[ahead]
        if not len(index):
            return
        first, rows = column.rows, int(index[-1]) + 1
        if rows - first == len(index):
            column.append(values)
            return
        column.fill(int(index[0]))
        rest = np.full(rows - int(index[0]), np.nan)
        rest[index - int(index[0])] = values
        column.append(rest)

    def finish(self, source: str, losses: list[str], found: Sources) -> Recording:
        """Return the recording.

        Parameters
        ----------
        losses : sentences to begin with.
        found : the channels of the whole bag.
        """
        self.take()
        if any(found.get(name) != self.begun[name] for name in self.lanes):
            raise NotEvenError
        said, grid, points = list(losses), self.grid, self.end
        slow = {}
        for name, (reader, want) in found.items():
            lane = self.lanes.get(name)
            if lane is None and (series := reader.series(want)) is not None:
                slow[name] = whole.within_range(series.in_si(self.settings.channels[name]), name,
                                                reader.topic, source, said)
            elif lane is not None and lane.missing:
                said.append(f"{name}: {lane.missing} of {lane.count} values are NaN")
        whole.tell_grid(grid, found["x"][0].topic, self.settings.rig.sample_time, said)
        columns = {}
        for name, lane in self.lanes.items():
            lane.column.fill(points)
            if lane.missing < lane.count:
                columns[name] = lane.column.values(points)
        for name, series in slow.items():
            values = self._interpolated(series, found[name][0].topic, points, name, said)
            if values is not None:
                columns[name] = values
        columns = {name: columns[name] for name in CHANNELS if name in columns}
        return whole.recording_of(columns, grid, self.origin, source, said)

    def _interpolated(self, series: Series, label: str, points: int, name: str,
                      said: list[str]) -> np.ndarray | None:
        """Put a channel that came slowly, or late, on the grid; (n,), None where it has none."""
        keep, jumped = repair(series.stamp_ns, label, said)
        t = (series.stamp_ns[keep] - self.origin) * 1e-9
        if jumped or t[0] > points * self.grid.step or t[-1] < 0:
            raise NotEvenError
        own = fit_grid(t, series.values[keep], self.grid.step)
        if own.mode != "exact":
            whole.tell_grid(own, label, own.step, said)
        whole.tell_rate(name, (keep, t, own), self.grid, said)
        column = Column()
        place = whole.placing(series.values, (keep, t, own), self.grid)
        found = False
        for start in range(0, points, PIECE):
            rows = place(start, min(start + PIECE, points))
            found = found or bool(np.isfinite(rows).any())
            column.append(rows)
        return column.values() if found else None


BATCH_BYTES = 8_000_000  # small chunks are joined, so that the work for each is paid once


def read_recording(path: str | Path, settings: Settings) -> Recording:
    """Read a rosbag2 mcap bag through the channel map of the config.

    Raises InputError if there is no bag, or none of its messages gives a channel.

    Parameters
    ----------
    path : folder with metadata.yaml and .mcap files, or one .mcap file; whole or cut off.
    settings : ``channels``, ``monitor.namespace`` and ``rig.sample_time`` are read.
    """
    try:
        return _read(path, settings, streamed=True)
    except NotEvenError:
        return _read(path, settings, streamed=False)


def _read(path: str | Path, settings: Settings, streamed: bool) -> Recording:
    """Read a bag; ``streamed``: put a long one on its grid as it comes."""
    bag = Bag(path)
    collector = Collector(settings, streamed)
    for file, block in bag.blocks():
        collector.take(file, block)
    collector.flush(last=True)
    losses = bag.damage()
    collector.declared = {one.topic for file in bag.files for one in file.channels.values()}
    found = collector.sources(str(path), losses)
    if collector.stream is not None:
        recording = collector.stream.finish(str(path), losses, found)
    else:
        recording = align(collector.channels(found), settings, source=str(path), losses=losses)
    if any(file.truncated_at is not None for file in bag.files):
        recording = replace(recording, losses=tuple(
            f"{loss}: {recording.duration:.3f} s recovered" if "truncated at byte" in loss
            else loss for loss in recording.losses))
    return recording


def _want(channel: Channel) -> Want:
    return Want(channel.field or "data", channel.name)


class Collector:
    """Sorts the messages of a bag into the topics that channels may come from."""

    def __init__(self, settings: Settings, streamed: bool = False):
        self.settings, self.stream, self.may_stream = settings, None, streamed
        self.namespace = "/" + settings.monitor.namespace.strip("/")
        self.readers: dict[str, TopicReader] = {}
        self.unfit: dict[str, str] = {}  # topic -> why no channel can be read from it
        self.notes: list[str] = []
        self.known: dict[tuple, TopicReader | None] = {}
        self.topics_seen: dict[str, str] = {}
        self.declared: set[str] = set()  # topics of the bag, some without a message
        self.pending: list[tuple] = []
        self.pending_bytes = 0

    def take(self, file, block) -> None:
        """Keep the messages of wanted topics, to be decoded by the batch."""
        wanted = []
        for channel_id in np.flatnonzero(np.bincount(block.ids, minlength=1)).tolist():
            reader = self._reader(file, channel_id)
            if reader is not None:
                wanted.append((channel_id, reader))
        if wanted:
            self.pending.append((block, wanted))
            self.pending_bytes += int(np.sum(block.lengths))
        if self.pending_bytes > BATCH_BYTES or len(self.pending) > 4096:
            self.flush()

    def flush(self, last: bool = False) -> None:
        """Decode what is pending: all of one topic's messages of several chunks at once.

        Where it is not the last the bag is long, and is put on its grid as it comes.
        """
        self._decode()
        if last:
            return
        if self.stream is None and self.may_stream:
            stream = Stream(self.settings, lambda: self.sources("", []))
            try:
                stream.begin()
                self.stream = stream
            except (NotEvenError, InputError):
                self.may_stream = False  # nothing is lost: the readers keep all
        if self.stream is not None:
            self.stream.take()

    def _decode(self) -> None:
        if not self.pending:
            return
        if len(self.pending) == 1:
            data, start = self.pending[0][0].data, [0]
        else:
            pieces = [block.data for block, _ in self.pending]
            if all(piece is pieces[0] for piece in pieces):  # batches of one unchunked file
                data, start = pieces[0], [0] * len(pieces)
            else:
                data = np.concatenate(pieces)
                data.flags.writeable = False  # as a chunk is: the reader is compiled for one
                start = np.cumsum([0] + [len(piece) for piece in pieces]).tolist()
        parts: dict[str, list] = {}
        for (block, wanted), shift in zip(self.pending, start, strict=False):
            for channel_id, reader in wanted:
                mask = block.ids == channel_id
                parts.setdefault(reader.topic, []).append(
                    (block.times[mask], block.begins[mask] + shift, block.lengths[mask]))
        for topic, pieces in parts.items():
            columns = [np.concatenate(column) for column in zip(*pieces, strict=True)]
            self.readers[topic].add(data, *columns)
        self.pending, self.pending_bytes = [], 0

    def _reader(self, file, channel_id: int) -> TopicReader | None:
        """Return who collects a channel of the file, or None if nobody wants it."""
        channel = file.channels.get(channel_id)
        if channel is None:
            return None
        schema = file.schemas.get(channel.schema_id)
        msgtype = schema.name if schema else "unknown"
        key = (channel.topic, msgtype)
        if key not in self.known:
            self.topics_seen[channel.topic] = msgtype
            wants = self._wants(channel.topic)
            self.known[key] = self._new_reader(channel.topic, msgtype, schema, wants)
        return self.known[key]

    def _new_reader(self, topic, msgtype, schema, wants) -> TopicReader | None:
        if not wants:
            return None
        if topic in self.readers:
            self.notes.append(f"{topic}: messages of a second type {msgtype} are left out")
            return None
        try:
            types = types_of(msgtype, schema.encoding if schema else "",
                             schema.data if schema else b"")
        except ValueError as problem:
            self.unfit[topic] = f"{topic}: {problem}"
            return None
        good = []
        for want in dict.fromkeys(wants):
            problem = cdr.missing_field(types, msgtype, want)
            if problem is None and want.name and not cdr.has_names(types, msgtype):
                problem = f"expected a type with joint names for '{want.name}'"
            if problem is None:
                good.append(want)
            else:
                self.unfit[topic] = f"{topic}: type is {msgtype}: {problem}"
        if not good:
            return None
        reader = TopicReader(topic, msgtype, types, tuple(good))
        self.readers[topic] = reader
        return reader

    def _wants(self, topic: str) -> list[Want]:
        return [_want(channel) for channel in self.settings.channels.values()
                if self._matches(channel, topic)]

    def _matches(self, channel: Channel, topic: str) -> bool:
        if channel.topic.startswith("/"):
            return topic == channel.topic
        return bool(channel.topic) and (topic == channel.topic
                                        or topic.endswith("/" + channel.topic))

    def _exact(self, channel: Channel) -> str:
        return (channel.topic if channel.topic.startswith("/")
                else f"{self.namespace.rstrip('/')}/{channel.topic}")

    def sources(self, source: str, losses: list[str]) -> Sources:
        """Return channel -> who reads its topic, and what of it; sentences go to ``losses``."""
        losses.extend(self.notes)
        found: Sources = {}
        unfit: list[str] = []
        absent: list[str] = []  # of topics that the config itself names
        for name, channel in self.settings.channels.items():
            topic = self._topic(source, name, channel)
            if topic is None:
                default = DEFAULT_CHANNELS.get(name)
                if channel.topic and not losses and (
                        default is None or channel.topic != default.topic) and not any(
                        self._matches(channel, one) for one in self.declared):
                    absent.append(f"channels.{name}: the bag has no topic {self._exact(channel)}")
                continue
            want = _want(channel)
            reader = self.readers.get(topic)
            if reader is None or want not in reader.wants:
                if topic in self.unfit and self.unfit[topic] not in unfit:
                    unfit.append(self.unfit[topic])
                continue
            on_grid = self.stream is not None and name in self.stream.lanes
            if on_grid or reader.series(want) is not None:
                found[name] = (reader, want)
        for reader in self.readers.values():
            if reader.unreadable:
                losses.append(f"{reader.topic}: {reader.unreadable} of {reader.count} messages "
                              f"could not be decoded as {reader.msgtype}")
        if not found:
            raise InputError(self._nothing(source, unfit, losses))
        if absent:
            raise InputError(f"{source}: {'; '.join(absent)}, it has {self._seen()}")
        losses.extend(unfit)
        return found

    def channels(self, found: Sources) -> dict[str, tuple[Series, str]]:
        """Return channel -> series in SI and its topic."""
        return {name: (reader.series(want).in_si(self.settings.channels[name]), reader.topic)
                for name, (reader, want) in found.items()}

    def _topic(self, source: str, name: str, channel: Channel) -> str | None:
        exact = self._exact(channel)
        if exact in self.topics_seen:
            return exact
        close = [topic for topic in self.topics_seen if self._matches(channel, topic)]
        # The monitor's own bags hold what it publishes beside what it takes.
        close = [topic for topic in close if "/monitor/" not in topic] or close
        if len(close) > 1:
            raise InputError(
                f"{source}: channels.{name}: topic '{channel.topic}' could be "
                f"{' or '.join(sorted(close))}, set monitor.namespace or the full name")
        return close[0] if close else None

    def _nothing(self, source: str, unfit: list[str], losses: list[str]) -> str:
        if unfit:
            return f"{source}: no channel can be read: {unfit[0]}"
        wanted = sorted({self._exact(c) for c in self.settings.channels.values() if c.topic})
        seen = sorted(self.topics_seen)
        if not seen:
            lost = f" ({losses[0]})" if losses else ""
            return f"{source}: the bag holds no message{lost}, expected {', '.join(wanted)}"
        if self.readers:
            reader = next(iter(self.readers.values()))
            where = f"{source}: {reader.topic}"
            if reader.count == reader.unreadable:
                return f"{where}: no message could be decoded as {reader.msgtype}"
            wants = ", ".join(f"{w.name}.{w.field}" if w.name else w.field for w in reader.wants)
            return f"{where}: no finite value in any message, expected {wants}"
        return (f"{source}: expected one of the topics {', '.join(wanted)}; the bag has "
                f"{self._seen()}")

    def _seen(self) -> str:
        """Return the topics of the bag, the first of many."""
        seen = sorted(self.topics_seen)
        more = f" and {len(seen) - 6} more" if len(seen) > 6 else ""
        return f"{', '.join(seen[:6])}{more}"
