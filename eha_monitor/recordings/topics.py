"""Numbers out of the messages of one topic, thousands at a time.

Messages of one length whose lengths and names agree with a template are read by a strided copy;
whatever does not fit is given to rosbags, message by message.
"""

import struct
from dataclasses import dataclass

import numpy as np
import zstandard
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from eha_monitor.recordings import cdr
from eha_monitor.recordings.cdr import Want
from eha_monitor.recordings.mcap_file import ZSTD_MAGIC
from eha_monitor.recordings.walk import gather, same_structure

TEMPLATES = 8  # layouts tried for messages of one length before going one by one
STAMP = (Want("header.stamp.sec"), Want("header.stamp.nanosec"))
# What a hostile message or definition makes rosbags and the walker raise.
UNREADABLE = (SerdeError, TypesysError, ValueError, KeyError, IndexError, TypeError,
              AttributeError, OverflowError, MemoryError, RecursionError, struct.error,
              zstandard.ZstdError)


@dataclass(frozen=True)
class Series:
    """One channel as it was recorded.

    Attributes
    ----------
    stamp_ns : (n,) int64 stamps in recorded order: header stamps, or log times without them.
    log_ns : (n,) int64 times at which the recorder took the messages.
    values : (n,) float64, raw units.
    stamped : whether ``stamp_ns`` are header stamps.
    """

    stamp_ns: np.ndarray
    log_ns: np.ndarray
    values: np.ndarray
    stamped: bool


def types_of(msgtype: str, encoding: str, definition: bytes) -> dict:
    """Return type name -> (constants, fields) for a message type.

    The definition in the bag comes first; without one, the types of ROS 2 Jazzy.

    Raises
    ------
    ValueError
        If neither knows the type.
    """
    text = definition.decode("utf-8", errors="replace")
    if text.strip():
        parse = get_types_from_idl if "idl" in encoding else get_types_from_msg
        try:
            types = parse(text) if "idl" in encoding else parse(text, msgtype)
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
    for _, kind in types[msgtype][1]:
        if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind = kind[1][0]
        if kind[0] == Nodetype.NAME and not _complete(types, kind[1]):
            return False
    return True


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
        self.stamped = cdr.has_stamp(types, msgtype)
        self.asked = wants + (STAMP if self.stamped else ())
        self.logs: list[np.ndarray] = []
        self.columns: dict[Want, list[np.ndarray]] = {want: [] for want in self.asked}
        self.present: dict[Want, list[np.ndarray]] = {want: [] for want in self.asked}
        self.unreadable = 0
        self.taken = 0
        self._store: Typestore | None = None

    def add(self, data, times, begins, lengths) -> None:
        """Take messages: ``data`` (n,) uint8; log times in ns, begins and lengths (m,) int64."""
        if len(times) and bytes(data[begins[0]:begins[0] + 4]) == ZSTD_MAGIC:
            data, begins, lengths, good = _unpack(data, begins, lengths)
            self.unreadable += int(np.sum(~good))
            times = times[good]
        n = len(times)
        values = {want: np.full(n, np.nan) for want in self.wants}
        values |= {want: np.zeros(n, dtype=np.int64) for want in self.asked[len(self.wants):]}
        present = {want: np.zeros(n, dtype=np.bool_) for want in self.asked}
        for length in np.unique(lengths):
            rows = np.flatnonzero(lengths == length)
            rows = self._by_template(data, begins, int(length), rows, values, present)
            for row in rows:
                raw = data[begins[row]:begins[row] + length].tobytes()
                self._one_by_one(raw, int(row), values, present)
        self.logs.append(times)
        for want in self.asked:
            self.columns[want].append(values[want])
            self.present[want].append(present[want])

    def _by_template(self, data, begins, length, rows, values, present):
        """Read what fits a template; returns the rows that are left."""
        for _ in range(TEMPLATES):
            if not len(rows):
                break
            begin = begins[rows[0]]
            template = data[begin:begin + length]
            try:
                layout = cdr.locate(template.tobytes(), self.types, self.msgtype, self.asked)
            except UNREADABLE:
                return rows
            fits = same_structure(data, begins[rows], template,
                                  np.array(layout.positions, dtype=np.int64))
            chosen = rows[fits]
            for want, (offset, dtype) in layout.places.items():
                column = gather(data, begins[chosen], offset, dtype.itemsize)
                values[want][chosen] = column.view(dtype)[:, 0]
                present[want][chosen] = True
            rows = rows[~fits]
        return rows

    def _one_by_one(self, raw: bytes, row: int, values, present) -> None:
        try:
            if self._store is None:
                self._store = Typestore()
                self._store.register(self.types)
            message = self._store.deserialize_cdr(raw, self.msgtype)
            found = {want: _pick(message, want) for want in self.asked}
        except UNREADABLE:
            self.unreadable += 1
            return
        for want, value in found.items():
            if value is not None:
                values[want][row] = value
                present[want][row] = True

    @property
    def count(self) -> int:
        """Messages so far."""
        return self.taken + sum(len(part) for part in self.logs)

    def take(self, wants: tuple[Want, ...]
             ) -> list[tuple[np.ndarray, dict[Want, np.ndarray]]] | None:
        """Return header stamps and the wanted values of what was collected, and forget it.

        Joints that come in messages of their own have stamps of their own, each group an entry
        of the list.  None, and nothing is forgotten, where some message lacks a stamp, or one
        of the wanted that comes with others of it, or holds a number that is not wanted.
        """
        if self.unreadable or not self.stamped or not all(
                part.all() for want in STAMP for part in self.present[want]):
            return None
        groups: dict[bytes, list[Want]] = {}
        for want in wants:
            there = np.concatenate([np.empty(0, np.bool_), *self.present[want]])
            groups.setdefault(there.tobytes(), []).append(want)
        masks = [np.frombuffer(key, dtype=np.bool_) for key in groups]
        if not (np.sum(masks, axis=0) == 1).all():
            return None
        others = [want for want in self.wants if want not in wants]
        if any(np.isfinite(part).any() for want in others for part in self.columns[want]):
            return None
        seconds, rest = (np.concatenate([np.empty(0, np.int64), *self.columns[want]])
                         for want in STAMP)
        stamps = seconds * 1_000_000_000 + rest
        if not stamps.all():
            return None
        found = [(stamps[mask], {
            want: np.concatenate([np.empty(0), *self.columns[want]])[mask] for want in group})
            for mask, group in zip(masks, groups.values(), strict=True)]
        self.taken += len(stamps)
        self.logs = []
        for want in self.asked:
            self.columns[want], self.present[want] = [], []
        return found

    def series(self, want: Want) -> Series | None:
        """Return what was collected, or None where no message held it or all of it is NaN."""
        if not self.logs:
            return None
        present = np.concatenate(self.present[want])
        values = np.concatenate(self.columns[want])[present]
        logs = np.concatenate(self.logs)[present]
        if not np.isfinite(values).any():
            return None
        stamps, stamped = logs, False
        if self.stamped:
            header = (np.concatenate(self.columns[STAMP[0]]) * 1_000_000_000
                      + np.concatenate(self.columns[STAMP[1]]))[present]
            if header.any():
                stamps, stamped = header, True
        return Series(stamps, logs, values, stamped)


def _pick(message, want: Want) -> float | int | None:
    """Follow a field path through a message of rosbags; None if the entry is not in there."""
    steps = cdr.steps_of(want.field)
    for i, (name, index) in enumerate(steps):
        value = getattr(message, name)
        if index is None and i == len(steps) - 1 and np.ndim(value) == 1:
            names = list(message.name)
            if want.name not in names:
                return None
            index = names.index(want.name)
        if index is not None:
            if index >= len(value):
                return None
            value = value[index]
        message = value
    return int(message) if want in STAMP else float(message)


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
