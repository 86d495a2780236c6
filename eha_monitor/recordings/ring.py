"""The last minutes of serialised messages in memory, compressed, within a bound."""

import struct
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import zstandard

from eha_monitor.recordings.write import TopicType

LIMIT_BYTES = 128 * 1024 * 1024
# A chunk is closed and compressed at this size (a tenth of a second of one actuator at 1 kHz,
# 0.2 ms of work), or at this part of the span, so that the oldest goes in small steps.
CHUNK_BYTES = 64 * 1024
CHUNKS_IN_SPAN = 60
_RECORD = struct.Struct("<qHI")  # stamp in ns, stream, length; then the message
_LARGEST_STREAM = 2**16


@dataclass(frozen=True)
class Chunk:
    """Consecutive messages, compressed.

    ``number`` counts the chunks of the ring from 0; ``began_s`` is on the monotonic clock, the
    stamps are log times in ns.
    """

    number: int
    began_s: float
    first_ns: int
    last_ns: int
    count: int
    data: bytes

    def messages(self) -> Iterator[tuple[int, int, memoryview]]:
        """Yield stream, log time in ns and message."""
        raw = memoryview(zstandard.decompress(self.data))
        at = 0
        while at < len(raw):
            stamp_ns, stream, length = _RECORD.unpack_from(raw, at)
            at += _RECORD.size
            yield stream, stamp_ns, raw[at:at + length]
            at += length


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
        self.extend([(stamp_ns, stream, data)])

    def extend(self, messages: Iterable[tuple[int, int, bytes]]) -> None:
        """Take messages in the order of their log times: (log time in ns, stream, message)."""
        parts, count, first = [], 0, None
        for stamp_ns, stream, data in messages:
            first = stamp_ns if first is None else first
            parts += _RECORD.pack(stamp_ns, stream, len(data)), data
            count += 1
        if not count:
            return
        if not self._open_count:
            self._open_first_ns, self._open_since = first, time.monotonic()
        self._open += b"".join(parts)
        self._open_count += count
        self._open_last_ns = stamp_ns
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

    def release(self) -> None:
        """The held messages are saved: let them age as all others."""
        with self._lock:
            self._held = ()
        self.dropped = 0

    @property
    def messages(self) -> int:
        """Messages in memory."""
        with self._lock:
            young = self._chunks[0].number if self._chunks else self._closed
            return (self._open_count + sum(c.count for c in self._chunks)
                    + sum(c.count for c in self._held if c.number < young))

    @property
    def megabytes(self) -> float:
        """Memory of the messages, MB."""
        with self._lock:
            young = self._chunks[0].number if self._chunks else self._closed
            held = sum(len(c.data) for c in self._held if c.number < young)
            return (self._bytes + held + len(self._open)) / 1e6

    def _close(self, now: float) -> None:
        chunk = Chunk(self._closed, self._open_since, self._open_first_ns, self._open_last_ns,
                      self._open_count, self._compressor.compress(bytes(self._open)))
        self._open, self._open_count = bytearray(), 0
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
