"""Messages of one topic to columns of numbers.

Most messages of a topic differ in nothing but stamp and numbers.  Where those stand is found once
(:mod:`eha_monitor.recordings.cdr`); messages of the same lengths and names are then read all at
once, as the columns of a table of bytes.

All arrays of a JointState have the same length or none, so joints of which different quantities
are measured, or which different drivers publish, come in messages of their own on one topic.  A
message then lacks an entry because another message brings it, which is no fault of the data.
"""

import re
from collections.abc import Collection, Sequence
from functools import cache

import numpy as np
from rosbags.interfaces import Nodetype

from eha_monitor.errors import InputError
from eha_monitor.live.rows import Batch
from eha_monitor.recordings.cdr import (
    SIZES,
    STAMP,
    Layout,
    Want,
    has_names,
    has_stamp,
    locate,
    steps_of,
)
from eha_monitor.ros.topics import Entry, Topic, message_class
from eha_monitor.words import listed

LAYOUTS = 8  # of messages on one topic that are kept; more are those of a publisher that changes
# A type of a field as rclpy has it: element, then [n] of an array; or sequence<element, most>.
_FIELD = re.compile(r"(sequence<)?([\w/]+)(?:<\d+>)?(?:, \d+>|>)?(?:\[(\d+)\])?")
_NAMES = {"boolean": "bool", "float": "float32", "double": "float64"}


@cache
def types_of_class(type_name: str) -> dict:
    """Return type name -> (constants, fields) as rosbags has them, of a type and all inside it.

    Raises InputError if a package is not installed, or a field is of a kind that is not read.
    """
    fields, found = [], {}
    for name, kind in message_class(type_name).get_fields_and_field_types().items():
        sequence, element, count = _FIELD.fullmatch(kind).groups()
        if "/" in element:
            inner = element.replace("/", "/msg/", 1)
            found |= types_of_class(inner)
            node = (Nodetype.NAME, inner)
        else:
            base = _NAMES.get(element, element)
            if base not in SIZES and base != "string":
                raise InputError(f"{type_name}: cannot read its field {name}, a {kind}")
            node = (Nodetype.BASE, (base, 0))
        if sequence:
            node = (Nodetype.SEQUENCE, (node, 0))
        elif count:
            node = (Nodetype.ARRAY, (node, int(count)))
        fields.append((name, node))
    return {**found, type_name: ([], fields)}


class Stream:
    """What is read of one entry of a topic."""

    def __init__(self, entry: Entry):
        self.entry = entry
        # why the last message gave nothing, as a sentence, or None
        self.problem: str | None = None
        # what came in place of an entry that has messages of its own, as a sentence, or None
        self.absent: str | None = None
        # why messages of this type give nothing, as a sentence, or None
        self.unfit: str | None = None
        self.seen = False  # a message held the entry
        self._since = 0  # messages without it since the last with it

    def not_of(self, type_name: str, fields: Collection[str]) -> None:
        """Note where a type with these fields has none that is wanted."""
        wanted = [channel.field for _, channel in self.entry.channels]
        self.unfit = None if any(steps_of(one)[0][0] in fields for one in wanted) else (
            f"{self.entry.source.name}: a {type_name} has no "
            f"{listed(wanted, 'or')}, it has {listed(sorted(fields))}")

    def wants(self, named: bool) -> list[Want]:
        """Return where its numbers stand; without a name the first of a list counts."""
        if named and self.entry.name:
            return [Want(channel.field, self.entry.name) for _, channel in self.entry.channels]
        return [Want(channel.field if channel.field.endswith("]") else f"{channel.field}[0]")
                for _, channel in self.entry.channels]

    def lacks(self, names: Sequence[str]) -> str:
        """Return in a sentence that messages with these names have not the entry."""
        return (f"{self.entry.source.name}: no entry named {self.entry.name!r}, the message has "
                f"{', '.join(names) or 'none'}")

    def note(self, found: np.ndarray, number: np.ndarray, groups: list, apart: bool) -> None:
        """Note how messages were read.

        Parameters
        ----------
        found, number : (n,) whether each has the entry, and a number of it.
        groups : layouts of the messages, each with which of them are of it.
        apart : whether what one lacks is brought by others.
        """
        last, end = np.flatnonzero(found)[-1:], len(found) - 1
        self.seen |= bool(len(last))
        others = {name for layout, rows, _ in groups if not len(last) or rows[-1] > last[0]
                  for name in layout.names}
        # Of messages of several joints one is always the last: that the others are not named in
        # it says something only once it has come again.
        self._since = end - int(last[0]) if len(last) else self._since + len(found)
        self.absent = self.lacks(sorted(others)) if apart and self._since > len(others) > 0 else (
            None)
        self.problem = None
        if found[end] and not number[end]:
            fields = ", ".join(channel.field for _, channel in self.entry.channels)
            self.problem = self.unfit or f"{self.entry.source.name} holds no number in {fields}"
        elif not found[end] and not apart:
            self.problem = self.lacks(next(layout.names for layout, rows, _ in groups
                                           if rows[-1] == end))


class TopicReader:
    """Reads the streams of one topic out of its serialised messages.

    ``streams`` : one for each entry; they keep what is wrong with it.  Raises InputError if the
    type is not installed.
    """

    def __init__(self, topic: Topic, type_name: str, streams: Sequence[Stream]):
        self.kind = message_class(type_name)  # class of the messages
        self._types, self._type = types_of_class(type_name), type_name
        self._stamped = has_stamp(self._types, type_name)
        self._named = has_names(self._types, type_name)
        self._streams = streams
        self._wants = [stream.wants(self._named) for stream in streams]
        self._layouts: list[Layout] = []
        self.zero_stamps = 0  # messages so far whose stamp was zero
        self.stamps = np.empty(0, dtype=np.int64)  # (n,) ns, of the messages read last
        self._by_receipt(not self._stamped)
        has = {name for name, _ in self._types[type_name][1]}
        for stream in streams:
            stream.not_of(type_name, has)

    @property
    def stamped(self) -> bool:
        """Whether its messages say when they were sent."""
        return self._stamped and self.zero_stamps < 2

    def _by_receipt(self, unstamped: bool) -> None:
        for stream in self._streams:
            stream.entry.source.by_receipt = unstamped

    def read(self, messages: Sequence[bytes], came: np.ndarray, now_ns: np.ndarray) -> list[Batch]:
        """Return the samples of each stream in some messages, of which there is one at least.

        ``came``, ``now_ns`` : (n,) when each was received: s, monotonic, and ns on the node's
        clock.
        """
        groups = self._by_layout(messages)
        self.stamps = stamps = np.array(now_ns, dtype=np.int64)
        if self._stamped:
            for layout, rows, table in groups:
                seconds, rest = (layout.numbers(table, want) for want in STAMP)
                stamps[rows] = seconds.astype(np.int64) * 1_000_000_000 + rest
        kept = self._dated(stamps, now_ns)
        read = [self._values(stream, wants, groups, len(messages))
                for stream, wants in zip(self._streams, self._wants, strict=True)]
        apart = not all(found.all() for found, _ in read) and self._come_apart(
            [layout for layout, _, _ in groups])
        batches = []
        for stream, (found, values) in zip(self._streams, read, strict=True):
            number = found & np.isfinite(values).any(axis=1)
            if not number.all():
                stream.note(found, number, groups, apart)
            else:
                stream.problem = stream.absent = None
            rows = kept & found if apart else kept
            lacking = None if number[rows].all() else tuple(
                None if good else bool(there) and stream.unfit is None
                for good, there in zip(number[rows], found[rows], strict=True))
            batches.append(Batch(stream.entry.source, stamps[rows] - stream.entry.delay_ns,
                                 values[rows], came[rows], lacking))
        return batches

    def _by_layout(self, messages: Sequence[bytes]) -> list[tuple[Layout, np.ndarray, np.ndarray]]:
        """Return each layout, which messages are of it, and these as a table of bytes."""
        if self._layouts and set(map(len, messages)) == {len(self._layouts[0].template)}:
            table = table_of(messages)
            if self._layouts[0].fits(table).all():
                return [(self._layouts[0], np.arange(len(messages)), table)]
        places: dict[int, tuple[Layout, list[int]]] = {}
        for k, data in enumerate(messages):
            layout = self._layout_of(data)
            places.setdefault(id(layout), (layout, []))[1].append(k)
        return [(layout, np.array(rows), table_of([messages[k] for k in rows]))
                for layout, rows in places.values()]

    def _layout_of(self, data: bytes) -> Layout:
        """Return the layout of a message."""
        for layout in self._layouts:
            if len(layout.template) == len(data) and layout.fits(table_of([data]))[0]:
                return layout
        every = (want for wants in self._wants for want in wants)
        layout = locate(data, self._types, self._type, (*every, *(STAMP if self._stamped else ())))
        if len(self._layouts) < LAYOUTS:
            self._layouts.append(layout)
        return layout

    def _dated(self, stamps: np.ndarray, now_ns: np.ndarray) -> np.ndarray:
        """Give messages without a stamp the time of receipt; return which messages count."""
        kept = np.ones(len(stamps), dtype=np.bool_)
        zero = np.flatnonzero(stamps == 0)
        if len(zero):
            # One zero may be the start of simulated time, two are no stamps at all.
            kept[zero[0]] = self.zero_stamps > 0
            self.zero_stamps += len(zero)
            stamps[zero] = now_ns[zero]
            self._by_receipt(self.zero_stamps > 1)
        return kept

    def _values(self, stream: Stream, wants: Sequence[Want], groups: list, n: int
                ) -> tuple[np.ndarray, np.ndarray]:
        """Return which messages have the entry of a stream, and its numbers, (n, k) SI, NaN."""
        found, values = np.zeros(n, dtype=np.bool_), np.full((n, len(wants)), np.nan)
        for layout, rows, table in groups:
            rows = rows if len(groups) > 1 else slice(None)  # all of them: quicker
            found[rows] = self._has(layout, stream.entry)
            for i, (want, (_, channel)) in enumerate(zip(wants, stream.entry.channels,
                                                         strict=True)):
                if want in layout.places:
                    values[rows, i] = layout.numbers(table, want)  # double from here on
                    values[rows, i] = channel.gain * values[rows, i] + channel.zero
        return found, values

    def _has(self, layout: Layout, entry: Entry) -> bool:
        return not (self._named and entry.name) or entry.name in layout.names

    def _come_apart(self, now: list[Layout]) -> bool:
        """Tell whether what a message lacks is brought by others: joints of other messages.

        Not where an entry has never come, or came beside joints that come without it ``now``.
        """
        for stream in self._streams:
            names = {True: [], False: []}
            for layout in self._layouts:
                names[self._has(layout, stream.entry)].append(set(layout.names))
            if not names[True] or any(one & other for one in names[True]
                                      for other in names[False]):
                self._layouts = now[:LAYOUTS]  # of before nothing can be told
                return False
        return True


def table_of(messages: Sequence[bytes]) -> np.ndarray:
    """Return messages of one length as a table of bytes, (n, length) uint8."""
    return np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(len(messages), -1)
