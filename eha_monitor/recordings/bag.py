"""Which files make a bag, and its messages as raw bytes.

The framing of an mcap file is walked by a compiled loop (:func:`walk_records`);
what the records mean is left to the ``mcap`` library.  The summary at the end is not needed, so a
file that was cut off is read up to the cut, its last chunk included.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import mcap.records
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import get_chunk_data_stream

from eha_monitor.compiled import njit
from eha_monitor.errors import InputError
from eha_monitor.output import check_regular, natural
from eha_monitor.recordings.columns import let_go

# Why a walk ended.
AT_END, FULL, CUT, DAMAGED, FOOTER = range(5)

MESSAGE_OPCODE = 0x05
FOOTER_OPCODE = 0x02
PREFIX = 9  # opcode and record length
MESSAGE_HEAD = 22  # channel id, sequence, log time, publish time


@njit
def _little(data, position, size):
    value = np.uint64(0)
    for i in range(size):
        value |= np.uint64(data[position + i]) << np.uint64(8 * i)
    return np.int64(value)


class Messages(NamedTuple):
    """Of messages, (m,) int64: channel id, log time in ns, position and length of the payload."""

    ids: np.ndarray
    times: np.ndarray
    begins: np.ndarray
    lengths: np.ndarray


class Others(NamedTuple):
    """Of every other record, (k,) int64: opcode, position and length of its content."""

    opcodes: np.ndarray
    begins: np.ndarray
    lengths: np.ndarray


@njit
def walk_records(data, start, found, others_found):
    """Walk mcap records from ``start`` on, until an output array is full or the data end.

    Parameters
    ----------
    data : (n,) uint8.
    start : position of an opcode.
    found, others_found : :class:`Messages` and :class:`Others`, written.

    Returns
    -------
    position, messages, others, ending : where the walk stopped, how many of each, and why.
    """
    ids, times, begins, lengths = found
    opcodes, other_begins, other_lengths = others_found
    position = start
    messages = 0
    others = 0
    size = len(data)
    while True:
        if messages == len(ids) or others == len(opcodes):
            return position, messages, others, FULL
        if position == size:
            return position, messages, others, AT_END
        if position + PREFIX > size:
            return position, messages, others, CUT
        opcode = data[position]
        length = _little(data, position + 1, 8)
        if opcode == 0 or length < 0 or (opcode == MESSAGE_OPCODE and length < MESSAGE_HEAD):
            return position, messages, others, DAMAGED
        begin = position + PREFIX
        if length > size - begin:
            return position, messages, others, CUT
        if opcode == MESSAGE_OPCODE:
            ids[messages] = _little(data, begin, 2)
            times[messages] = _little(data, begin + 6, 8)
            begins[messages] = begin + MESSAGE_HEAD
            lengths[messages] = length - MESSAGE_HEAD
            messages += 1
        else:
            opcodes[others] = opcode
            other_begins[others] = begin
            other_lengths[others] = length
            others += 1
        position = begin + length
        if opcode == FOOTER_OPCODE:
            return position, messages, others, FOOTER


MAGIC = b"\x89MCAP0\r\n"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
LARGEST_CHUNK = 2**31  # a larger one is a damaged length, not a chunk
BATCH = 65536  # messages for each yielded block of an unchunked file
OTHERS = 256  # other records that are walked at a time: each touches some pages of the file

# What the libraries raise on hostile bytes; struct.error is no ValueError, EOFError none either.
DAMAGE = (McapError, ValueError, KeyError, RuntimeError, EOFError, MemoryError, OverflowError,
          struct.error, zstandard.ZstdError)


@dataclass(frozen=True)
class Block:
    """Messages that lie in one stretch of bytes.

    ``data`` (n,) uint8; ``ids``, ``times`` (log time, ns), ``begins``, ``lengths`` (m,) int64.
    """

    data: np.ndarray
    ids: np.ndarray
    times: np.ndarray
    begins: np.ndarray
    lengths: np.ndarray


class McapFile:
    """One mcap file; iterate :meth:`blocks`, then ask what was lost."""

    def __init__(self, path: Path):
        self.path = path
        self.schemas: dict[int, mcap.records.Schema] = {}  # filled while the blocks are read
        self.channels: dict[int, mcap.records.Channel] = {}
        self.found = 0  # messages so far
        self.declared: int | None = None  # messages that the file's own statistics say
        self.truncated_at: int | None = None  # byte from which it cannot be followed
        self.damaged_chunks = 0  # that could not be decoded
        self.damage = ""
        self.data = _bytes_of(path)

    def blocks(self) -> Iterator[Block]:
        """Yield the messages in file order."""
        position, ending = len(MAGIC), FULL
        while ending == FULL:
            block, records, position, ending = _walk(self.data, position)
            records.sort(key=lambda record: record[0] == Opcode.CHUNK)  # channels come first
            for opcode, begin, length in records:
                if opcode == Opcode.CHUNK:
                    break
                self._declare(opcode, self.data[begin:begin + length])
            yield from self._count(block)
            let_go(self.data)
            for opcode, begin, length in records:
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(self.data[begin:begin + length], whole=True)
                    let_go(self.data)
        if ending == FOOTER:
            return
        self.truncated_at = len(self.data) if ending == AT_END else position
        rest = self.data[position:]
        if len(rest) > PREFIX and rest[0] == Opcode.CHUNK:
            yield from self._chunk(rest[PREFIX:], whole=False)

    def _count(self, block: Block) -> Iterator[Block]:
        if len(block.ids):
            self.found += len(block.ids)
            yield block

    def channels_in(self, block: Block) -> Iterator[
            tuple[mcap.records.Channel, mcap.records.Schema, int]]:
        """Yield channel, schema and number of messages of what is in a block and declared."""
        for channel_id, number in zip(*np.unique(block.ids, return_counts=True), strict=True):
            channel = self.channels.get(int(channel_id))
            schema = self.schemas.get(channel.schema_id) if channel else None
            if schema is not None:
                yield channel, schema, int(number)

    def _declare(self, opcode: int, data: np.ndarray) -> None:
        """Take note of a schema, a channel or the statistics."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = mcap.records.Schema.read(_stream(data))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = mcap.records.Channel.read(_stream(data))
                self.channels[channel.id] = channel
            elif opcode == Opcode.STATISTICS:
                self.declared = mcap.records.Statistics.read(_stream(data)).message_count
        except DAMAGE as problem:
            self.damage = self.damage or type(problem).__name__

    def _chunk(self, data: np.ndarray, whole: bool) -> Iterator[Block]:
        try:
            content = _content(mcap.records.Chunk.read(_stream(data)), whole)
        except DAMAGE as problem:
            if whole:
                self.damaged_chunks += 1
                self.damage = self.damage or " ".join(str(problem).split())[:100]
            return
        position, ending = 0, FULL
        while ending == FULL:
            block, records, position, ending = _walk(content, position)
            for opcode, begin, length in records:
                self._declare(opcode, content[begin:begin + length])
            yield from self._count(block)
        if whole and ending != AT_END:
            self.damaged_chunks += 1


def _bytes_of(path: Path) -> np.ndarray:
    """Return the file as uint8, unpacked where the file as a whole is compressed."""
    check_regular(path, "an mcap bag")
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty, expected an mcap bag")
        data = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
        if bytes(data[:4]) == ZSTD_MAGIC:
            unpacked = zstandard.ZstdDecompressor().decompressobj().decompress(data.tobytes())
            data = np.frombuffer(unpacked, dtype=np.uint8)
    except OSError as problem:
        raise InputError(f"{path}: cannot read bag: {problem.strerror}") from problem
    except (zstandard.ZstdError, MemoryError) as problem:
        raise InputError(f"{path}: cannot unpack the zstd file: {problem}") from problem
    head = bytes(data[:len(MAGIC)])
    if head != MAGIC:
        if head.startswith(b"SQLite"):
            raise InputError(f"{path}: expected an mcap bag, got sqlite3; convert it with "
                             "'ros2 bag convert' or 'rosbags-convert'")
        raise InputError(f"{path}: expected an mcap bag, got another kind of file")
    return data


def _stream(data: np.ndarray) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))


def _walk(data: np.ndarray, start: int):
    """Walk at most BATCH messages; returns the block, the other records, position, ending."""
    room = min(BATCH, max((len(data) - start) // 31, 0) + 1)
    found, rest = Messages(*np.empty((4, room), dtype=np.int64)), Others(
        *np.empty((3, OTHERS), dtype=np.int64))
    position, messages, others, ending = walk_records(data, start, found, rest)
    block = Block(data, *(column[:messages] for column in found))
    records = zip(*(column[:others].tolist() for column in rest), strict=True)
    return block, list(records), position, ending


def _content(chunk: mcap.records.Chunk, whole: bool) -> np.ndarray:
    """Return the records in a chunk, checksum checked; of a cut chunk, what is there."""
    if chunk.compression not in ("", "zstd", "lz4"):
        raise ValueError(f"compression {chunk.compression!r}, expected zstd, lz4 or none")
    if chunk.uncompressed_size > LARGEST_CHUNK:
        raise ValueError(f"chunk of {chunk.uncompressed_size} bytes")
    if chunk.compression == "zstd":
        declared = zstandard.get_frame_parameters(chunk.data).content_size
        if declared not in (zstandard.CONTENTSIZE_UNKNOWN, chunk.uncompressed_size):
            raise ValueError("chunk size and zstd frame disagree")
    if whole:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        content = stream.read(size)
    elif chunk.compression == "zstd":
        content = zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
    elif chunk.compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data)
    else:
        content = chunk.data
    return np.frombuffer(content, dtype=np.uint8)


LARGEST_METADATA = 2**24  # bytes


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: message type, definition, messages found, QoS as YAML text."""

    name: str
    msgtype: str
    encoding: str
    definition: str
    count: int
    qos: str


class Bag:
    """A rosbag2 bag: a folder with metadata.yaml and .mcap files, or a single .mcap file."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.losses: list[str] = []
        paths, self.declared = _files_of(self.path, self.losses)
        self.files = []
        for part in paths:
            try:
                self.files.append(McapFile(part))
            except InputError as problem:
                if len(paths) == 1:
                    raise
                self.losses.append(f"left out: {problem}")
        if not self.files:
            raise InputError(f"{self.path}: {self.losses[-1]}")

    def blocks(self) -> Iterator[tuple[McapFile, Block]]:
        """Yield the messages of all files in order; channels are known when a block comes."""
        for file in self.files:
            for block in file.blocks():
                yield file, block

    def damage(self) -> list[str]:
        """Return what was lost, in sentences, once the blocks have been read."""
        sentences = list(self.losses)
        found = sum(file.found for file in self.files)
        for file in self.files:
            name = f"{file.path.name}: " if len(self.files) > 1 else ""
            if file.truncated_at is not None:
                sentences.append(f"{name}truncated at byte {file.truncated_at} of "
                                 f"{len(file.data)}")
            if file.damaged_chunks:
                reason = f" ({file.damage})" if file.damage else ""
                sentences.append(f"{name}{file.damaged_chunks} damaged chunk"
                                 f"{'s' * (file.damaged_chunks > 1)} left out{reason}")
            if file.declared is not None and file.declared != file.found:
                sentences.append(f"{name}the file declares {file.declared} messages, "
                                 f"{file.found} were found")
        if self.declared is not None and self.declared != found:
            sentences.append(f"metadata.yaml declares {self.declared} messages, "
                             f"{found} were found")
        return sentences


def _files_of(path: Path, losses: list[str]) -> tuple[list[Path], int | None]:
    """Return the files of a bag in order, and the message count that its metadata declares."""
    if not path.exists():
        raise InputError(f"{path}: no such bag")
    if not path.is_dir():
        return [path], None
    metadata = path / "metadata.yaml"
    inside = sorted((entry for entry in path.iterdir()
                     if entry.name.endswith((".mcap", ".mcap.zstd"))),
                    key=lambda entry: natural(entry.name))
    if not metadata.exists():
        if not inside:
            kind = "an sqlite3 bag, convert it with 'ros2 bag convert' or 'rosbags-convert'" if (
                any(path.glob("*.db3"))) else "neither metadata.yaml nor .mcap file"
            raise InputError(f"{path}: expected an mcap bag, found {kind}")
        return inside, None
    listed, count = _metadata(metadata, losses)
    if not inside and (any(path.glob("*.db3*")) or any(n.endswith(".db3") for n in listed)):
        raise InputError(f"{path}: expected an mcap bag, got sqlite3; convert it with "
                         "'ros2 bag convert' or 'rosbags-convert'")
    chosen = []
    for name in listed:
        there = [one for one in (path / name, path / f"{name}.zstd") if one in inside]
        chosen += there[:1]
        if not there:
            losses.append(f"{name} is listed in metadata.yaml and is missing")
    if not chosen and not inside:
        raise InputError(f"{path}: expected the .mcap files that metadata.yaml lists, found none")
    return chosen or inside, count


def _metadata(path: Path, losses: list[str]) -> tuple[list[str], int | None]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    check_regular(path, "the metadata.yaml of a bag")
    try:
        if path.stat().st_size > LARGEST_METADATA:
            raise ValueError("not what a recorder writes")
        tree = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
        information = tree["rosbag2_bagfile_information"]
        names = [Path(str(name)).name for name in information["relative_file_paths"]]
        count = information.get("message_count")
        return names, count if isinstance(count, int) else None
    except (OSError, YAMLError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        losses.append("metadata.yaml cannot be read, the .mcap files are taken as they are")
        return [], None


def topics(path: str | Path) -> dict[str, Topic]:
    """Return the topics of a bag that hold messages, by name.

    Raises InputError if there is no bag.
    """
    bag = Bag(path)
    counts: Counter[str] = Counter()
    found: dict[str, Topic] = {}
    for file, block in bag.blocks():
        for channel, schema, number in file.channels_in(block):
            counts[channel.topic] += number
            found[channel.topic] = Topic(
                channel.topic, schema.name, schema.encoding,
                schema.data.decode("utf-8", errors="replace"), counts[channel.topic],
                channel.metadata.get("offered_qos_profiles", ""))
    return found


def iter_raw(path: str | Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield (topic, message type, log time in ns, serialised message) in order of time.

    The order holds within each chunk; chunks follow one another as they were written.  A truncated
    bag simply ends.  Raises InputError if there is no bag.
    """
    unpack = zstandard.ZstdDecompressor()
    for file, block in Bag(path).blocks():
        names = {channel.id: (channel.topic, schema.name)
                 for channel, schema, _ in file.channels_in(block)}
        order = np.argsort(block.times, kind="stable")
        columns = (block.ids, block.times, block.begins, block.lengths)
        for channel_id, time, begin, length in zip(*(c[order].tolist() for c in columns),
                                                   strict=True):
            if channel_id not in names:
                continue
            raw = block.data[begin:begin + length].tobytes()
            if raw[:4] == ZSTD_MAGIC:
                try:
                    raw = unpack.decompress(raw, max_output_size=2**24)
                except (zstandard.ZstdError, MemoryError):
                    continue
            yield *names[channel_id], time, raw
