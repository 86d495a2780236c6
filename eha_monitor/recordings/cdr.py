"""Numbers out of serialised ROS 2 messages, thousands at a time.

rosbags' type definitions give the layout.  One message is walked, and the byte offsets found hold
for every message that has the same lengths and names at the same places: of these the numbers are
numpy views on one table of bytes (figures in docs/dependencies.md).
"""

import re
import struct
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import zstandard
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from eha_monitor.recordings.bag import ZSTD_MAGIC
from eha_monitor.settings.channels import Channel

LITTLE_ENDIAN, BIG_ENDIAN = b"\x00\x01", b"\x00\x00"
ENCAPSULATION = 4  # bytes before the payload
TEMPLATES = 8  # layouts tried on all messages of one length before going one by one
SIZES = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1",
         "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
         "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
         "float32": "f4", "float64": "f8"}
# What a hostile message or definition makes rosbags and the walker raise.
UNREADABLE = (SerdeError, TypesysError, ValueError, KeyError, IndexError, TypeError,
              AttributeError, OverflowError, MemoryError, RecursionError, struct.error,
              zstandard.ZstdError)
_STEP = re.compile(r"(\w+)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Want:
    """A number wanted from a message: a field path, and a joint name where it has names."""

    field: str
    name: str = ""


STAMP = (Want("header.stamp.sec"), Want("header.stamp.nanosec"))


@dataclass
class Layout:
    """Places in one message, and in all that are alike."""

    template: bytes  # the message
    # Byte offset from the encapsulation on, and type, of each want that is in there.
    places: dict[Want, tuple[int, np.dtype]] = field(default_factory=dict)
    positions: list[int] = field(default_factory=lambda: [0, 1])  # bytes that fix the layout
    names: list[str] = field(default_factory=list)  # of the joints, where the message has names

    @cached_property
    def _fixed(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the bytes stand that messages of this layout have in common, and these."""
        at = np.unique(self.positions)
        return at, np.frombuffer(self.template, dtype=np.uint8)[at]

    def fits(self, table: np.ndarray) -> np.ndarray:
        """Tell which messages are of this layout; ``table`` (n, length) uint8, returns (n,)."""
        at, common = self._fixed
        return (table[:, at] == common).all(axis=1)

    def numbers(self, table: np.ndarray, want: Want) -> np.ndarray:
        """Return a number of each message, (n,), a view; ``table`` (n, length) uint8."""
        offset, dtype = self.places[want]
        return np.ndarray((len(table),), dtype, table, offset, (table.shape[1],))


def steps_of(path: str) -> list[tuple[str, int | None]]:
    """Split ``pose.covariance[3].x`` into (("pose", None), ("covariance", 3), ("x", None)).

    Raises ValueError if it is no field path.
    """
    steps = []
    for part in path.split("."):
        match = _STEP.fullmatch(part)
        if match is None:
            raise ValueError(f"{path!r} is no field path")
        steps.append((match[1], None if match[2] is None else int(match[2])))
    return steps


def has_names(types: dict, msgtype: str) -> bool:
    """Tell whether the message carries a list of names, as JointState does."""
    fields = dict(types[msgtype][1])
    kind = fields.get("name")
    return bool(kind and kind[0] == Nodetype.SEQUENCE and kind[1][0] == (Nodetype.BASE,
                                                                         ("string", 0)))


def has_stamp(types: dict, msgtype: str) -> bool:
    """Tell whether the message starts with a std_msgs/Header."""
    fields = types[msgtype][1]
    return bool(fields and fields[0] == ("header", (Nodetype.NAME, "std_msgs/msg/Header")))


def missing_field(types: dict, msgtype: str, want: Want) -> str | None:
    """Return what is wrong with a wanted field, in words, or None if the type has it."""
    try:
        steps = steps_of(want.field)
    except ValueError as problem:
        return str(problem)
    kind = (Nodetype.NAME, msgtype)
    for i, (name, index) in enumerate(steps):
        fields = dict(types.get(kind[1], ([], []))[1]) if kind[0] == Nodetype.NAME else {}
        if name not in fields:
            return f"expected field '{want.field}', the type has " + (
                ", ".join(fields) if fields else "no such field")
        kind = fields[name]
        listed = kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        by_name = bool(want.name) and i == len(steps) - 1 and has_names(types, msgtype)
        if listed and index is None and not by_name:
            return f"field '{want.field}' is a list, expected an index such as '{name}[0]'"
        if index is not None and not listed:
            return f"field '{name}' is no list, expected no index"
        if listed:
            kind = kind[1][0]
    if kind[0] != Nodetype.BASE or kind[1][0] not in SIZES:
        return f"field '{want.field}' is no number"
    return None


def locate(raw: bytes, types: dict, msgtype: str, wants: tuple[Want, ...]) -> Layout:
    """Walk one serialised message and return where the wanted numbers stand.

    Raises ValueError, struct.error, KeyError, RecursionError if the bytes are no message of this
    type.
    """
    if raw[:2] not in (LITTLE_ENDIAN, BIG_ENDIAN):
        raise ValueError("not plain CDR")
    walker = _Walker(raw, types)
    walker.message(msgtype, [(steps_of(want.field), want) for want in wants])
    if walker.at > len(raw):
        raise ValueError("message ends early")
    return walker.layout


class _Walker:
    """Reads a message front to back, noting lengths and wanted places."""

    def __init__(self, raw: bytes, types: dict):
        self.raw, self.types = raw, types
        self.order = "<" if raw[:2] == LITTLE_ENDIAN else ">"
        self.at = ENCAPSULATION
        self.layout = Layout(raw)

    def align(self, size: int) -> None:
        self.at += -(self.at - ENCAPSULATION) % size

    def structural(self, size: int) -> None:
        self.layout.positions.extend(range(self.at, self.at + size))

    def count(self) -> int:
        self.align(4)
        self.structural(4)
        (value,) = struct.unpack_from(f"{self.order}I", self.raw, self.at)
        self.at += 4
        if value > len(self.raw) - self.at:
            raise ValueError("list longer than the message")
        return value

    def text(self, kept: bool = False) -> str:
        length = self.count()
        content = self.raw[self.at:self.at + max(length - 1, 0)]
        if kept:
            self.structural(length)
        self.at += length
        return content.decode() if kept else ""

    def message(self, msgtype: str, wants: list, depth: int = 0) -> None:
        fields = self.types[msgtype][1]
        for name, kind in fields:
            inner = [(steps, want) for steps, want in wants if steps and steps[0][0] == name]
            if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                self.items(name, kind, inner, depth)
            else:
                self.value(kind, [(steps[1:], want) for steps, want in inner], depth)

    def items(self, name: str, kind, wants: list, depth: int) -> None:
        element, count = kind[1]
        if kind[0] == Nodetype.SEQUENCE:
            count = self.count()
        names = (name == "name" and depth == 0
                 and element[0] == Nodetype.BASE and element[1][0] == "string")
        if names:
            self.layout.names = [self.text(kept=True) for _ in range(count)]
            return
        chosen: dict[int, list] = {}
        for steps, want in wants:
            index = steps[0][1]
            if index is None and want.name in self.layout.names:
                index = self.layout.names.index(want.name)
            if index is not None and index < count:
                chosen.setdefault(index, []).append((steps[1:], want))
        if element[0] == Nodetype.BASE and element[1][0] in SIZES:
            dtype = np.dtype(self.order + SIZES[element[1][0]])
            if count:
                self.align(dtype.itemsize)
            for index, found in chosen.items():
                for _, want in found:
                    self.layout.places[want] = (self.at + index * dtype.itemsize, dtype)
            self.at += count * dtype.itemsize
        else:
            for index in range(count):
                self.value(element, chosen.get(index, []), depth)

    def value(self, kind, wants: list, depth: int) -> None:
        if kind[0] == Nodetype.NAME:
            self.message(kind[1], wants, depth + 1)
        elif kind[1][0] == "string":
            self.text()
        else:
            dtype = np.dtype(self.order + SIZES[kind[1][0]])
            self.align(dtype.itemsize)
            for _, want in wants:
                self.layout.places[want] = (self.at, dtype)
            self.at += dtype.itemsize


def types_of(msgtype: str, encoding: str, definition: bytes) -> dict:
    """Return type name -> (constants, fields) for a message type.

    The definition in the bag comes first; without one, the types of ROS 2 Jazzy.  Raises
    ValueError if neither knows the type.
    """
    text = definition.decode("utf-8", errors="replace")
    if text.strip():
        try:
            types = (get_types_from_idl(text) if "idl" in encoding
                     else get_types_from_msg(text, msgtype))
            if _complete(types, msgtype):
                return types
        except UNREADABLE:
            pass
    types = get_typestore(Stores.ROS2_JAZZY).fielddefs
    if msgtype not in types:
        raise ValueError(f"message type {msgtype} is not defined in the bag")
    return types


def _complete(types: dict, msgtype: str) -> bool:
    """Tell whether a type has fields and every type that it is made of is there."""
    if msgtype not in types or not any(
            name != "structure_needs_at_least_one_member" for name, _ in types[msgtype][1]):
        return False
    kinds = [kind[1][0] if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind
             for _, kind in types[msgtype][1]]
    return all(kind[0] != Nodetype.NAME or _complete(types, kind[1]) for kind in kinds)


@dataclass(frozen=True)
class Series:
    """One channel as it was recorded."""

    stamp_ns: np.ndarray  # (n,) int64 in recorded order: header stamps, or log times without them
    log_ns: np.ndarray  # (n,) int64 times at which the recorder took the messages
    values: np.ndarray  # (n,) float64, raw units
    stamped: bool  # whether ``stamp_ns`` are header stamps

    def in_si(self, channel: Channel) -> "Series":
        """Return the channel in SI at the times at which its quantity was there."""
        return replace(self, stamp_ns=self.stamp_ns - round(channel.delay * 1e9),
                       values=channel.in_si(self.values))


class TopicReader:
    """Collects the wanted numbers of one topic.

    Parameters
    ----------
    topic, msgtype : as recorded.
    types : from :func:`types_of`.
    wants : numbers to collect; each must be in the type.
    """

    def __init__(self, topic: str, msgtype: str, types: dict, wants: tuple[Want, ...]):
        self.topic, self.msgtype, self.types, self.wants = topic, msgtype, types, wants
        self.stamped = has_stamp(types, msgtype)
        self.all_wants = wants + (STAMP if self.stamped else ())
        # Batch by batch: log times, values of each want, and in which messages it was.
        self.batches: list[tuple[np.ndarray, dict[Want, np.ndarray], dict[Want, np.ndarray]]] = []
        self.unreadable = 0
        self.taken = 0

    def add(self, data, times, begins, lengths) -> None:
        """Take messages: ``data`` (n,) uint8; log times in ns, begins and lengths (m,) int64."""
        if len(times) and bytes(data[begins[0]:begins[0] + 4]) == ZSTD_MAGIC:
            data, begins, lengths, good = _unpack(data, begins, lengths)
            self.unreadable += int(np.sum(~good))
            times = times[good]
        n = len(times)
        values = {want: np.full(n, np.nan) for want in self.wants}
        values |= {want: np.zeros(n, dtype=np.int64) for want in self.all_wants[len(self.wants):]}
        present = {want: np.zeros(n, dtype=np.bool_) for want in self.all_wants}
        for length in np.unique(lengths).tolist():
            self._read(np.lib.stride_tricks.sliding_window_view(data, length), begins,
                       np.flatnonzero(lengths == length), (values, present))
        self.batches.append((times, values, present))

    def _read(self, messages: np.ndarray, begins: np.ndarray, rows: np.ndarray,
              found: tuple[dict, dict]) -> None:
        """Read messages of one length: all that are like the first, then like the first left.

        Parameters
        ----------
        messages : (k, length) uint8, from every byte on.
        begins : (m,) where messages begin;  rows : which of them.
        found : values and presence of each want, (m,), written.
        """
        tried = 0
        while len(rows):
            few = rows if tried < TEMPLATES else rows[:1]
            tried += 1
            try:
                layout = locate(messages[begins[rows[0]]].tobytes(), self.types, self.msgtype,
                                self.all_wants)
            except UNREADABLE:
                self.unreadable += 1
                rows = rows[1:]
                continue
            table = messages[begins[few]]
            fits = layout.fits(table)
            table, chosen = table[fits], few[fits]
            for want in layout.places:
                found[0][want][chosen] = layout.numbers(table, want)
                found[1][want][chosen] = True
            rows = rows[~fits] if few is rows else rows[1:]

    @property
    def count(self) -> int:
        """Messages so far."""
        return self.taken + sum(len(times) for times, _, _ in self.batches)

    def take(self, wants: tuple[Want, ...]
             ) -> list[tuple[np.ndarray, dict[Want, np.ndarray]]] | None:
        """Return header stamps and the wanted values of what was collected, and forget it.

        Joints that come in messages of their own have stamps of their own, each group an entry
        of the list.  None, and nothing is forgotten, where some message lacks a stamp, or one
        of the wanted that comes with others of it, or holds a number that is not wanted.
        """
        if self.unreadable or not self.stamped or not all(
                present[want].all() for want in STAMP for _, _, present in self.batches):
            return None
        if not self.batches:
            return [(np.empty(0, np.int64), dict.fromkeys(wants, np.empty(0)))]
        _, values, present = self._joined()
        groups: dict[bytes, list[Want]] = {}
        for want in wants:
            groups.setdefault(present[want].tobytes(), []).append(want)
        masks = [np.frombuffer(key, dtype=np.bool_) for key in groups]
        if not (np.sum(masks, axis=0) == 1).all():
            return None
        others = [want for want in self.wants if want not in wants]
        if any(np.isfinite(values[want]).any() for want in others):
            return None
        stamps = _stamps(values)
        if not stamps.all():
            return None
        self.taken += len(stamps)
        self.batches = []
        return [(stamps[mask], {want: values[want][mask] for want in group})
                for mask, group in zip(masks, groups.values(), strict=True)]

    def _joined(self) -> tuple[np.ndarray, dict[Want, np.ndarray], dict[Want, np.ndarray]]:
        """Return all batches as one, which takes their place."""
        if len(self.batches) > 1:
            times, values, present = zip(*self.batches, strict=True)
            self.batches = [(np.concatenate(times), *(
                {want: np.concatenate([one[want] for one in parts]) for want in self.all_wants}
                for parts in (values, present)))]
        return self.batches[0]

    def series(self, want: Want) -> Series | None:
        """Return what was collected, or None where no message held it or all of it is NaN."""
        if not self.batches:
            return None
        logs, columns, present = self._joined()
        there = present[want]
        logs, values = logs[there], columns[want][there]
        if not np.isfinite(values).any():
            return None
        if self.stamped and (header := _stamps(columns)[there]).any():
            return Series(header, logs, values, True)
        return Series(logs, logs, values, False)


def _stamps(columns: dict[Want, np.ndarray]) -> np.ndarray:
    """Return the header stamps, ns (n,)."""
    return columns[STAMP[0]] * 1_000_000_000 + columns[STAMP[1]]


def _unpack(data, begins, lengths):
    """Unpack messages that are compressed one by one; returns data, begins, lengths, good."""
    unpack = zstandard.ZstdDecompressor().decompress
    parts, good = [], np.ones(len(begins), dtype=np.bool_)
    for i, (begin, length) in enumerate(zip(begins.tolist(), lengths.tolist(), strict=True)):
        try:
            parts.append(unpack(data[begin:begin + length], max_output_size=2**24))
        except (zstandard.ZstdError, ValueError, MemoryError):
            good[i] = False
    lengths = np.array([len(part) for part in parts], dtype=np.int64)
    begins = np.concatenate([[0], np.cumsum(lengths)])[:len(parts)].astype(np.int64)
    return np.frombuffer(b"".join(parts), dtype=np.uint8), begins, lengths, good
