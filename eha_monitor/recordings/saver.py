"""Writing the ring of the last minutes to a bag, in a thread, so that nothing else waits."""

import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from eha_monitor.errors import InputError
from eha_monitor.recordings.ring import Chunk, Ring
from eha_monitor.recordings.write import BagWriter

# The thread rests after each chunk: Python runs one thread at a time, and the filter has its turn.
REST_S = 0.003


@dataclass(frozen=True)
class Saved:
    """What came of one attempt.

    ``path`` is the bag; ``problem`` is a sentence and says why there is none; ``first_ns``,
    ``last_ns`` and ``count`` tell what was, or was to be, written; ``dropped`` counts the messages
    in between that went while earlier attempts failed; ``left_out`` names topics of a type that
    is not known.
    """

    path: Path
    first_ns: int
    last_ns: int
    count: int
    dropped: int = 0
    problem: str | None = None
    left_out: tuple[str, ...] = ()

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
        self.name = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "bag"
        self._hurry = threading.Event()
        self._thread: threading.Thread | None = None
        self._result: Saved | None = None

    @property
    def busy(self) -> bool:
        """Whether a bag is being written, or its result has not been taken yet."""
        return self._thread is not None

    def start(self) -> None:
        """Begin to write all that the ring has; not while :attr:`busy`."""
        chunks, streams = self.ring.hold(), list(self.ring.streams)
        moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%S_%f")[:-3]
        path = self.folder / f"{self.name}_{moment}Z"
        self._thread = threading.Thread(target=self._run, daemon=True, name="saver",
                                        args=(path, chunks, streams, self.ring.dropped))
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

    def _run(self, path: Path, chunks: tuple[Chunk, ...], streams: list, dropped: int) -> None:
        span = (chunks[0].first_ns, chunks[-1].last_ns) if chunks else (0, 0)
        count, problem, left_out = sum(chunk.count for chunk in chunks), None, ()
        try:
            if not chunks:
                raise InputError(f"{path}: nothing to write, no message has come")
            left_out = _write(path, chunks, streams, self._hurry)
            self.ring.release()
        except (InputError, OSError) as caught:
            cause = caught if isinstance(caught, OSError) else caught.__cause__
            problem = (f"{path}: cannot write bag: {cause.strerror or cause}"
                       if isinstance(cause, OSError) else str(caught))
        except Exception as caught:  # noqa: BLE001  told as a diagnostic: the monitor goes on
            problem = f"{path}: cannot write bag: {caught!r}"
        self._result = Saved(path, *span, count, dropped, problem, left_out)


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
