"""The last minutes of serialised messages in memory, compressed, within a bound, and saved.

Saving goes on in a thread, so that nothing else waits.
"""

import struct
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import zstandard

from eha_monitor.errors import InputError
from eha_monitor.recordings.write import BagWriter, TopicType

LIMIT_BYTES = 128 * 1024 * 1024
# A chunk is closed and compressed at this size (a tenth of a second of one actuator at 1 kHz,
# 0.2 ms of work), or at this part of the span, so that the oldest goes in small steps.
CHUNK_BYTES = 64 * 1024
CHUNKS_IN_SPAN = 60
_BLOCK = struct.Struct("<HI")  # stream, messages; then their stamps in ns, lengths, contents
Block = tuple[int, Sequence[int], Sequence[bytes]]  # stream, log times in ns, messages
_LARGEST_STREAM = 2**16


@dataclass(frozen=True)
class Chunk:
    """Consecutive messages, compressed."""

    number: int  # counts the chunks of the ring from 0
    began_s: float  # on the monotonic clock
    first_ns: int  # log times
    last_ns: int
    count: int
    data: bytes

    def messages(self) -> Iterator[tuple[int, int, memoryview]]:
        """Yield stream, log time in ns and message, in the order of their log times."""
        raw = memoryview(zstandard.decompress(self.data))
        at, found = 0, []
        while at < len(raw):
            stream, count = _BLOCK.unpack_from(raw, at)
            at += _BLOCK.size
            stamps = np.frombuffer(raw, "<i8", count, at).tolist()
            ends = np.cumsum(np.frombuffer(raw, "<u4", count, at + 8 * count)) + at + 12 * count
            starts = [at + 12 * count, *ends.tolist()]
            found += zip((stream,) * count, stamps, map(slice, starts, starts[1:]), strict=False)
            at = starts[-1]
        for stream, stamp_ns, place in sorted(found, key=lambda one: one[1]):
            yield stream, stamp_ns, raw[place]


class Ring:
    """Keeps messages for a span of time, and longer what could not be saved yet.

    One thread appends; any thread may hold and release.

    Parameters
    ----------
    span_s : how long messages are kept, s.
    limit_bytes : bound on the compressed messages; the same again for what is held.

    Attributes
    ----------
    streams : what each number of a stream stands for: topic and type.
    dropped : messages that came after the held ones and went before they were saved.
    """

    def __init__(self, span_s: float, limit_bytes: int = LIMIT_BYTES):
        self.span_s, self.limit_bytes = span_s, limit_bytes
        self.streams: list[tuple[str, TopicType]] = []
        self.dropped = 0
        self._chunks: deque[Chunk] = deque()
        self._held: tuple[Chunk, ...] = ()
        self._open = bytearray()
        self._open_count = self._open_first_ns = self._open_last_ns = self._closed = 0
        self._open_since = 0.0
        self._bytes = 0
        self._lock = threading.Lock()
        self._compressor = zstandard.ZstdCompressor(level=1)

    def stream(self, topic: str, kind: TopicType) -> int:
        """Return the number of a stream; ``topic`` is absolute."""
        if (topic, kind) not in self.streams:
            if len(self.streams) >= _LARGEST_STREAM:
                raise ValueError("more streams than a number of two bytes holds")
            self.streams.append((topic, kind))
        return self.streams.index((topic, kind))

    def append(self, stream: int, stamp_ns: int, data: bytes) -> None:
        """Take one message; ``stamp_ns`` is its log time."""
        self.extend([(stream, [stamp_ns], [data])])

    def extend(self, blocks: Sequence[Block]) -> None:
        """Take what came of each stream, one message at least, in the order of its log times."""
        if not blocks:
            return
        if not self._open_count:
            self._open_first_ns = min(stamps[0] for _, stamps, _ in blocks)
            self._open_since = time.monotonic()
        for stream, stamps, messages in blocks:
            self._open += b"".join([_BLOCK.pack(stream, len(messages)),
                                    np.array(stamps, "<i8").tobytes(),
                                    np.array([*map(len, messages)], "<u4").tobytes(), *messages])
            self._open_count += len(messages)
            self._open_last_ns = max(self._open_last_ns, stamps[-1])
        if len(self._open) >= CHUNK_BYTES:
            self._close(time.monotonic())

    def trim(self) -> None:
        """Drop what is older than the span; to be called now and then, as data may stop."""
        now = time.monotonic()
        if self._open_count and now - self._open_since > self.span_s / CHUNKS_IN_SPAN:
            self._close(now)
        self._drop(now)

    def hold(self) -> tuple[Chunk, ...]:
        """Hold and return all that is there, first what a hold before left, oldest first.

        It stays until :meth:`release`; what is held and has aged counts up to ``limit_bytes``.
        """
        if self._open_count:
            self._close(time.monotonic())
        with self._lock:
            last = self._held[-1].number if self._held else -1
            found = (*self._held, *(c for c in self._chunks if c.number > last))
            kept, size = [], 0
            for chunk in found:
                size += len(chunk.data)
                if kept and size > self.limit_bytes:
                    break
                kept.append(chunk)
            self._held = tuple(kept)
        return found

    def since(self, stamp_ns: int) -> tuple[Chunk, ...]:
        """Return the chunks that began no earlier than a log time; they go on ageing."""
        if self._open_count:
            self._close(time.monotonic())
        with self._lock:
            return tuple(chunk for chunk in self._chunks if chunk.first_ns >= stamp_ns)

    def release(self) -> None:
        """The held messages are saved: let them age as all others."""
        with self._lock:
            self._held = ()
        self.dropped = 0

    @property
    def messages(self) -> int:
        """Messages in memory."""
        with self._lock:
            return self._open_count + sum(c.count for c in (*self._chunks, *self._old()))

    @property
    def megabytes(self) -> float:
        """Memory of the messages, MB."""
        with self._lock:
            held = sum(len(c.data) for c in self._old())
            return (self._bytes + held + len(self._open)) / 1e6

    def _old(self) -> list[Chunk]:
        """Return what has aged and is still held."""
        young = self._chunks[0].number if self._chunks else self._closed
        return [chunk for chunk in self._held if chunk.number < young]

    def _close(self, now: float) -> None:
        # A copy of its own size: what zstandard returns holds the memory of the uncompressed.
        data = bytes(memoryview(self._compressor.compress(self._open)))
        chunk = Chunk(self._closed, self._open_since, self._open_first_ns, self._open_last_ns,
                      self._open_count, data)
        self._open, self._open_count, self._open_last_ns = bytearray(), 0, 0
        with self._lock:
            self._closed += 1
            self._chunks.append(chunk)
            self._bytes += len(chunk.data)
        self._drop(now)

    def _drop(self, now: float) -> None:
        with self._lock:
            while self._chunks and (self._bytes > self.limit_bytes
                                    or now - self._chunks[0].began_s > self.span_s):
                chunk = self._chunks.popleft()
                self._bytes -= len(chunk.data)
                if self._held and chunk.number > self._held[-1].number:
                    self.dropped += chunk.count


# The thread rests after each chunk: Python runs one thread at a time, and the filter has its turn.
REST_S = 0.003


@dataclass(frozen=True)
class Saved:
    """What came of one attempt."""

    path: Path  # of the bag
    first_ns: int  # of what was, or was to be, written
    last_ns: int
    count: int
    dropped: int = 0  # messages in between that went while earlier attempts failed
    problem: str | None = None  # a sentence that says why there is no bag
    left_out: tuple[str, ...] = ()  # topics of a type that is not known

    @property
    def span_s(self) -> float:
        """Length of the bag, s."""
        return (self.last_ns - self.first_ns) * 1e-9

    def __str__(self) -> str:
        if self.problem is not None:
            return (f"{self.problem}; {self.count} messages over {self.span_s:.1f} s are kept for "
                    "the next attempt")
        left = f"; left out, of unknown type: {', '.join(self.left_out)}" if self.left_out else ""
        gap = f"; {self.dropped} messages in between were dropped" if self.dropped else ""
        times = [datetime.fromtimestamp(t * 1e-9, UTC).strftime("%H:%M:%S") for t in
                 (self.first_ns, self.last_ns)]
        return (f"{self.path}: {self.count} messages over {self.span_s:.1f} s, from {times[0]} to "
                f"{times[1]} UTC{gap}{left}")


def plain_name(name: str) -> str:
    """Return a name as the beginning of a file's name."""
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "bag"


class Saver:
    """Writes what a ring holds to bags, one at a time.

    Parameters
    ----------
    ring : the messages; what could not be written stays held in it.
    folder : of the bags.
    name : beginning of their names.
    """

    def __init__(self, ring: Ring, folder: Path, name: str):
        self.ring, self.folder = ring, Path(folder)
        self.name = plain_name(name)
        self._hurry = threading.Event()
        self._thread: threading.Thread | None = None
        self._result: Saved | None = None

    @property
    def busy(self) -> bool:
        """Whether a bag is being written, or its result has not been taken yet."""
        return self._thread is not None

    def start(self, since_ns: int | None = None) -> None:
        """Begin to write all that the ring has; not while :attr:`busy`.

        ``since_ns`` : write only what came from this log time on; nothing is held for that.
        """
        whole = since_ns is None
        chunks = self.ring.hold() if whole else self.ring.since(since_ns)
        streams = list(self.ring.streams)
        moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%S_%f")[:-3]
        path = self.folder / f"{self.name}_{moment}Z"
        self._thread = threading.Thread(target=self._run, daemon=True, name="saver",
                                        args=(path, chunks, streams,
                                              self.ring.dropped if whole else None))
        self._thread.start()

    def take(self, wait: bool = False) -> Saved | None:
        """Return what came of the attempt once it has ended; ``wait`` waits for that."""
        if self._thread is None or (self._thread.is_alive() and not wait):
            return None
        self._hurry.set()
        self._thread.join()
        self._hurry.clear()
        self._thread = None
        return self._result

    def _run(self, path: Path, chunks: tuple[Chunk, ...], streams: list,
             dropped: int | None) -> None:
        """Write a bag; ``dropped`` is None where it is not all that is held."""
        span = (chunks[0].first_ns, chunks[-1].last_ns) if chunks else (0, 0)
        count, problem, left_out = sum(chunk.count for chunk in chunks), None, ()
        try:
            if not chunks:
                raise InputError(f"{path}: nothing to write, no message has come")
            left_out = _write(path, chunks, streams, self._hurry)
            if dropped is not None:
                self.ring.release()
        except (InputError, OSError) as caught:
            cause = caught if isinstance(caught, OSError) else caught.__cause__
            problem = (f"{path}: cannot write bag: {cause.strerror or cause}"
                       if isinstance(cause, OSError) else str(caught))
        except Exception as caught:  # noqa: BLE001  told as a diagnostic: the monitor goes on
            problem = f"{path}: cannot write bag: {caught!r}"
        self._result = Saved(path, *span, count, dropped or 0, problem, left_out)


def _write(path: Path, chunks: tuple[Chunk, ...], streams: list,
           hurry: threading.Event) -> tuple[str, ...]:
    """Write a bag and return the topics that had to be left out."""
    writer = BagWriter(path, {})
    try:
        left_out, names, last = [], {}, dict(streams)
        for number, (topic, kind) in enumerate(streams):
            try:
                if last[topic] != kind:  # a bag has one type to a topic: the last one
                    raise InputError(topic)
                writer.add_topic(topic, kind)
                names[number] = topic
            except InputError:
                left_out.append(f"{topic} ({kind.msgtype})")
        for chunk in chunks:
            for stream, stamp_ns, data in chunk.messages():
                if stream in names:
                    writer.write_raw(names[stream], stamp_ns, data)
            if not hurry.is_set():
                time.sleep(REST_S)
        writer.close()
    except BaseException:
        writer.discard()  # on a full disk, what was written would only be in the way
        raise
    return tuple(left_out)
