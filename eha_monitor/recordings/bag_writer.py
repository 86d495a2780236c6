"""Serialised messages to rosbag2 mcap bags, one by one or by the thousand."""

import contextlib
import os
import shutil
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import MessageIndex
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import Stores, get_typestore

from eha_monitor.errors import InputError

HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
                 ("log_time", "<u8"), ("publish_time", "<u8")])


@dataclass
class _Index(MessageIndex):
    """A message index that holds most of its records as arrays, (k, 2) time and offset each."""

    blocks: list[np.ndarray] = field(default_factory=list)

    def write(self, stream: RecordBuilder) -> None:
        """Write the record."""
        single = np.array(self.records, dtype="<u8").reshape(-1, 2)
        data = np.concatenate([*self.blocks, single]).astype("<u8").tobytes()
        stream.start_record(Opcode.MESSAGE_INDEX)
        stream.write2(self.channel_id)
        stream.write4(len(data))
        stream.write(data)
        stream.finish_record()


@dataclass(frozen=True)
class Messages:
    """Messages of one channel at rising times: ids of mcap, (m,) ns, (m, length) uint8."""

    channel_id: int
    times: np.ndarray
    data: np.ndarray

    def records(self) -> np.ndarray:
        """Return the mcap records, (m, HEAD + length) uint8."""
        head = np.zeros(len(self.times), dtype=HEAD)
        head["opcode"] = Opcode.MESSAGE
        head["length"] = HEAD.itemsize - 9 + self.data.shape[1]
        head["channel"] = self.channel_id
        head["log_time"] = head["publish_time"] = self.times
        return np.hstack([head.view(np.uint8).reshape(-1, HEAD.itemsize), self.data])


class BulkWriter(Writer):
    """An mcap writer that also takes messages by the thousand, byte for byte as one by one.

    ``mcap`` builds each message's record in Python, which takes longer than all else that writing
    a simulated recording does (docs/dependencies.md).  Here the records of a stretch are made as
    one array; file, chunks, compression and summary stay the library's.
    """

    def add_messages(self, channels: list[Messages]) -> None:
        """Add messages of several channels in the order of time, then of the list."""
        channels = [one for one in channels if len(one.times)]
        if not channels:
            return
        data, times, which, ends = _in_order(channels)
        # What mcap keeps private: the chunk in progress, its largest size, the statistics.
        builder, size = self._Writer__chunk_builder, self._Writer__chunk_size
        statistics = self._Writer__statistics
        if statistics.message_count == 0:
            statistics.message_start_time = int(times[0])
        statistics.message_start_time = min(int(times[0]), statistics.message_start_time)
        statistics.message_end_time = max(int(times[-1]), statistics.message_end_time)
        statistics.message_count += len(times)
        for one in channels:
            statistics.channel_message_counts[one.channel_id] += len(one.times)
        first, begin = 0, 0
        while first < len(times):
            # A chunk ends with the message that makes it larger than its size.
            last = int(np.searchsorted(ends, begin + size - builder.count, side="right")) + 1
            last = min(last, len(times))
            stop = int(ends[last - 1])
            starts = np.concatenate([[begin], ends[first:last - 1]]) - begin + builder.count
            if builder.num_messages == 0:
                builder.message_start_time = int(times[first])
            builder.message_start_time = min(builder.message_start_time, int(times[first]))
            builder.message_end_time = max(builder.message_end_time, int(times[last - 1]))
            builder.num_messages += last - first
            self._note(builder, channels, times[first:last], which[first:last], starts)
            builder.record_writer.write(data[begin:stop].tobytes())
            first, begin = last, stop
            self._Writer__maybe_finalize_chunk()

    @staticmethod
    def _note(builder, channels: list[Messages], times: np.ndarray, which: np.ndarray,
              starts: np.ndarray) -> None:
        """Enter messages into the indices of the chunk, in the order of their coming."""
        places, first = np.unique(which, return_index=True)
        for place in places[np.argsort(first)].tolist():
            channel_id = channels[place].channel_id
            index = builder.message_indices.get(channel_id)
            if not isinstance(index, _Index):
                index = _Index(channel_id, index.records if index else [])
                builder.message_indices[channel_id] = index
            if index.records:
                index.blocks.append(np.array(index.records, dtype="<u8"))
                index.records = []
            mine = which == place
            index.blocks.append(np.column_stack([times[mine], starts[mine]]).astype("<u8"))


def _in_order(channels: list[Messages]):
    """Return all records as bytes, their times and channels (place in the list), their ends."""
    records = [one.records() for one in channels]
    lengths = np.array([part.shape[1] for part in records])
    same = all(np.array_equal(one.times, channels[0].times) for one in channels[1:])
    if same and (np.diff(channels[0].times) > 0).all():  # row by row, each channel once
        rows = len(channels[0].times)
        data = np.hstack(records).reshape(-1)
        which = np.tile(np.arange(len(channels)), rows)
        times = np.repeat(channels[0].times, len(channels))
        return data, times, which, np.cumsum(np.tile(lengths, rows))
    times = np.concatenate([one.times for one in channels])
    which = np.concatenate([np.full(len(one.times), i) for i, one in enumerate(channels)])
    order = np.lexsort((which, times))
    times, which = times[order], which[order]
    ends = np.cumsum(lengths[which])
    data = np.empty(int(ends[-1]), dtype=np.uint8)
    for place, part in enumerate(records):
        starts = ends[which == place] - lengths[place]
        data[starts[:, None] + np.arange(lengths[place])] = part
    return data, times, which, ends


FOREVER = QosTime(9223372036, 854775807)
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4,
                "none": CompressionType.NONE}


def check_bag_target(path: str | Path, overwrite: bool) -> None:
    """Refuse a place for a new bag where something else than a bag would be lost.

    Raises InputError if there is anything else, or a bag without ``overwrite``.

    Parameters
    ----------
    path : folder or ``.mcap`` file that is going to be written.
    overwrite : whether a bag that is there may be replaced: a folder of metadata.yaml and .mcap
        files and nothing else, or a file whose name ends in ``.mcap``.
    """
    target = Path(path)
    try:
        if not os.path.lexists(target):
            return
        if not (target.is_dir() or target.is_file()):
            raise InputError(f"{path}: is neither a regular file nor a folder, expected a new bag")
        if not overwrite:
            raise InputError(f"{path}: exists already, expected a new bag or --overwrite")
        if not (_is_bag_folder(target) if target.is_dir() else target.suffix == ".mcap"):
            raise InputError(f"{path}: is no bag; refusing to overwrite it")
    except OSError as problem:
        raise InputError(f"{path}: cannot write bag: {problem.strerror}") from problem


def _is_bag_folder(folder: Path) -> bool:
    """Tell whether a folder holds a bag and nothing that is not part of it."""
    found = list(folder.iterdir())
    parts = [entry for entry in found if entry.name.endswith((".mcap", ".mcap.zstd"))]
    metadata = folder / "metadata.yaml"
    if any(not entry.is_file() or (entry not in parts and entry != metadata) for entry in found):
        return False
    return bool(parts) or (metadata in found and "rosbag2_bagfile_information"
                           in metadata.read_text(encoding="utf-8", errors="replace"))


@dataclass(frozen=True)
class TopicType:
    """What a bag declares of a topic; the type is one of ROS 2 Jazzy."""

    msgtype: str
    latched: bool = False


class BagWriter:
    """Writes serialised messages to a bag; a context manager.

    The bag grows under a temporary name next to the target and is renamed when it is closed. After
    a crash or an exception the temporary file stays: what was written up to the last chunk can be
    read as a truncated bag.  Raises InputError if the target exists or cannot be written, or a
    message type is not known.

    Parameters
    ----------
    path : ``BAG`` becomes ``BAG/metadata.yaml`` and ``BAG/BAG_0.mcap``; a path that ends in
        ``.mcap`` becomes that one file.
    topics : name -> message type, or :class:`TopicType`; more may follow by :meth:`add_topic`.
    compression : ``zstd``, ``lz4`` or ``none``, chunk by chunk.
    overwrite : replace an existing bag.
    """

    def __init__(self, path: str | Path, topics: dict[str, str | TopicType], *,
                 compression: str = "zstd", overwrite: bool = False):
        self.path, self.overwrite = Path(path), overwrite
        if self.path.name in ("", ".."):  # a name of its own, to be renamed to
            self.path = Path(os.path.abspath(path))
        if compression not in COMPRESSIONS:
            raise InputError(f"{path}: compression: expected {', '.join(COMPRESSIONS)}, got "
                             f"{compression!r}")
        check_bag_target(path, overwrite)
        if not self.path.name:
            raise InputError(f"{path}: expected the name of a new bag")
        self.single = self.path.suffix == ".mcap"
        self.temporary = self.path.with_name(
            f".{self.path.stem if self.single else self.path.name}.{os.getpid()}.tmp"
            + (".mcap" if self.single else ""))
        self.counts: dict[str, int] = {}
        self.first, self.last = 2**63 - 1, 0
        self._declared: dict[str, dict] = {}
        self._ids: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._store = None
        self._stream = None
        try:
            self.temporary.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self._file().open("wb")
        except OSError as problem:
            self.discard()
            raise InputError(f"{path}: cannot write bag: {problem.strerror}") from problem
        self._writer = BulkWriter(self._stream, chunk_size=786_432,
                              compression=COMPRESSIONS[compression])
        self._writer.start("ros2", "eha_monitor")
        try:
            for topic, kind in topics.items():
                self.add_topic(topic, kind)
        except InputError:
            self.discard()
            raise

    def _file(self) -> Path:
        if self.single:
            return self.temporary
        self._remove(self.temporary)
        self.temporary.mkdir()
        return self.temporary / f"{self.path.name}_0.mcap"

    def add_topic(self, topic: str, kind: str | TopicType) -> None:
        """Declare a topic; names are absolute.  Declaring it again changes nothing."""
        if topic in self._ids:
            return
        kind = TopicType(kind) if isinstance(kind, str) else kind
        self._store = self._store or get_typestore(Stores.ROS2_JAZZY)
        if kind.msgtype not in self._store.fielddefs:
            raise InputError(f"{self.path}: {topic}: message type {kind.msgtype} is not "
                             "known, expected one of ROS 2 Jazzy")
        definition = self._store.generate_msgdef(kind.msgtype, ros_version=2)[0]
        digest = self._store.hash_rihs01(kind.msgtype)
        # rosbags drops a topic whose QoS differs between file and metadata: one source for both.
        durability = QosDurability.TRANSIENT_LOCAL if kind.latched else QosDurability.VOLATILE
        profiles = dump_qos_v9([Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, durability,
                                    FOREVER, FOREVER, QosLiveliness.AUTOMATIC, FOREVER, False)])
        if kind.msgtype not in self._schemas:
            self._schemas[kind.msgtype] = self._writer.register_schema(
                kind.msgtype, "ros2msg", definition.encode())
        self._ids[topic] = self._writer.register_channel(
            topic, "cdr", self._schemas[kind.msgtype],
            {"offered_qos_profiles": yaml_text(profiles).strip(), "topic_type_hash": digest})
        self.counts[topic] = 0
        self._declared[topic] = {
            "name": topic, "type": kind.msgtype, "serialization_format": "cdr",
            "offered_qos_profiles": profiles, "type_description_hash": digest}

    def write_raw(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Append one serialised message; ``stamp_ns`` is its log time."""
        self._writer.add_message(self._ids[topic], stamp_ns, data, stamp_ns)
        self.counts[topic] += 1
        self.first, self.last = min(self.first, stamp_ns), max(self.last, stamp_ns)

    def write_many(self, channels: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
        """Append messages of topics: rising log times (m,) ns and messages (m, length) uint8.

        Raises InputError if the disk takes no more.
        """
        try:
            self._writer.add_messages([Messages(self._ids[topic], times, data)
                                       for topic, (times, data) in channels.items()])
        except OSError as problem:
            raise InputError(f"{self.path}: cannot write bag: {problem.strerror}") from problem
        for topic, (times, _) in channels.items():
            if len(times):
                self.counts[topic] += len(times)
                self.first = min(self.first, int(times[0]))
                self.last = max(self.last, int(times[-1]))

    def flush(self) -> None:
        """Put everything written so far on disk as a finished chunk."""
        self._writer.flush()

    def close(self) -> None:
        """Write index and metadata, and give the bag its name."""
        if self._stream is None:
            return
        try:
            metadata = self._metadata()
            self._writer.add_metadata("rosbag2", {"serialized_metadata": yaml_text(metadata)})
            self._writer.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self._stream = None
            if not self.single:
                (self.temporary / "metadata.yaml").write_text(
                    yaml_text({"rosbag2_bagfile_information": metadata}), encoding="utf-8")
            self._take_the_name()
        except OSError as problem:
            raise InputError(f"{self.path}: cannot write bag: {problem.strerror}; what was "
                             f"written is in {self.temporary}") from problem

    def _take_the_name(self) -> None:
        """Rename the finished bag; what was there goes only when the new one is in place."""
        try:
            check_bag_target(self.path, self.overwrite)  # again: it may have come meanwhile
        except InputError as problem:
            raise InputError(f"{problem}; the bag is left as {self.temporary}") from problem
        if not os.path.lexists(self.path):
            self.temporary.rename(self.path)
            return
        old = self.temporary.with_name(self.temporary.name + ".old")
        self.path.rename(old)
        try:
            self.temporary.rename(self.path)
        except OSError:
            old.rename(self.path)
            raise
        self._remove(old)

    def abort(self) -> None:
        """Stop without index and name; the temporary file keeps what was written."""
        stream, self._stream = self._stream, None
        if stream is not None:
            try:
                self._writer.flush()
            finally:
                stream.close()

    def discard(self) -> None:
        """Stop and remove what was written."""
        stream, self._stream = self._stream, None
        with contextlib.suppress(OSError):  # of a full disk: it is full of what goes now
            if stream is not None:
                stream.close()
        with contextlib.suppress(OSError):
            self._remove(self.temporary)

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, kind, value, traceback) -> None:
        self.close() if kind is None else self.abort()

    @staticmethod
    def _remove(path: Path) -> None:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)

    def _metadata(self) -> dict:
        count = sum(self.counts.values())
        start = {"nanoseconds_since_epoch": self.first if count else 0}
        duration = {"nanoseconds": max(0, self.last - self.first) if count else 0}
        name = self.path.name if self.single else f"{self.path.name}_0.mcap"
        return {
            "version": 9, "storage_identifier": "mcap", "duration": duration,
            "starting_time": start, "message_count": count,
            "topics_with_message_count": [
                {"topic_metadata": self._declared[topic], "message_count": number}
                for topic, number in self.counts.items()],
            "compression_format": "", "compression_mode": "",
            "relative_file_paths": [name],
            "files": [{"path": name, "starting_time": start, "duration": duration,
                       "message_count": count}],
            "custom_data": None, "ros_distro": "jazzy"}


def yaml_text(tree) -> str:
    """Return plain data as YAML, without anchors."""
    from ruamel.yaml import YAML
    yaml, text = YAML(typ="safe"), StringIO()
    yaml.default_flow_style = False
    yaml.representer.ignore_aliases = lambda data: True
    yaml.dump(tree, text)
    return text.getvalue()
