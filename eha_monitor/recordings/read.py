"""Bags to recordings: which topic is which channel, and what was lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from eha_monitor.errors import InputError
from eha_monitor.recordings import cdr
from eha_monitor.recordings.align import align
from eha_monitor.recordings.bag import Bag
from eha_monitor.recordings.cdr import Series, TopicReader, Want, types_of
from eha_monitor.recordings.recording import Recording
from eha_monitor.recordings.stream import NotEvenError, Sources, Stream
from eha_monitor.settings.channels import Channel
from eha_monitor.settings.monitor import Settings

BATCH_BYTES = 8_000_000  # small chunks are joined, so that the work for each is paid once


def read_recording(path: str | Path, settings: Settings, streamed: bool = True) -> Recording:
    """Read a rosbag2 mcap bag through the channel map of the config.

    Parameters
    ----------
    path : folder with metadata.yaml and .mcap files, or one .mcap file; whole or cut off.
    settings : ``channels``, ``monitor.namespace`` and ``rig.sample_time`` are read.
    streamed : whether a long bag is put on its grid as it comes, where its stamps are even.

    Raises
    ------
    InputError
        If there is no bag, or none of its messages gives a channel.
    """
    try:
        return _read(path, settings, streamed)
    except NotEvenError:
        return _read(path, settings, streamed=False)


def _read(path: str | Path, settings: Settings, streamed: bool) -> Recording:
    bag = Bag(path)
    collector = Collector(settings, streamed)
    for file, block in bag.blocks():
        collector.take(file, block)
    collector.flush(last=True)
    losses = bag.damage()
    found = collector.sources(str(path), losses)
    if collector.stream is not None:
        recording = collector.stream.finish(str(path), losses, found)
    else:
        recording = align(collector.channels(str(path), losses, found), settings,
                          source=str(path), losses=losses)
    if any(file.truncated_at is not None for file in bag.files):
        recording = replace(recording, losses=tuple(
            f"{loss}: {recording.duration:.3f} s recovered" if "truncated at byte" in loss
            else loss for loss in recording.losses))
    return recording


class Collector:
    """Sorts the messages of a bag into the topics that channels may come from."""

    def __init__(self, settings: Settings, streamed: bool = False):
        self.settings, self.stream, self.may_stream = settings, None, streamed
        self.channels_wanted = settings.channels
        self.namespace = "/" + settings.monitor.namespace.strip("/")
        self.readers: dict[str, TopicReader] = {}
        self.unfit: dict[str, str] = {}  # topic -> why no channel can be read from it
        self.notes: list[str] = []
        self.known: dict[tuple, TopicReader | None] = {}
        self.topics_seen: dict[str, str] = {}
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
        return [Want(channel.field or "data", channel.name)
                for channel in self.channels_wanted.values() if self._matches(channel, topic)]

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
        for name, channel in self.channels_wanted.items():
            topic = self._topic(source, name, channel)
            if topic is None:
                continue
            want = Want(channel.field or "data", channel.name)
            reader = self.readers.get(topic)
            if reader is None or want not in reader.wants:
                if topic in self.unfit and self.unfit[topic] not in unfit:
                    unfit.append(self.unfit[topic])
                continue
            if self._on_grid(name) or reader.series(want) is not None:
                found[name] = (reader, want)
        for reader in self.readers.values():
            if reader.unreadable:
                losses.append(f"{reader.topic}: {reader.unreadable} of {reader.count} messages "
                              f"could not be decoded as {reader.msgtype}")
        if not found:
            raise InputError(self._nothing(source, unfit, losses))
        losses.extend(unfit)
        return found

    def _on_grid(self, name: str) -> bool:
        return self.stream is not None and name in self.stream.lanes

    def channels(self, source: str, losses: list[str], found: Sources
                 ) -> dict[str, tuple[Series, str]]:
        """Return channel -> series in SI and its topic."""
        return {name: (reader.series(want).in_si(self.channels_wanted[name]), reader.topic)
                for name, (reader, want) in found.items()}

    def _topic(self, source: str, name: str, channel: Channel) -> str | None:
        exact = self._exact(channel)
        if exact in self.topics_seen:
            return exact
        close = [topic for topic in self.topics_seen if self._matches(channel, topic)]
        if len(close) > 1:
            raise InputError(
                f"{source}: channels.{name}: topic '{channel.topic}' could be "
                f"{' or '.join(sorted(close))}, set monitor.namespace or the full name")
        return close[0] if close else None

    def _nothing(self, source: str, unfit: list[str], losses: list[str]) -> str:
        if unfit:
            return f"{source}: no channel can be read: {unfit[0]}"
        wanted = sorted({self._exact(c) for c in self.channels_wanted.values() if c.topic})
        seen = sorted(self.topics_seen)
        if not seen:
            lost = f" ({losses[0]})" if losses else ""
            return f"{source}: the bag holds no message{lost}, expected {', '.join(wanted)}"
        read = list(self.readers)
        if read:
            reader = self.readers[read[0]]
            if reader.count == reader.unreadable:
                return (f"{source}: {read[0]}: no message could be decoded as "
                        f"{reader.msgtype}")
            wants = ", ".join(f"{w.name}.{w.field}" if w.name else w.field
                              for w in reader.wants)
            return f"{source}: {read[0]}: no finite value in any message, expected {wants}"
        more = f" and {len(seen) - 6} more" if len(seen) > 6 else ""
        return (f"{source}: expected one of the topics {', '.join(wanted)}; the bag has "
                f"{', '.join(seen[:6])}{more}")
