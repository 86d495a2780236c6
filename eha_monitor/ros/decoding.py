"""Messages of one topic to columns of numbers.

Most messages of a topic differ in nothing but stamp and numbers.  Where those stand is found once
(:mod:`eha_monitor.recordings.cdr`); messages of the same lengths and names are then read all at
once, as the columns of a table of bytes.  Any other is decoded as a whole.

All arrays of a JointState have the same length or none, so joints of which different quantities
are measured, or which different drivers publish, come in messages of their own on one topic.  A
message then lacks an entry because another message brings it, which is no fault of the data.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message
from rosbags.typesys import Stores, get_typestore

from eha_monitor.live.rows import Batch
from eha_monitor.recordings.cdr import LITTLE_ENDIAN, STAMP, Want, locate
from eha_monitor.ros.topics import STEP, Entry, Topic, message_class

# Known once for all: to read the definitions takes 15 ms, and messages wait meanwhile.
TYPES = get_typestore(Stores.ROS2_JAZZY).fielddefs
LAYOUTS = 8  # of messages on one topic; more are those of a publisher that changes them


class Layout:
    """Messages that differ in nothing but stamp and numbers, and where those stand.

    Parameters
    ----------
    entries : the streams to read.
    type_name, stamped : type of the messages, and whether they carry a header.
    data : one of the messages.
    names : of the joints in them.

    Raises
    ------
    ValueError, struct.error, KeyError, RecursionError
        If ``data`` is no little-endian message of a known type.
    """

    def __init__(self, entries: Sequence[Entry], type_name: str, stamped: bool, data: bytes,
                 names: frozenset[str] = frozenset()):
        self.entries, self.names = tuple(entries), names
        self.sources = frozenset(entry.source.name for entry in entries)
        wants = [[Want(channel.field, entry.name) for _, channel in entry.channels]
                 for entry in entries]
        if data[:2] != LITTLE_ENDIAN:
            raise ValueError("expected a little-endian message")
        stamp = STAMP if stamped else ()
        found = locate(data, TYPES, type_name,
                       (*(want for stream in wants for want in stream), *stamp))
        self._length = len(data)
        self._pattern = np.frombuffer(bytes(data), dtype=np.uint8)
        self._fixed = np.zeros(len(data), dtype=np.uint8)  # all bits of a byte that stays
        for place in found.fixed:
            self._fixed[place] = 0xFF
        # An entry that is there may lack a number, as a list may be empty: that is a NaN.
        self._complete = all(any(want in found.places for want in stream) for stream in wants)
        self._columns = [[(*found.places.get(want, (0, None)), channel.gain, channel.zero)
                          for want, (_, channel) in zip(stream, entry.channels, strict=True)]
                         for stream, entry in zip(wants, entries, strict=True)]
        self._stamp_at = found.places[stamp[0]][0] if stamp else None

    def fits(self, data: bytes) -> bool:
        """Return whether a message is of this layout."""
        return self.fit([data], data)

    def fit(self, messages: Sequence[bytes], raw: bytes) -> bool:
        """Return whether all messages are of this layout; ``raw`` is all of them."""
        if set(map(len, messages)) != {self._length}:
            return False
        table = np.frombuffer(raw, dtype=np.uint8).reshape(-1, self._length)
        return not ((table ^ self._pattern) & self._fixed).any()

    def read(self, raw: bytes) -> tuple[np.ndarray, list[np.ndarray]] | None:
        """Return (n,) stamps in ns, zeros without, and the (n, k) values of each entry, SI.

        None where an entry has no number in one of the messages, of which ``raw`` is all.
        """
        n = len(raw) // self._length
        stamps = np.zeros(n, dtype=np.int64)
        if self._stamp_at is not None:
            for dtype, at, unit in (("<i4", 0, 1_000_000_000), ("<u4", 4, 1)):
                stamps += self._column(raw, n, self._stamp_at + at, dtype) * np.int64(unit)
        streams = []
        for places in self._columns if self._complete else ():
            values = np.full((n, len(places)), np.nan)
            for k, (at, dtype, gain, zero) in enumerate(places):
                if dtype is not None:
                    values[:, k] = self._column(raw, n, at, dtype)  # double from here on
                    values[:, k] = gain * values[:, k] + zero
            streams.append(values)
        whole = self._complete and all(np.isfinite(values).any(axis=1).all()
                                       for values in streams)
        return (stamps, streams) if whole else None

    def _column(self, raw: bytes, n: int, at: int, dtype) -> np.ndarray:
        """Return the numbers that stand at ``at`` in each of ``n`` messages."""
        return np.ndarray((n,), dtype, raw, at, (self._length,))


class TopicReader:
    """Reads the streams of one topic out of its serialised messages.

    Parameters
    ----------
    topic : topic and its streams.
    type_name : type of its messages.
    decoders : one for each stream; they keep what is wrong with it.

    Attributes
    ----------
    kind : class of the messages.
    zero_stamps : messages so far whose stamp was zero.

    Raises
    ------
    InputError
        If the type is not installed.
    """

    def __init__(self, topic: Topic, type_name: str, decoders: Sequence["Decoder"]):
        self.kind = message_class(type_name)
        fields = self.kind.get_fields_and_field_types()
        self._stamped, self._named = fields.get("header") == "std_msgs/Header", "name" in fields
        self._topic, self._type = topic, type_name
        self._layouts: list[Layout] = []
        self._decoders = decoders
        self.zero_stamps = 0

    @property
    def apart(self) -> bool:
        """Whether joints have come in messages of their own."""
        return len({layout.names for layout in self._layouts}) > 1

    def read(self, messages: Sequence[bytes], came: np.ndarray, now_ns: np.ndarray
             ) -> list[Batch]:
        """Return the samples of each stream in some messages, of which there is one at least.

        Parameters
        ----------
        came, now_ns : (n,) when each was received: s, monotonic, and ns on the node's clock.
        """
        found = self._read_columns(messages, now_ns)
        if found is None:
            return self._read_singly(messages, came, now_ns)
        return [Batch(entry.source, stamps - entry.delay_ns, values, came[places])
                for entry, (places, stamps, values) in zip(self._topic.entries, found,
                                                           strict=True)]

    def _read_columns(self, messages: Sequence[bytes], now_ns: np.ndarray
                      ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]] | None:
        """Return places among the messages, stamps and values of each entry of the topic.

        None unless each message has a stamp, where its type has one, and a number of each entry
        that it or another message with one of its joints has had.
        """
        places = self._by_layout(messages)
        if not places or not self._all_come():
            self._layouts = []
            return None
        brought: dict[str, list[tuple]] = {}
        for number, (chosen, raw) in places.items():
            layout = self._layouts[number]
            if not layout.entries:
                continue
            read = layout.read(raw)
            if read is None or (self._stamped and not read[0].all()):
                return None
            stamps = read[0] if self._stamped else now_ns[chosen]
            for entry, values in zip(layout.entries, read[1], strict=True):
                brought.setdefault(entry.source.name, []).append((chosen, stamps, values))
        found = []
        for entry, decoder in zip(self._topic.entries, self._decoders, strict=True):
            one = _joined(brought.get(entry.source.name, []), len(entry.channels))
            last = one[0][-1] if len(one[0]) else -1
            decoder.note({name for number, (chosen, _) in places.items() if chosen[-1] > last
                          for name in self._layouts[number].names})
            found.append(one)
        return found

    def _by_layout(self, messages: Sequence[bytes]) -> dict[int, tuple[np.ndarray, bytes]]:
        """Return by number of a layout which messages are of it, and these as one.

        Nothing if a message is of none.
        """
        raw = b"".join(messages)
        if self._layouts and self._layouts[0].fit(messages, raw):
            return {0: (np.arange(len(messages)), raw)}
        places: dict[int, list[int]] = {}
        for k, data in enumerate(messages):
            number = self._layout_of(data)
            if number is None:
                return {}
            places.setdefault(number, []).append(k)
        return {number: (np.array(chosen), b"".join([messages[k] for k in chosen]))
                for number, chosen in places.items()}

    def _layout_of(self, data: bytes) -> int | None:
        """Return the number of the layout of a message, None where none can be found."""
        for number, layout in enumerate(self._layouts):
            if layout.fits(data):
                return number
        if len(self._layouts) == LAYOUTS:
            return None
        try:
            names = frozenset(deserialize_message(data, self.kind).name if self._named else ())
            entries = [entry for entry in self._topic.entries
                       if not (self._named and entry.name) or entry.name in names]
            self._layouts.append(Layout(entries, self._type, self._stamped, data, names))
        except Exception:  # noqa: BLE001  rclpy has no class for what is no message
            return None
        return len(self._layouts) - 1

    def _all_come(self) -> bool:
        """Return whether every entry has come, and no message lacks one beside its own joints."""
        for entry in self._topic.entries:
            with_it = [layout.names for layout in self._layouts
                       if entry.source.name in layout.sources]
            without = [layout.names for layout in self._layouts
                       if entry.source.name not in layout.sources]
            if not with_it or any(one & other for one in with_it for other in without):
                return False
        return True

    def _read_singly(self, messages: Sequence[bytes], came: np.ndarray, now_ns: np.ndarray
                     ) -> list[Batch]:
        """Decode each message as a whole: some lack an entry, a number or a stamp."""
        times, taken = [], []
        streams: list[list[tuple[int, tuple[float, ...] | None, bool | None]]] = [
            [] for _ in self._decoders]
        apart = self.apart
        for k, data in enumerate(messages):
            message = deserialize_message(data, self.kind)
            time_ns = 0
            if self._stamped:
                time_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                # One zero may be the start of simulated time, two are no stamps at all.
                self.zero_stamps += time_ns == 0
                if time_ns == 0 and self.zero_stamps == 1:
                    continue
            for stream, decoder in zip(streams, self._decoders, strict=True):
                values = decoder(message)
                if apart and not decoder.found:  # another message brings it
                    decoder.problem = None
                    continue
                stream.append((len(times), values, None if values is not None else decoder.found))
            times.append(time_ns or int(now_ns[k]))
            taken.append(k)
        stamps, came = np.array(times, dtype=np.int64), came[taken]
        return [_batch(entry, stream, stamps, came)
                for entry, stream in zip(self._topic.entries, streams, strict=True)]


def _joined(found: list[tuple], channels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join what messages of several layouts brought of an entry, in the order of the messages."""
    if not found:
        return np.empty(0, int), np.empty(0, np.int64), np.empty((0, channels))
    if len(found) == 1:
        return found[0]
    places, stamps, values = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.argsort(places)
    return places[order], stamps[order], values[order]


def _batch(entry: Entry, stream: list[tuple], stamps: np.ndarray, came: np.ndarray) -> Batch:
    """Return what messages brought of an entry: place, values or None, whether a number lacks."""
    places, values_of, lacking = zip(*stream, strict=True) if stream else ((), (), ())
    nothing = (np.nan,) * len(entry.channels)
    chosen = np.array(places, dtype=int)
    return Batch(entry.source, stamps[chosen] - entry.delay_ns, np.array(
        [nothing if values is None else values for values in values_of],
        dtype=float).reshape(-1, len(nothing)), came[chosen],
        None if all(lacks is None for lacks in lacking) else lacking)


class Decoder:
    """Reads the channels of one entry out of a message.

    The place of the entry among the message's names is kept until the names change, so that
    JointStates may order their joints as they like.

    Attributes
    ----------
    problem : why the last message gave nothing, as a sentence, or None.
    absent : what came in place of an entry that has messages of its own, as a sentence, or None.
    """

    def __init__(self, entry: Entry):
        self.problem: str | None = None
        self.absent: str | None = None
        self._entry = entry
        self._names: list[str] | None = None
        self._index = 0
        self._fields = [(_reader(channel.field), channel.gain, channel.zero)
                        for _, channel in entry.channels]

    def __call__(self, message: Any) -> tuple[float, ...] | None:
        """Return one SI value for each channel (NaN where there is none), or None for none."""
        names = getattr(message, "name", None)
        if names is not None and names != self._names:
            self._find(names)
        if self._index < 0:
            self.problem = self.lacks(self._names)
            return None
        values = tuple([scale * read(message, self._index) + offset
                        for read, scale, offset in self._fields])
        for value in values:
            if math.isfinite(value):
                self.problem = None
                return values
        fields = ", ".join(channel.field for _, channel in self._entry.channels)
        self.problem = f"{self._entry.source.name} holds no number in {fields}"
        return None

    @property
    def found(self) -> bool:
        """Whether the last message had the entry."""
        return self._index >= 0

    def note(self, others: set[str]) -> None:
        """Note that messages were read as columns, and the joints in those after its own."""
        self.problem = None
        self.absent = self.lacks(sorted(others)) if others else None

    def lacks(self, names: Sequence[str]) -> str:
        """Return in a sentence that a message with these names has not the entry."""
        return (f"{self._entry.source.name}: no entry named {self._entry.name!r}, the message has "
                f"{', '.join(names) or 'none'}")

    def _find(self, names: list[str]) -> None:
        self._names = list(names)
        wanted = self._entry.name
        if not wanted:
            self._index = 0
        elif wanted in self._names:
            self._index = self._names.index(wanted)
        else:
            self._index = -1


def _reader(path: str) -> Callable[[Any, int], float]:
    """Return a function (message, index of the entry) -> number, NaN where there is none."""
    steps = [STEP.fullmatch(part).groups() for part in path.split(".")]
    if len(steps) == 1 and steps[0][1] is None:  # the hot path: position, fluid_pressure, data
        name = steps[0][0]

        def simple(message, index):
            value = getattr(message, name, math.nan)
            if isinstance(value, float | int):
                return value
            try:
                return float(value[index])
            except (IndexError, TypeError, ValueError):
                return math.nan
        return simple

    def deep(message, index):
        try:
            for name, place in steps:
                message = getattr(message, name)
                if place is not None:
                    message = message[int(place)]
            return float(message if isinstance(message, float | int) else message[index])
        except (AttributeError, IndexError, TypeError, ValueError):
            return math.nan
    return deep
